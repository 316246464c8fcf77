"""Sightings meet their frames, or are dropped and told of."""

import numpy as np

from msg_defs.types import ObservationSet, PoseSample, Sightings
from multi_robot_slam.config import EVERY_FRAME, Config
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.pipeline.reorder import UNPLACED

NAMES = ("a", "b", "c", "d")
SECOND = 10**9


def team(told=None):
    config = Config(
        robots=NAMES,
        start_poses=tuple((2.0 * i, 0.0, 0.0) for i in range(len(NAMES))),
        sightings=True,
        reorder_window_s=1.0,
        keyframe=EVERY_FRAME,
        filter=FilterSettings(particles=5),
    )
    return Pipeline(config, (lambda text: None) if told is None else told.append)


def odometry(robot, second):
    return PoseSample(robot, int(second * SECOND), np.zeros(3))


def cloud(robot, second):
    nothing = np.empty((0, 3)), np.empty((0, 6)), np.empty((0, 128))
    return ObservationSet(robot, int(second * SECOND), *nothing)


def sees(robot, second, *others):
    positions = np.tile([0.0, 0.0, 2.0], (len(others), 1))
    covariances = np.tile([0.01, 0, 0, 0.01, 0, 0.01], (len(others), 1))
    stamp_ns, indices = int(second * SECOND), np.array(others, np.uint32)
    return Sightings(robot, stamp_ns, indices, positions, covariances)


def handle(pipeline, *events):
    return [step for event in events for step in pipeline.handle(event)]


def test_sightings_of_a_robot_without_clouds_are_dropped_once_their_time_has_passed():
    pipeline, seconds, steps = team(), range(1, 40), []
    for second in seconds:
        of_b = odometry("b", second), sees("b", second, 0), sees("b", second + 0.5, 0)
        of_a = odometry("a", second), sees("a", second), cloud("a", second)
        steps += handle(pipeline, *of_b, *of_a)
    assert len(steps + pipeline.finish()) == len(seconds)
    assert pipeline.dropped == {"sighting without a frame": 2 * len(seconds) - 1}


def test_sightings_that_come_before_their_frame_are_used():
    pipeline = team()
    steps = []
    for second in range(1, 10):
        steps += handle(pipeline, odometry("a", second), odometry("b", second))
        steps += handle(
            pipeline, sees("b", second, 0), sees("a", second, 1), sees("b", second + 0.2)
        )
        steps += handle(pipeline, cloud("a", second), cloud("b", second), cloud("b", second + 0.2))
        steps += handle(pipeline, odometry("b", second + 0.2))
    steps += pipeline.finish()
    assert not pipeline.dropped
    assert [len(s.frames) for s in steps] == [2, 1] * 9


def test_who_sees_a_robot_without_odometry_is_named_and_nobody_else():
    told = []
    pipeline = team(told)
    handle(pipeline, *(odometry(robot, 1) for robot in "abc"))
    handle(pipeline, sees("a", 1, 1), sees("b", 1, 3), sees("c", 1, 0))
    handle(pipeline, *(cloud(robot, 1) for robot in "abc"))
    (step,) = pipeline.finish()
    assert [len(frame.others) for frame in step.frames] == [1, 0, 1]
    assert pipeline.dropped == {UNPLACED: 1}
    assert "dropped b at 1.000 s" in told[0]
    assert "it sees d;" in told[0]


def test_each_who_sees_robots_without_odometry_is_told_of_its_own():
    told = []
    pipeline = team(told)
    handle(pipeline, odometry("a", 1), odometry("b", 1))
    handle(pipeline, sees("a", 1, 2), sees("b", 1, 2, 3), cloud("a", 1), cloud("b", 1))
    pipeline.finish()
    assert pipeline.dropped == {UNPLACED: 2}
    assert [text.partition("it sees ")[2].partition(";")[0] for text in told] == ["c", "c, d"]
