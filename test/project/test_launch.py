"""The launch file names what is there; launch itself need not be installed."""

import importlib
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from msg_defs import limits

pytest.importorskip("rclpy")

ROOT = Path(__file__).parents[2]
FILE = ROOT / "launch" / "team.launch.py"
MODULES = {
    ("multi_robot_slam", "record"): "multi_robot_slam.nodes.recorder",
    ("multi_robot_slam", "watch"): "multi_robot_slam.nodes.watch",
    ("multi_robot_slam", "fusion"): "multi_robot_slam.nodes.fusion",
    ("multi_robot_slam", "camera"): "multi_robot_slam.nodes.camera",
    ("sim_world", "robots"): "sim_world.robots",
}
"""Each executable, and the module that it runs."""


class Made(SimpleNamespace):
    """Any of launch's classes: what it was made of."""

    def __init__(self, *given, **named):
        super().__init__(given=given, **named)


@pytest.fixture
def described(monkeypatch):
    """What the file describes, with classes that only remember."""
    wanted = {
        "launch": ["LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument"],
        "launch.conditions": ["IfCondition"],
        "launch.substitutions": ["LaunchConfiguration", "NotEqualsSubstitution"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
    }
    for name, classes in wanted.items():
        module = ModuleType(name)
        for each in classes:
            setattr(module, each, type(each, (Made,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    (actions,) = runpy.run_path(str(FILE))["generate_launch_description"]().given
    return actions


def of_kind(actions, name):
    return [one for one in actions if type(one).__name__ == name]


def test_every_node_is_installed_and_has_the_parameters(described):
    nodes = of_kind(described, "Node")
    assert {(node.package, node.executable) for node in nodes} == set(MODULES)
    for node in nodes:
        script = (ROOT / "scripts" / node.executable).read_text()
        module = MODULES[node.package, node.executable]
        assert f"-m {module} " in script
        usage = importlib.import_module(module).USAGE
        known = {leaf.name for cls in usage.classes for leaf in limits.leaves(cls)}
        known |= {"scenario"} if usage.section else set()
        assert set(node.parameters[0]) <= known, node.executable


def test_every_argument_that_is_used_is_declared_and_explained(described):
    declared = of_kind(described, "DeclareLaunchArgument")
    used = {
        value.given[0]
        for node in of_kind(described, "Node")
        for value in node.parameters[0].values()
    }
    for node in of_kind(described, "Node"):
        if node.condition is not None:
            (asked,) = node.condition.given
            used.add(asked.given[0] if isinstance(asked.given[0], str) else asked.given[0].given[0])
    assert used == {argument.given[0] for argument in declared}
    assert all(argument.description for argument in declared)
