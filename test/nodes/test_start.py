"""Every node starts, or says in one line why not, and explains itself without ROS."""

from importlib import import_module

import pytest

from msg_defs import scenario_file
from multi_robot_slam.config import SECTION, Config

pytest.importorskip("rclpy")

NODES = (
    "multi_robot_slam.nodes.camera",
    "multi_robot_slam.nodes.fusion",
    "multi_robot_slam.nodes.recorder",
    "multi_robot_slam.nodes.replay",
    "multi_robot_slam.nodes.watch",
    "sim_world.robots",
)


@pytest.fixture(autouse=True)
def signal_handlers():
    """`spin` takes SIGINT and SIGTERM for itself; give them back."""
    import signal

    numbers = (signal.SIGINT, signal.SIGTERM)
    handlers = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("module", NODES)
def test_a_domain_that_ros_does_not_have_is_one_line(module, monkeypatch, capfd):
    monkeypatch.setenv("ROS_DOMAIN_ID", "999")
    assert import_module(module).main([]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("error: ROS_DOMAIN_ID = '999'")


@pytest.mark.parametrize("module", NODES)
def test_help_names_the_parameters(module, monkeypatch, capfd):
    monkeypatch.setenv("ROS_DOMAIN_ID", "999")
    assert import_module(module).main(["--help"]) == 0
    said = capfd.readouterr().out
    assert said.startswith("Usage: ")
    assert "--ros-args" in said
    assert "robots" in said


@pytest.mark.parametrize("verb", ["camera", "fusion", "record", "replay"])
def test_the_command_passes_help_on_to_the_node(command, verb):
    code, said, _ = command(verb, "--help")
    assert code == 0
    assert said.startswith(f"Usage: multi_robot_slam {verb} [--help]")


def test_the_command_prints_a_configuration_that_is_read_back(command):
    code, said, _ = command("fusion", "--print-config")
    assert code == 0
    assert scenario_file.from_yaml(Config, said, SECTION) == Config()
