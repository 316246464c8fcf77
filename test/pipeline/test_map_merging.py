"""Two map files as one: a team in two halves, its maps merged, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import recordings

from msg_defs.errors import InputError
from multi_robot_slam import runs
from multi_robot_slam.filter.settings import RejuvenationSettings
from multi_robot_slam.pipeline import map_files, map_merging, offline
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs.associations import associations, origins
from multi_robot_slam.runs.trajectory_errors import alignment, rotation
from sim_world.scenario import Scenario

REST = RejuvenationSettings(ancestors_below=0.5)


class Mapped:
    """A team's map, as it is read from its file, and the true landmark of each of its own."""

    def __init__(self, config, events, recorded, path):
        pipeline = Pipeline(config)
        steps = offline.run_through(pipeline, events)
        run = offline.assemble(pipeline, recorded, steps, runs.Predictions())
        self.sources = origins(associations(run)).landmarks
        map_files.write(path, map_files.about(config, 7), map_files.closed(pipeline))
        self.file = map_files.read(path)


@pytest.fixture(scope="module")
def teams(tmp_path_factory):
    """The maps of two robots that each explore alone, of both as a team, and the truth.

    Each drives through its half of the building, and a third of the other's; the second says of
    its start that it is the origin.
    """
    folder = tmp_path_factory.mktemp("merging")
    scenario = Scenario(robots=2, movements=300, observations=15, laps=2)
    _, config = recordings.record(
        folder / "bag", scenario, steps=201, particles=60, rejuvenation=REST
    )
    config = replace(config, filter=replace(config.filter, threads=1))
    events = list(offline.events(folder / "bag", config))
    recorded = runs.recorded(folder / "bag", config.robots)
    made = {"both": Mapped(config, events, recorded, folder / "both.npz")}
    for number, name in enumerate(config.robots):
        start = ((0.0, 0.0, 0.0), config.start_poses[0])[number == 0]
        alone = replace(config, robots=(name,), start_poses=(start,))
        own = [event for event in events if event.robot == name]
        known = replace(
            recorded,
            odometry={name: recorded.odometry[name]},
            truth={name: recorded.truth[name]},
        )
        made[name] = Mapped(alone, own, known, folder / f"{name}.npz")
    return made, recorded.true_landmarks.positions.astype(float)


def error(kept, sources, truth):
    """RMS in the plane of the published landmarks that come from a true one [m], aligned."""
    rows = [row for row, n in enumerate(kept.ids.tolist()) if n in sources and kept.published[row]]
    true = truth[[sources[n] for n in kept.ids[rows].tolist()], :2]
    found = kept.positions[rows, :2]
    angle, shift = alignment(found, true)
    apart = found @ rotation(angle).T + shift - true
    return np.sqrt(np.mean(np.sum(apart**2, axis=1)))


def test_the_merged_map_is_as_good_as_that_of_one_team(teams):
    made, truth = teams
    one, other = made["robot_1"], made["robot_2"]
    result = map_merging.merge(one.file, other.file)
    assert result.about["robots"] == ["robot_1", "robot_2"]
    assert result.merged.joined > 20
    first = one.file.kept
    renamed = {
        int(first.next_id) + row: other.sources[n]
        for row, n in enumerate(other.file.kept.ids.tolist())
        if n in other.sources
    }
    found = error(result.kept, one.sources | renamed, truth)
    both = error(made["both"].file.kept, made["both"].sources, truth)
    assert found < 1.2 * both
    assert len(result.kept.ids) < 1.1 * len(made["both"].file.kept.ids)
    bits = result.kept.robots
    assert (bits == 3).sum() >= result.merged.joined
    assert set(bits.tolist()) == {1, 2, 3}


def test_the_result_is_a_map_that_others_begin_in(teams, tmp_path):
    made, _ = teams
    result = map_merging.merge(made["robot_1"].file, made["robot_2"].file)
    map_files.write(tmp_path / "c.npz", result.about, result.kept)
    file = map_files.read(tmp_path / "c.npz")
    assert (file.kept.ids == result.kept.ids).all()
    assert len(map_files.for_team(file, ("robot_2",)).ids) == len(result.kept.ids)


def test_a_map_merged_with_itself_is_itself(teams):
    file = teams[0]["robot_1"].file
    again = file._replace(about=file.about | {"robots": ["other"], "stamp_ns": 9})
    for second, names in ((file, ["robot_1"]), (again, ["robot_1", "other"])):
        result = map_merging.merge(file, second)
        assert result.merged is None
        assert result.about["robots"] == names
        for name in map_files.LAYOUT:
            assert (getattr(result.kept, name) == getattr(file.kept, name)).all()


def test_what_would_count_twice_is_refused(teams):
    file = teams[0]["robot_1"].file
    moved = file._replace(kept=replace(file.kept, positions=file.kept.positions + 1e-6))
    with pytest.raises(
        InputError, match=r"of both come from the same observations.* run BAG --map"
    ):
        map_merging.merge(file, moved)


def test_nothing_in_common_is_refused_with_the_numbers(teams):
    """Neither what looks like nothing, nor what looks alike and hangs otherwise."""
    made, _ = teams
    one, other = made["robot_1"].file, made["robot_2"].file
    rng = np.random.default_rng(0)
    looks = rng.random(other.kept.descriptors.shape).astype(np.float32)
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    strange = other._replace(kept=replace(other.kept, descriptors=looks))
    with pytest.raises(InputError, match="0 pairs of landmarks look alike, and no two of them"):
        map_merging.merge(one, strange)
    shuffled = rng.permutation(other.kept.positions)
    hung = other._replace(kept=replace(other.kept, positions=shuffled))
    with pytest.raises(InputError, match=r"not merged: of \d+ pairs .* at most 1e-06 may be"):
        map_merging.merge(one, hung)


def test_a_place_that_is_there_twice_is_refused(teams):
    """Two poses are as good as each other."""
    one = teams[0]["robot_1"].file
    kept = one.kept
    count = len(kept.ids)

    def twice(array):
        return np.concatenate([array, array])

    arrays = {name: getattr(kept, name) for name in map_files.LAYOUT}
    doubled = {k: twice(a) for k, a in arrays.items() if k not in ("together", "joint", "next_id")}
    doubled["ids"] = np.arange(2 * count)
    doubled["positions"] = twice(kept.positions) + np.repeat([[0, 0, 0], [80, 0, 0]], count, axis=0)
    doubled["together"] = np.kron(np.eye(2, dtype=bool), kept.together)
    doubled["joint"] = np.kron(np.eye(2), kept.joint)
    there_twice = one._replace(
        kept=replace(kept, **doubled, next_id=np.array(2 * count)),
    )
    other = one._replace(kept=replace(kept, descriptors=kept.descriptors * np.float32(1.001)))
    with pytest.raises(InputError, match="places on another pose"):
        map_merging.merge(there_twice, other)


def test_too_many_robots_are_refused(teams):
    file = teams[0]["robot_1"].file
    many = file._replace(about=file.about | {"robots": [f"r{i}" for i in range(63)]})
    with pytest.raises(InputError, match="give robots that are the same the same name"):
        map_merging.merge(file, many)
