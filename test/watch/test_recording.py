"""What a recording says was known at any time, against taking its messages one by one."""

from dataclasses import replace

import numpy as np
import pytest
import recordings

from msg_defs import topics, wire
from msg_defs.errors import InputError
from multi_robot_slam import runs
from multi_robot_slam.bags import BagReader, BagWriter
from multi_robot_slam.runs import evaluation
from multi_robot_slam.watch import recording
from multi_robot_slam.watch.inputs import inputs
from multi_robot_slam.watch.recording import Recording
from multi_robot_slam.watch.watched import Watched
from test.helpers import fake_run
from test.watch import published


def taken_one_by_one(bag, config, end_ns):
    """The slow, obvious way."""
    wanted = {f"/{topic.name.lstrip('/')}": how for topic, how in inputs(config.robots).items()}
    watched = Watched(config)
    for record in BagReader(bag):
        if record.topic in wanted and record.stamp_ns <= end_ns:
            how = wanted[record.topic]
            how.take(watched, how.decode(record.data))
    return watched


def told(watched):
    """All of it, to be compared."""
    landmarks = None if watched.landmarks is None else watched.landmarks.ids.tolist()
    robots = [
        (
            robot.estimate and robot.estimate.pose.tolist(),
            [pose.stamp_ns for pose in robot.trail],
            None if robot.path is None else robot.path.poses.tolist(),
            None if robot.particles is None else robot.particles.tolist(),
            robot.frame and robot.frame.landmarks.tolist(),
        )
        for robot in watched.robots.values()
    ]
    steps = [step.step for step in watched.steps]
    return landmarks, robots, steps, [*watched.lags], watched.statuses, watched.walls is None


@pytest.fixture
def bag(tmp_path):
    published.record(tmp_path / "bag")
    return tmp_path / "bag"


def test_every_time_is_as_if_one_had_listened_until_then(bag):
    found = Recording(bag)
    assert found.end_ns - found.begin_ns == 1_900_000_000
    for seconds in (0.0, 0.35, 1.9, 0.1, 1.2, 1.2, 0.0, 5.0):
        at_ns = found.begin_ns + round(seconds * 1e9)
        expected = taken_one_by_one(bag, found.config, at_ns)
        assert told(found.at(at_ns)) == told(expected), seconds


def test_a_run_s_folder_is_its_bag(bag):
    assert told(Recording(bag.parent).at(10**19)) == told(Recording(bag).at(10**19))


def test_of_many_maps_some_are_kept_and_the_last(bag, monkeypatch):
    monkeypatch.setattr(recording, "MOST_VERSIONS", 5)
    found = Recording(bag)
    counts = []
    for row in range(20):
        found_map = found.at(found.begin_ns + row * 100_000_000).landmarks
        counts.append(len(found_map.ids))
    assert sorted(set(counts)) == [1, 5, 8]  # of 1 to 8, and eight from then on
    assert counts[-1] == 8
    assert len(found.at(found.end_ns).steps) == 20


@pytest.fixture
def offline(tmp_path):
    """The folder of an offline run on a bag with walls."""
    run = fake_run(steps=20, landmarks=40)
    recordings.record(tmp_path / "recorded", steps=2)
    run = replace(run, bag=tmp_path / "recorded")
    folder = tmp_path / "offline"
    folder.mkdir()
    runs.write_estimates(run, folder)
    runs.write(run, evaluation.evaluate(run), folder)
    return run, folder


def test_the_map_of_an_offline_run_grows_by_what_was_seen(offline):
    run, folder = offline
    found = Recording(folder)
    for row in (0, 7, 19, 3):
        seen = {i for s in run.steps[: row + 1] for f in s.frames for i in f.landmarks.tolist()}
        watched = found.at(run.steps[row].stamp_ns)
        expected = set(run.landmarks.ids.tolist()) if row == 19 else seen
        assert set(watched.landmarks.ids.tolist()) == expected
        rows = np.isin(run.landmarks.ids, watched.landmarks.ids)
        np.testing.assert_array_equal(watched.landmarks.positions, run.landmarks.positions[rows])


def test_an_offline_run_has_the_walls_of_its_recording(offline):
    run, folder = offline
    assert Recording(folder).at(run.steps[0].stamp_ns).walls is not None
    (run.bag / "metadata.yaml").unlink()
    for file in run.bag.iterdir():
        file.unlink()
    run.bag.rmdir()
    assert Recording(folder).at(run.steps[0].stamp_ns).walls is None


def test_what_is_damaged_is_passed_over(tmp_path):
    run = fake_run(steps=4)
    with BagWriter(tmp_path / "bag") as bag:
        for stamp_ns, topic, data in published.messages(run):
            bag.write(topic, stamp_ns, data)
            if topic in (topics.MAP_LANDMARKS, topics.pose("robot_1")):
                bag.write(topic, stamp_ns, data[:-30])
    found = Recording(tmp_path / "bag")
    assert len(found.at(found.end_ns).landmarks.ids) == 4


def test_a_recording_without_estimates_says_what_is_missing(tmp_path):
    recordings.record(tmp_path / "bag")
    with pytest.raises(InputError, match=r"holds no estimates: /fusion/steps not in it"):
        Recording(tmp_path / "bag")
    with BagWriter(tmp_path / "empty") as bag:
        bag.write(topics.WORLD_CONFIG, 1, wire.encode_text(""))
    with pytest.raises(InputError, match=r"holds no estimates: /fusion/config not in it"):
        Recording(tmp_path / "empty")
