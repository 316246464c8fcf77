from dataclasses import field, replace
from typing import Annotated

import pytest
from annotated_types import Ge, Gt, Interval

from msg_defs.errors import InputError
from msg_defs.limits import AT_ANY_TIME
from msg_defs.types import settings
from multi_robot_slam.config import SECTION, Config

nodes = pytest.importorskip("nodes")
parameters = pytest.importorskip("msg_defs.ros.parameters")

pytestmark = pytest.mark.usefixtures("ros_domain_id")


@settings
class Inner:
    width_m: Annotated[float, Gt(0), "width [m]"] = 2.0


@settings
class Outer:
    count: Annotated[int, Interval(ge=1, le=9), "how many"] = 3
    rows: Annotated[tuple[tuple[float, float], ...], "pairs"] = ((1.0, 2.0),)
    names: Annotated[tuple[str, ...], "names"] = ("a", "b")
    inner: Inner = field(default_factory=Inner)


@settings
class Edge:
    speed: Annotated[float, Ge(0), "speed [m/s]"] = 1.0


def declared(*arguments, classes=(Outer, Edge), section=None):
    """The settings that `arguments` give, and what the node then says of each parameter."""
    with nodes.ros(*arguments):
        edge_node = nodes.spin.EdgeNode("declaring")
        records = parameters.declare(edge_node, *classes, section=section)
        names = ("count", "rows", "names", "inner.width_m", "speed")
        known = [name for name in names if edge_node.has_parameter(name)]
        said = {
            n: (edge_node.get_parameter(n).value, edge_node.describe_parameter(n)) for n in known
        }
        refused = edge_node.set_parameters([nodes.rclpy.Parameter(n, value=1) for n in known])
        assert not any(result.successful for result in refused)
        return records, said


def test_every_field_becomes_a_described_parameter():
    records, said = declared()
    assert records == [Outer(), Edge()]
    assert {name: value for name, (value, _) in said.items()} == {
        "count": 3,
        "rows": [1.0, 2.0],
        "names": ["a", "b"],
        "inner.width_m": 2.0,
        "speed": 1.0,
    }
    assert said["inner.width_m"][1].description == "width [m]"
    (count,) = said["count"][1].integer_range
    assert (count.from_value, count.to_value) == (1, 9)
    (speed,) = said["speed"][1].floating_point_range
    assert (speed.from_value, speed.to_value) == (0.0, float("inf"))


def test_parameters_override_defaults():
    (outer, edge), said = declared(
        *("-p", "count:=5"),
        *("-p", "rows:=[1, 2, 3, 4]"),
        *("-p", "names:=[c]"),
        *("-p", "inner.width_m:=7"),
    )
    assert outer == Outer(5, ((1.0, 2.0), (3.0, 4.0)), ("c",), Inner(7.0))
    assert edge == Edge()
    assert said["inner.width_m"][0] == 7.0
    assert list(said["rows"][0]) == [1.0, 2.0, 3.0, 4.0]


def test_parameter_file_works_under_a_namespace(tmp_path):
    file = tmp_path / "parameters.yaml"
    file.write_text("/**:\n  ros__parameters:\n    inner: {width_m: 4.0}\n")
    (outer, _), _ = declared("-r", "__ns:=/team", "--params-file", str(file))
    assert outer == Outer(inner=Inner(4.0))


@pytest.mark.parametrize(
    ("argument", "reason"),
    [
        ("count:=10", "count = 10"),
        ("count:=two", "count = 'two'"),
        ("inner.width_m:=0.0", "inner.width_m = 0.0"),
        ("rows:=[1.0, 2.0, 3.0]", "rows: 3 numbers"),
        ("cuont:=3", "unknown parameter 'cuont'"),
        ("width_m:=3.0", "unknown parameter 'width_m'"),
    ],
)
def test_bad_parameter_is_refused_with_the_reason(argument, reason):
    with pytest.raises(InputError, match=reason.replace("[", r"\[")):
        declared("-p", argument)


def test_parameters_override_the_scenario_which_overrides_defaults(tmp_path):
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(f"{SECTION}: {{seed: 5, reorder_window_s: 2.0, filter: {{particles: 7}}}}")
    given = ("-p", f"scenario:={scenario}", "-p", "seed:=6")
    ((config,), _) = declared(*given, classes=(Config,), section=SECTION)
    default = Config()
    particles = replace(default.filter, particles=7)
    assert config == replace(default, seed=6, reorder_window_s=2.0, filter=particles)


def test_scenario_that_does_not_exist_is_refused():
    with pytest.raises(InputError, match="nowhere"):
        declared("-p", "scenario:=nowhere.yaml", classes=(Config,), section=SECTION)


def test_a_word_instead_of_a_row_is_as_many_nan():
    poses = "start_poses:=[1.0, 2.0, 0.5, .nan, .nan, .nan]"
    with nodes.ros("-p", "robots:=[a, b]", "-p", poses):
        node = nodes.spin.EdgeNode("declaring")
        (config,) = parameters.declare(node, Config)
        assert config.start_poses == ((1.0, 2.0, 0.5), "unknown")
        said = list(node.get_parameter("start_poses").value)
        assert said[:3] == [1.0, 2.0, 0.5]
        assert [x != x for x in said] == [False] * 3 + [True] * 3


@settings
class Changing:
    file: Annotated[str, AT_ANY_TIME, "a file"] = "a"
    other: Annotated[str, "another"] = "b"


def test_what_is_marked_may_change_at_any_time():
    with nodes.ros("-p", "file:=given"):
        edge_node = nodes.spin.EdgeNode("changing")
        assert parameters.declare(edge_node, Changing) == [Changing(file="given")]
        wanted = {"file": True, "other": False}
        for name, may_change in wanted.items():
            (result,) = edge_node.set_parameters([nodes.rclpy.Parameter(name, value="new")])
            assert result.successful == may_change
        assert edge_node.get_parameter("file").value == "new"
        assert edge_node.describe_parameter("file").description == "a file"
    with nodes.ros("-p", "strange:=1"), pytest.raises(InputError, match="unknown parameter"):
        parameters.declare(nodes.spin.EdgeNode("changing"), Changing)
