"""Which frames become steps, and what is published between them."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import recordings
import worlds
from hypothesis import given, settings
from hypothesis import strategies as st

from msg_defs.errors import InputError
from msg_defs.types import EncodedObservations, FrameCount, ObservationSet, PoseSample, Sightings
from multi_robot_slam import runs
from multi_robot_slam.config import EVERY_FRAME, Config, Keyframe
from multi_robot_slam.filter import rbpf
from multi_robot_slam.filter.settings import RejuvenationSettings
from multi_robot_slam.models.motion import increment, move
from multi_robot_slam.pipeline import offline
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs.consistency import published_errors
from sim_world.scenario import Scenario
from test.pipeline.test_pipeline import events, round_robin, summary

TENTH = 10**8
NAMES = ("a", "b", "c")


def team(robots=1, told=None, particles=20, **changes):
    config = Config(
        robots=NAMES[:robots],
        start_poses=tuple((2.0 * i, 0.0, 0.0) for i in range(robots)),
        filter=worlds.settings(particles=particles),
        **changes,
    )
    return Pipeline(config, (lambda text: None) if told is None else told.append)


def odometry(robot, tenths, x=0.0, y=0.0, yaw=0.0):
    return PoseSample(robot, tenths * TENTH, np.array([x, y, yaw]))


def cloud(robot, tenths):
    nothing = (np.empty((0, size), np.float32) for size in (3, 6, 128))
    return ObservationSet(robot, tenths * TENTH, *nothing)


def sees(robot, tenths, *others):
    positions = np.tile([0.0, 0.0, 2.0], (len(others), 1))
    covariances = np.tile([0.01, 0, 0, 0.01, 0, 0.01], (len(others), 1))
    return Sightings(robot, tenths * TENTH, np.array(others, np.uint32), positions, covariances)


def run(pipeline, sent):
    """Steps and predictions, in the order of the events, and then what was held back."""
    steps, predictions = [], []
    rest = offline.run_through(pipeline, sent, steps.append, predictions.append)
    return [*steps, *rest[len(steps) :]], predictions


def drive(poses, robot="a"):
    return [
        event
        for tenths, pose in enumerate(poses, start=1)
        for event in (odometry(robot, tenths, *pose), cloud(robot, tenths))
    ]


def stamps_of(steps):
    return [step.stamp_ns // TENTH for step in steps]


def test_a_robot_that_stands_still_makes_one_step_and_holds_up_nobody():
    standing, driving = (
        drive([(0, 0, 0)] * 50, "a"),
        drive([(0.3 * i, 0, 0) for i in range(50)], "b"),
    )
    pipeline = team(2)
    steps, _ = run(pipeline, [e for pair in zip(standing, driving, strict=True) for e in pair])
    frames = [[frame.robot for frame in step.frames] for step in steps]
    assert frames == [["a", "b"]] + [["b"]] * 49
    assert not pipeline.dropped
    assert pipeline.frames() == {"a": FrameCount(50, 1), "b": FrameCount(50, 50)}


@pytest.mark.parametrize(
    ("each", "expected"),
    [
        ((0.06, 0.0, 0.0), [1, 6, 11, 16]),  # five make 0.30 m
        ((0.0, 0.0, 0.04), [1, 5, 9, 13, 17]),  # four make 0.16 rad
        ((0.0, 0.0, 0.0), [1]),
    ],
)
def test_a_frame_is_a_step_once_its_robot_has_moved_or_turned_so_far(each, expected):
    steps, _ = run(team(), drive([np.multiply(each, i) for i in range(20)]))
    assert stamps_of(steps) == expected


@pytest.mark.parametrize(("distance_m", "yaw_rad"), [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0)])
def test_with_a_threshold_of_zero_every_frame_is_a_step(distance_m, yaw_rad):
    keyframe = Keyframe(distance_m=distance_m, yaw_rad=yaw_rad)
    steps, predictions = run(team(keyframe=keyframe), drive([(0, 0, 0)] * 8))
    assert stamps_of(steps) == list(range(1, 9))
    assert not predictions


def test_every_frame_a_step_is_the_bare_filter_byte_for_byte():
    frames = worlds.drive(1, steps=10)
    config = Config(
        robots=("robot_1", "robot_2", "robot_3"),
        start_poses=tuple(tuple(map(float, pose)) for pose in worlds.START),
        mount=worlds.MOUNT,
        keyframe=EVERY_FRAME,
        filter=worlds.settings(particles=20),
    )
    given_out, step = [], rbpf.step
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rbpf, "step", lambda *args: given_out.append(args[1]) or step(*args))
        records, predictions = run(Pipeline(config), round_robin(events(frames)))
    state, rng = rbpf.init(worlds.START, config.filter), np.random.default_rng(0)
    for made, record in zip(given_out, records, strict=True):
        info = rbpf.step(state, made, config.filter, rng)
        means = [mean for mean, _ in info.moments]
        np.testing.assert_array_equal(
            [e.mean[:2] for e in record.estimates], np.array(means)[:, :2]
        )
    assert [len(made) for made in given_out] == [3] * 10
    assert not predictions


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_motion_between_keyframes_accumulates_exactly(seed):
    rng = np.random.default_rng(seed)
    poses = np.cumsum(rng.normal(0, [0.1, 0.1, 0.1], (30, 3)), axis=0)
    given_out = []
    right = rbpf.step
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rbpf, "step", lambda *args: given_out.append(args[1][0]) or right(*args))
        run(team(), drive(poses))
    assert 1 < len(given_out) < 30
    total = np.zeros((3, 1))
    for frame in given_out:
        move(total, frame.motion[:, None])
    last = given_out[-1].stamp_ns // TENTH - 1
    expected = increment(poses[0], poses[last])
    np.testing.assert_allclose(total[:2, 0], expected[:2], atol=1e-9)
    assert np.cos(total[2, 0] - expected[2]) == pytest.approx(1)
    assert sum(frame.seconds for frame in given_out) == pytest.approx(last / 10)


@pytest.mark.parametrize("seed", range(3))
def test_arrival_order_across_topics_does_not_matter(seed):
    rng = np.random.default_rng(seed)
    streams = []
    for robot in NAMES[:2]:
        own = drive(np.cumsum(rng.normal(0, 0.08, (25, 3)), axis=0), robot)
        streams += [own[::2], own[1::2]]
    steps, _ = run(
        team(2, reorder_window_s=60.0), [e for row in zip(*streams, strict=True) for e in row]
    )
    order = np.repeat(np.arange(4), 25)
    rng.shuffle(order)
    iterators = [iter(stream) for stream in streams]
    again, _ = run(team(2, reorder_window_s=60.0), [next(iterators[i]) for i in order])
    assert summary(again) == summary(steps)
    assert 1 < len(steps) < 25


# What a robot sees of others


def beside_each_other(tenths, x_of_b=0.0):
    return [
        odometry("a", tenths),
        odometry("b", tenths, x_of_b),
        sees("a", tenths, 1),
        sees("b", tenths, 0),
        cloud("a", tenths),
        cloud("b", tenths),
    ]


def test_robots_that_stand_and_see_each_other_make_one_step():
    pipeline = team(2, sightings=True)
    steps, _ = run(pipeline, [e for t in range(1, 40) for e in beside_each_other(t)])
    assert [len(frame.others) for frame in steps[0].frames] == [1, 1]
    assert stamps_of(steps) == [1]
    assert not pipeline.dropped


def test_who_sees_a_robot_that_has_moved_has_a_keyframe_with_it():
    pipeline = team(2, sightings=True)
    sent = [e for t in range(1, 12) for e in beside_each_other(t, 0.1 * (t - 1))]
    steps, _ = run(pipeline, sent)
    assert stamps_of(steps) == [1, 4, 7, 10]
    assert all([frame.robot for frame in step.frames] == ["a", "b"] for step in steps)
    assert all(len(frame.others) == 1 for step in steps for frame in step.frames)


def test_a_robot_that_comes_into_view_is_a_keyframe_once():
    pipeline = team(2, sightings=True)
    sent = []
    for t in range(1, 12):
        seen = (1,) if t > 5 else ()
        sent += [odometry("a", t), odometry("b", t), sees("a", t, *seen), sees("b", t)]
        sent += [cloud("a", t), cloud("b", t)]
    steps, _ = run(pipeline, sent)
    assert stamps_of(steps) == [1, 6]
    assert [len(step.frames) for step in steps] == [2, 2]


def test_who_watches_a_robot_pass_has_keyframes_of_it():
    """a stands and sees b, which drives and sends no clouds."""
    pipeline, sent = team(2, sightings=True), []
    for t in range(1, 12):
        sent += [odometry("a", t), odometry("b", t, 0.1 * (t - 1)), sees("a", t, 1), cloud("a", t)]
    steps, _ = run(pipeline, sent)
    assert stamps_of(steps) == [1, 4, 7, 10]
    assert all([frame.robot for frame in step.frames] == ["a", "b"] for step in steps)
    assert pipeline.frames() == {"a": FrameCount(11, 4), "b": FrameCount(0, 0)}


def test_frames_without_clouds_do_not_keep_a_robots_own_from_becoming_keyframes():
    """b drives and is seen between its clouds: its own are keyframes all the same."""
    pipeline, encoded, sent = team(2, sightings=True), Encoded(), []
    for t in range(1, 41):
        sent += [odometry("a", t, 0.1 * t), odometry("b", t, 0.1 * t)]
        of_a = [sees("a", t, 1), cloud("a", t)]
        sent += of_a if t % 2 else [sees("b", t), encoded.cloud("b", t)]
    run(pipeline, sent)
    assert len(encoded.decoded) == pipeline.frames()["b"].used >= 9


# Clouds that are decoded when they are used


class Encoded:
    """Clouds that count how often they were decoded."""

    def __init__(self, bad=()):
        self.bad, self.decoded = set(bad), []

    def cloud(self, robot, tenths):
        return EncodedObservations(robot, tenths * TENTH, partial(self._decode, robot, tenths))

    def _decode(self, robot, tenths):
        self.decoded.append(tenths)
        if tenths in self.bad:
            raise InputError(f"observations of {robot}: 3 bytes are no cloud")
        return cloud(robot, tenths)


def encoded_drive(encoded, poses):
    return [
        encoded.cloud(event.robot, event.stamp_ns // TENTH)
        if isinstance(event, ObservationSet)
        else event
        for event in drive(poses)
    ]


def test_only_keyframes_are_decoded():
    encoded = Encoded(bad=[3, 4])
    pipeline = team()
    steps, _ = run(pipeline, encoded_drive(encoded, [(0.06 * i, 0, 0) for i in range(20)]))
    assert encoded.decoded == stamps_of(steps) == [1, 6, 11, 16]
    assert not pipeline.dropped


def test_a_keyframe_that_cannot_be_decoded_is_told_and_the_next_frame_takes_its_place():
    told, encoded = [], Encoded(bad=[1, 7, 8])
    pipeline = team(told=told)
    steps, _ = run(pipeline, encoded_drive(encoded, [(0.06 * i, 0, 0) for i in range(14)]))
    assert stamps_of(steps) == [2, 9, 14]
    assert pipeline.dropped == {"bad observations of a": 3}
    assert told == ["dropped observations of a: 3 bytes are no cloud"] * 3
    assert pipeline.frames() == {"a": FrameCount(11, 3)}


def test_nothing_but_bad_clouds_are_all_told_and_hold_up_nobody():
    encoded, pipeline = Encoded(bad=range(100)), team(2)
    bad = encoded_drive(encoded, [(0, 0, 0)] * 20)
    good = drive([(0.3 * i, 0, 0) for i in range(20)], "b")
    steps = [s for pair in zip(bad, good, strict=True) for e in pair for s in pipeline.handle(e)]
    assert len(steps) == 20
    assert pipeline.dropped == {"bad observations of a": 20}


# Predictions


def test_predictions_go_on_from_the_last_step_as_soon_as_odometry_comes():
    pipeline = team()
    pipeline.handle(odometry("a", 1))
    (step,) = pipeline.handle(cloud("a", 1))
    before = step.estimates[0]
    for tenths, (x, y, yaw) in [(2, (0.05, 0.0, 0.1)), (3, (0.1, 0.02, -0.1))]:
        sample = odometry("a", tenths, x, y, yaw)
        assert pipeline.handle(sample) == []
        predicted = pipeline.predict(sample)
        assert predicted.stamp_ns == sample.stamp_ns
        np.testing.assert_allclose(predicted.pose, before.pose + np.array([x, y, yaw]), atol=1e-12)
        assert np.trace(predicted.covariance) > np.trace(before.covariance)


def test_what_is_not_newer_than_the_step_or_was_not_taken_gives_no_prediction():
    pipeline = team()
    late, ahead = odometry("a", 1), odometry("a", 5, 0.3)
    for event in (late, ahead):
        pipeline.handle(event)
        assert pipeline.predict(event) is None  # there is no step yet
    (step,) = pipeline.handle(cloud("a", 5))
    assert step.stamp_ns == 5 * TENTH
    assert pipeline.predict(ahead) is None
    refused = [
        odometry("a", 4),  # out of order
        odometry("a", 6, np.nan),
        odometry("a", 6, 1e9),  # off the Earth
        odometry("a", 6, 50.0),  # doubted
        odometry("nobody", 6),
        cloud("a", 6),
    ]
    for event in refused:
        pipeline.handle(event)
        assert pipeline.predict(event) is None
    good = odometry("a", 7, 0.35)
    pipeline.handle(good)
    assert pipeline.predict(good).pose[0] == pytest.approx(
        step.estimates[0].pose[0] + 0.05, abs=1e-3
    )


def test_after_a_step_predictions_continue_from_it():
    """A step that waited for others is older than odometry: what comes next starts there."""
    pipeline = team(2)
    for event in (odometry("a", 1), odometry("b", 1), cloud("a", 1), cloud("b", 1)):
        pipeline.handle(event)
    for event in (odometry("a", 4, 0.3), cloud("a", 4), odometry("a", 5, 0.4)):
        assert not pipeline.handle(event)
    assert pipeline.predict(event).pose[0] == pytest.approx(0.4)
    pipeline.handle(odometry("b", 4))
    (step,) = pipeline.handle(cloud("b", 4))
    sample = odometry("a", 6, 0.5)
    pipeline.handle(sample)
    x = step.estimates[0].pose[0] + 0.2
    assert pipeline.predict(sample).pose[0] == pytest.approx(x, abs=0.01)


def test_predictions_are_what_the_filter_believes_where_nothing_is_seen():
    """At the next keyframe mean and covariance of the particles are those that were predicted."""
    pipeline = team()
    own = worlds.settings(particles=20_000, resample_below=0.0, rejuvenation=RejuvenationSettings())
    pipeline = Pipeline(replace(pipeline.config, filter=own))
    predicted, compared = None, 0
    for event in drive([(0.3 * i, 0.02 * i, 0.1 * i) for i in range(6)]):
        for step in pipeline.handle(event):
            (estimate,) = step.estimates
            if predicted is not None:
                compared += 1
                scale = np.sqrt(np.diag(predicted.covariance))
                assert np.abs((estimate.mean - predicted.pose) / scale).max() < 0.03
                both = np.array([estimate.covariance, predicted.covariance])
                both /= np.outer(scale, scale)
                np.testing.assert_allclose(both[0], both[1], atol=0.06)
        predicted = pipeline.predict(event) or predicted
    assert compared == 5


def test_a_run_keeps_what_was_predicted_and_reads_it_again(tmp_path):
    scenario = Scenario(robots=2, movements=1000, period_s=0.1, observations=5)
    _, config = recordings.record(tmp_path / "bag", scenario, steps=25)
    run = offline.estimate(tmp_path / "bag", config, warn=pytest.fail)
    figures = runs.evaluate(run)
    assert figures["frames"] == 50
    assert figures["keyframes"] == sum(len(step.frames) for step in run.steps)
    runs.write_estimates(run, tmp_path / "out")
    runs.write(run, figures, tmp_path / "out")
    again = runs.load(tmp_path / "out")
    assert again.frames == run.frames
    for name, robot in run.robots.items():
        read = again.robots[name]
        assert len(robot.predicted.stamps_ns) > 0
        np.testing.assert_array_equal(read.predicted.stamps_ns, robot.predicted.stamps_ns)
        np.testing.assert_allclose(read.predicted.poses, robot.predicted.poses, atol=1e-12)
        np.testing.assert_array_equal(read.predicted.covariances, robot.predicted.covariances)
        np.testing.assert_array_equal(read.online.stamps_ns, robot.online.stamps_ns)
        assert len(robot.online.stamps_ns) == 25
        at_steps = {e.stamp_ns: e.pose for s in run.steps for e in s.estimates if e.robot == name}
        for stamp_ns, pose in zip(robot.online.stamps_ns, robot.online.poses, strict=True):
            np.testing.assert_array_equal(pose, at_steps.get(int(stamp_ns), pose))
    judged = published_errors(again)
    assert [len(errors) for errors, _ in judged.values()] == [25, 25]
    assert runs.evaluate(again)["pose_nees"] == pytest.approx(figures["pose_nees"])
