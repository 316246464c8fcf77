"""What a node's command says of itself, without ROS."""

from dataclasses import field
from typing import Annotated

import pytest
import yaml
from annotated_types import Gt, Interval

from msg_defs import limits, scenario_file
from msg_defs.errors import InputError
from msg_defs.ros.usage import Usage
from msg_defs.types import settings
from multi_robot_slam.config import SECTION, Config
from sim_world.scenario import SECTION as WORLD_SECTION
from sim_world.scenario import Scenario


@settings
class Inner:
    width_m: Annotated[float, Gt(0), "width [m]"] = 2.0


@settings
class Outer:
    count: Annotated[int, Interval(ge=1, le=9), "how many"] = 3
    inner: Inner = field(default_factory=Inner)


USAGE = Usage("do something", "It does something.", (Config, Outer), SECTION)


def test_help_names_every_parameter_with_default_range_and_unit():
    said = USAGE.answer(["--help"])
    assert said == USAGE.answer(["--ros-args", "-h"])
    for cls in USAGE.classes:
        for leaf in limits.leaves(cls):
            assert f"\n  {leaf.name} = " in said
    assert "\n  count = 3\n      how many; a whole number, 1 <= value <= 9\n" in said
    assert "\n  inner.width_m = 2.0\n      width [m]; a number, 0 < value\n" in said
    assert max(map(len, said.splitlines())) <= 100


@pytest.mark.parametrize(("cls", "section"), [(Config, SECTION), (Scenario, WORLD_SECTION)])
def test_what_is_printed_as_a_configuration_is_read_back(cls, section):
    said = Usage("do something", "", (cls,), section).answer(["--print-config"])
    assert scenario_file.from_yaml(cls, said, section) == cls()
    keys = [line for line in said.splitlines() if ":" in line and "#" not in line]
    assert len(keys) >= len(list(limits.leaves(cls)))


def test_comments_say_what_a_field_is():
    said = scenario_file.to_commented_yaml("sim_world", Outer(count=5))
    assert "  # how many; a whole number, 1 <= value <= 9\n  count: 5\n" in said
    assert yaml.safe_load(said) == {"sim_world": {"count": 5, "inner": {"width_m": 2.0}}}


def test_a_configuration_is_printed_alone():
    with pytest.raises(InputError, match="give nothing else"):
        USAGE.answer(["--print-config", "--ros-args"])


def test_other_words_are_for_the_node():
    assert USAGE.answer(["--ros-args", "-p", "seed:=1"]) is None
    assert Usage("do something", "", (Outer,)).answer(["--print-config"]) is None
