"""Map files: what was saved is loaded, by other teams too, and nothing else is."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import recordings
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from msg_defs import wire
from msg_defs.errors import InputError
from multi_robot_slam.filter.settings import RejuvenationSettings
from multi_robot_slam.maps import container
from multi_robot_slam.pipeline import going_on, map_files, offline
from multi_robot_slam.pipeline.pipeline import Pipeline
from sim_world.scenario import Scenario

ROOT = Path(__file__).parents[2]
OFTEN = RejuvenationSettings(ancestors_below=0.5, delay_s=1.0, unknowns=150)
VERSION_1 = Path(__file__).with_name("map_version_1.npz")
"""As the first version wrote it; it is read for good."""


@pytest.fixture(scope="module")
def day(tmp_path_factory):
    """Configuration, events, and the pipeline that had them all."""
    bag = tmp_path_factory.mktemp("map_files") / "bag"
    scenario = Scenario(robots=2, observations=8)
    _, config = recordings.record(bag, scenario, steps=40, particles=40, rejuvenation=OFTEN)
    events = list(offline.events(bag, config))
    pipeline = Pipeline(config)
    offline.run_through(pipeline, events)
    return config, events, pipeline


@pytest.fixture(scope="module")
def saved(day, tmp_path_factory):
    config, _, pipeline = day
    path = tmp_path_factory.mktemp("saved") / "map.npz"
    kept = map_files.closed(pipeline)
    map_files.write(path, map_files.about(config, 12), kept)
    return path, kept


def content(kept):
    return {name: getattr(kept, name).tobytes() for name in map_files.LAYOUT}


def test_what_was_saved_is_loaded(day, saved):
    path, kept = saved
    file = map_files.read(path)
    assert content(file.kept) == content(kept)
    assert content(map_files.for_team(file, day[0].robots)) == content(kept)
    assert file.state is None
    assert file.about["robots"] == list(day[0].robots)
    assert file.about["stamp_ns"] == 12
    assert kept.published.sum() > 50
    with pytest.raises(InputError, match="nothing to go on from"):
        map_files.pipeline_of(file, print)


def test_numpy_alone_reads_it(saved):
    path, kept = saved
    with np.load(path, allow_pickle=False) as archive:
        assert json.loads(str(archive["about"]))["format"] == "multi_robot_slam map"
        assert (archive["map/positions"] == kept.positions).all()


def test_the_published_map_is_that_of_the_run(day, saved):
    _, kept = saved
    now, then = day[2].landmark_map(), kept.landmark_map()
    common = np.intersect1d(now.ids, then.ids)
    assert len(common) > 0.9 * len(now.ids)
    assert len(then.ids) < 1.1 * len(now.ids)
    rows = np.searchsorted(now.ids, common), np.searchsorted(then.ids, common)
    same = now.observations[rows[0]] == then.observations[rows[1]]
    assert same.mean() > 0.8  # others are more: closing joins what turns out to be one
    assert ((now.robots[rows[0]] & then.robots[rows[1]]) == now.robots[rows[0]]).all()


def test_another_team_has_its_own_bits(day, saved):
    first, second = day[0].robots
    file = map_files.read(saved[0])
    kept = map_files.for_team(file, ("new", second))
    assert ((kept.robots & 2) == (file.kept.robots & 2)).all()
    assert not (kept.robots & 1).any()
    swapped = map_files.for_team(file, (second, first)).robots
    assert ((swapped & 1) << 1 | (swapped & 2) >> 1 == file.kept.robots).all()


def test_a_state_goes_on_and_its_map_can_be_loaded(day, tmp_path):
    config, events, _ = day
    half = len(events) // 2
    whole = Pipeline(config)
    before = Pipeline(config)
    for event in events[:half]:
        whole.handle(event)
        before.handle(event)
    map_files.write_state(
        tmp_path / "state", map_files.about(config, 0), going_on.taken_apart(before)
    )
    file = map_files.read(tmp_path / "state")
    assert content(map_files.for_team(file, config.robots)) == content(map_files.closed(before))
    after = map_files.pipeline_of(file, print)
    steps = [offline.run_through(one, events[half:]) for one in (whole, after)]
    first, second = ([wire.encode_step(replace(s, duration_ms=0.0)) for s in own] for own in steps)
    assert first == second
    assert first


def test_a_state_of_another_version_of_the_program_is_refused(day, tmp_path):
    config, _, pipeline = day
    told = map_files.about(config, 0) | {"program": "0.0.1"}
    map_files.write_state(tmp_path / "state", told, going_on.taken_apart(pipeline))
    with pytest.raises(InputError, match=r"of version 0\.0\.1 of this program"):
        map_files.pipeline_of(map_files.read(tmp_path / "state"), print)


def test_who_only_looks_saves_what_was_loaded_to_the_byte(day, saved, tmp_path):
    config, events, _ = day
    path, _ = saved
    config = replace(config, filter=replace(config.filter, mapping=False))
    file = map_files.read(path)
    pipeline = Pipeline(config, kept=map_files.for_team(file, config.robots))
    steps = offline.run_through(pipeline, events)
    assert len(steps) > 30
    map_files.write(tmp_path / "again", file.about, map_files.closed(pipeline))
    assert (tmp_path / "again").read_bytes() == path.read_bytes()
    assert wire.encode_map(pipeline.landmark_map(), 0) == wire.encode_map(
        file.kept.landmark_map(), 0
    )


def test_who_only_looks_needs_a_map(day):
    config = replace(day[0], filter=replace(day[0].filter, mapping=False))
    with pytest.raises(InputError, match="no map to localise in"):
        Pipeline(config)


@pytest.mark.parametrize("mapping", [True, False])
def test_who_starts_anywhere_is_found_in_the_map(day, saved, tmp_path, mapping):
    """Where the map has it, and nothing is said of it before."""
    config, events, known = day
    path, _ = saved
    own = replace(config.filter, mapping=mapping)
    config = replace(config, start_poses=("unknown", "unknown"), filter=own)
    file = map_files.read(path)
    pipeline = Pipeline(config, kept=map_files.for_team(file, config.robots))
    steps = offline.run_through(pipeline, events)
    assert not steps[0].estimates
    assert {estimate.robot for estimate in steps[-1].estimates} == set(config.robots)
    expected = known.mean_trajectories()
    for name, path_found in pipeline.mean_trajectories().items():
        apart = path_found.poses[-1] - expected[name].poses[-1]
        assert np.hypot(*apart[:2]) < 0.1
    if not mapping:
        map_files.write(tmp_path / "again", file.about, map_files.closed(pipeline))
        assert (tmp_path / "again").read_bytes() == path.read_bytes()


def test_without_a_landmark_nothing_says_where_the_map_is(day):
    config = replace(day[0], start_poses=("unknown", "unknown"))
    empty = map_files.closed(Pipeline(day[0]))
    for kept in (None, empty):
        with pytest.raises(InputError, match=r"unknown for all robots; give .* or load a map"):
            Pipeline(config, kept=kept)


def test_in_a_loaded_map_no_robot_fixes_where_it_is(day, saved):
    config, _, _ = day
    config = replace(config, start_sigma=(0.3, 0.1))
    kept = map_files.for_team(map_files.read(saved[0]), config.robots)
    assert Pipeline(config, kept=kept).config.start_sigma_of(0) == (0.3, 0.1)
    assert Pipeline(config).config.start_sigma_of(0) == (0.0, 0.0)
    own = replace(config, start_sigmas=((0.0, 0.0), (0.1, 0.1)))
    assert Pipeline(own, kept=kept).config == own


def test_a_file_of_the_first_version_is_read():
    file = map_files.read(VERSION_1)
    assert file.about["robots"] == ["robot_1", "robot_2"]
    assert file.kept.ids.tolist() == [2, 3, 5]
    np.testing.assert_allclose(file.kept.positions[1], [1.0, 2.0, 0.5])
    assert len(map_files.for_team(file, ("robot_2",)).landmark_map().ids) == 2


def changed(path, out, name, array):
    arrays = container.read(path)
    arrays[name] = array
    container.write(out, {key: own for key, own in arrays.items() if own is not None})
    return out


def test_a_newer_file_is_refused_with_one_clear_line(tmp_path):
    told = json.loads(str(container.read(VERSION_1)["about"]))
    newer = np.array(json.dumps(told | {"version": map_files.VERSION + 1}))
    path = changed(VERSION_1, tmp_path / "a", "about", newer)
    with pytest.raises(InputError, match=r"is of version 2 of the format, .* up to 1; update it"):
        map_files.read(path)


@pytest.mark.parametrize(
    "about",
    [
        None,
        np.array("{"),
        np.array("[]"),
        np.array('{"format": "other", "version": 1}'),
        np.array('{"format": "multi_robot_slam map", "version": 1}'),
        np.array('{"format": "multi_robot_slam map", "version": "1"}'),
        np.array(["{}"]),
        np.arange(3),
        np.array(
            '{"format": "multi_robot_slam map", "version": 1, "robots": [1], "stamp_ns": 0, '
            '"config": ""}'
        ),
    ],
)
def test_what_is_no_map_is_refused(tmp_path, about):
    path = changed(VERSION_1, tmp_path / "a", "about", about)
    with pytest.raises(InputError, match=r"is no map of this program|lacks robots"):
        map_files.read(path)


def test_nothing_but_words_is_refused(tmp_path):
    container.write(tmp_path / "a", {"about": container.read(VERSION_1)["about"]})
    with pytest.raises(InputError, match="neither a map nor a state"):
        map_files.read(tmp_path / "a")


MAY_BE_NEGATIVE = {"positions", "descriptors"}


def spoilt(name, array, draw):
    """Another array where there was this one, of which something is wrong."""
    ways = ["gone", "dtype", "shape", "flat"]
    if array.dtype.kind == "f" and array.size:
        ways += ["nan", "inf"] + ["negative"] * (name not in MAY_BE_NEGATIVE)
    if array.dtype == np.int64:
        ways += ["below zero"]
    way = draw(st.sampled_from(ways))
    if way == "gone":
        return None
    if way == "dtype":
        other = st.sampled_from(["<f2", "<i2", "<f8", "<f4", "<i8", "|b1", "<U1"])
        return array.astype(draw(other.filter(lambda own: np.dtype(own) != array.dtype)))
    if way == "shape":
        return np.zeros((*array.shape, draw(st.integers(0, 3))), array.dtype)
    if way == "flat":
        return array.reshape(-1)[: draw(st.integers(0, max(array.size - 1, 0)))].reshape(-1, 1)
    array = array.copy()
    place = draw(st.integers(0, array.size - 1))
    array.flat[place] = {"nan": np.nan, "inf": -np.inf, "negative": -1e9, "below zero": -5}[way]
    return array


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
@given(st.data())
def test_a_map_of_which_something_is_wrong_is_refused_in_one_line(tmp_path, data):
    name = data.draw(st.sampled_from(list(map_files.LAYOUT)))
    good = container.read(VERSION_1)[f"map/{name}"]
    bad = spoilt(name, good, data.draw)
    path = changed(VERSION_1, tmp_path / "a", f"map/{name}", bad)
    with pytest.raises(InputError) as refusal:
        map_files.read(path)
    assert "\n" not in str(refusal.value)
    assert str(path) in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "array", "told"),
    [
        ("ids", np.array([2, 5, 3]), "do not ascend"),
        ("next_id", np.array(5), "larger than all ids"),
        ("next_id", np.array(2**31), "larger than all ids"),
        ("positions", np.full((3, 3), 1e30), "reach beyond"),
        ("robots", np.array([1, 4, 1]), "bits of robots"),
        ("together", np.array([[1, 1, 0], [0, 1, 0], [0, 0, 1]], bool), "not symmetric"),
        ("covariances", np.zeros((3, 6)), "not positive definite"),
        ("joint", -np.eye(6), "no positive definite covariance"),
        ("joint", np.triu(np.ones((6, 6))), "no positive definite covariance"),
        ("found", np.array([-1, 0, 0]), "below 0"),
    ],
)
def test_values_that_cannot_be_are_named(tmp_path, name, array, told):
    path = changed(VERSION_1, tmp_path / "a", f"map/{name}", array)
    with pytest.raises(InputError, match=told):
        map_files.read(path)


def test_the_documentation_has_every_array():
    text = (ROOT / "docs" / "maps.md").read_text()
    rows = re.findall(r"^\| `map/(\w+)` \| (.*?) \| (.*?) \| (.*?) \| (.*) \|$", text, re.MULTILINE)
    told = {name: (dtype, shape, unit, meaning) for name, dtype, shape, unit, meaning in rows}
    assert told == {
        name: (
            layout.dtype,
            f"({', '.join(map(str, layout.shape))}{',' * (len(layout.shape) == 1)})",
            layout.unit,
            layout.meaning,
        )
        for name, layout in map_files.LAYOUT.items()
    }
