"""A settings record that exists is a good one, whoever made it."""

import math
from dataclasses import field, replace
from typing import Annotated, Literal

import numpy as np
import pytest
from annotated_types import Gt, Interval, Len
from hypothesis import given
from hypothesis import strategies as st

from msg_defs import limits, scenario_file
from msg_defs.errors import InputError
from msg_defs.types import settings
from multi_robot_slam.config import Config
from multi_robot_slam.filter.settings import FilterSettings


@settings
class Inner:
    width_m: Annotated[float, Gt(0), "width [m]"] = 2.0


@settings
class Outer:
    count: Annotated[int, Interval(ge=1, le=9), "how many"] = 3
    share: Annotated[float, Interval(gt=0, lt=1), "a share"] = 0.5
    kind: Annotated[Literal["a", "b"], "which"] = "a"
    is_on: bool = True
    rows: tuple[tuple[float, float], ...] = ()
    names: Annotated[tuple[str, ...], Len(1), "names"] = ("a",)
    inner: Inner = field(default_factory=Inner)


anything = (
    st.none()
    | st.booleans()
    | st.integers(-3, 12)
    | st.floats()
    | st.sampled_from(["a", "b", "c", "1", ""])
    | st.lists(st.lists(st.floats(), max_size=3) | st.text(max_size=1), max_size=2)
    | st.tuples(st.floats(0, 1), st.floats(0, 1)).map(lambda row: (row,))
)


@given(name=st.sampled_from([f.name for f in limits.fields_of(Outer)]), value=anything)
def test_a_script_may_say_what_a_file_may_say(name, value):
    """Both refuse, or both make the same record; a file may spell numbers and booleans as text."""
    try:
        made = Outer(**{name: value})
    except InputError:
        made = None
    try:
        read = scenario_file.from_mapping(Outer, {name: value})
    except InputError:
        read = None
    kinds = {f.name: f.kind for f in limits.fields_of(Outer)}
    only_spelt_differently = made is None and kinds[name] in (bool, int, float)
    assert made == read or only_spelt_differently


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: FilterSettings(particles=-3), "particles = -3; give a whole number, 1 <= value"),
        (lambda: FilterSettings(particles=2.5), "particles = 2.5; give a whole number"),
        (lambda: FilterSettings(gate=math.nan), "gate = nan; give a number, 0 < value"),
        (lambda: FilterSettings(proposal="guess"), "proposal = 'guess'; give motion or informed"),
        (lambda: FilterSettings(exclusive="no"), "exclusive = 'no'; give true or false"),
        (lambda: replace(FilterSettings(), threads=257), "threads = 257; give a whole number, 0 <"),
        (lambda: Config(start_poses=((0.0, 0.0),)), "start_poses = .*; give rows of 3 numbers"),
        (lambda: Config(robots="robot_1"), "robots = 'robot_1'; give texts"),
        (lambda: Config(filter={"particles": 3}), "filter = .*; give FilterSettings"),
        (lambda: Outer(names=()), r"names = \(\); give texts, 1 or more: names"),
    ],
)
def test_what_does_not_fit_is_refused_with_field_value_and_range(make, said):
    with pytest.raises(InputError, match=said):
        make()


def test_what_means_the_same_becomes_the_fields_own_type():
    made = Outer(count=np.int64(4), share=np.float32(0.25), rows=np.ones((2, 2)), names=["x", "y"])
    assert made == Outer(4, 0.25, rows=((1.0, 1.0), (1.0, 1.0)), names=("x", "y"))
    assert [type(made.count), type(made.share), type(made.rows)] == [int, float, tuple]
    assert type(Inner(width_m=3).width_m) is float
    assert (
        scenario_file.from_yaml(Outer, scenario_file.to_yaml(sim_world=made), "sim_world") == made
    )


def test_a_class_checks_itself_after_its_fields():
    with pytest.raises(InputError, match="2 poses for 1 robots"):
        Config(start_poses=np.zeros((2, 3)))


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"filter": 3}, "filter = 3; give the settings in it by their names: particles, "),
        ({"robots": "robot_1"}, "robots = 'robot_1'; give a list of texts: "),
        ({"robots": [1]}, "robots.0 = 1; give a list of texts: "),
        (
            {"start_poses": [[0, 0]]},
            "start_poses.0 = [0, 0]; give a list of rows of 3 numbers, or unknown: ",
        ),
        ({"seed": "many"}, "seed = 'many'; give a whole number"),
        ({"filter": {"particles": 0}}, "filter.particles = 0; give a whole number, 1 <= value"),
        ({"filter": {"gate": ".inf"}}, "filter.gate = '.inf'; give a number, 0 < value"),
        ({"filter": {"proposal": "guess"}}, "filter.proposal = 'guess'; give motion or informed"),
        ({"filter": {"exclusive": 7}}, "filter.exclusive = 7; give true or false"),
        ({"filter": {"gates": 7}}, "unknown key 'filter.gates'"),
    ],
)
def test_a_file_is_refused_in_the_words_of_its_settings(values, said):
    with pytest.raises(InputError) as caught:
        scenario_file.from_mapping(Config, values, "mine.yaml")
    assert str(caught.value).startswith(f"mine.yaml: {said}")
    for foreign in ("Input", "tuple", "FilterSettings", "dataclass", "instance"):
        assert foreign not in str(caught.value)
