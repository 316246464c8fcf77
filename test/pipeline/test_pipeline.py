"""The one door: order, pairing, and what is dropped."""

import itertools
from dataclasses import fields, replace

import numpy as np
import pytest
import worlds
from worlds import EVERYTHING

from msg_defs.types import ObservationSet, PoseSample
from multi_robot_slam.config import EVERY_FRAME, Config
from multi_robot_slam.filter import rbpf, resampling
from multi_robot_slam.filter.settings import ExistenceSettings, RejuvenationSettings
from multi_robot_slam.monitor import predictions
from multi_robot_slam.pipeline.pipeline import Pipeline

NAMES = ("robot_1", "robot_2", "robot_3")


def config(robots: int = 3, **changes) -> Config:
    return Config(
        robots=NAMES[:robots],
        start_poses=tuple(tuple(map(float, p)) for p in worlds.START[:robots]),
        start_sigma=(0.0, 0.0),
        mount=worlds.MOUNT,
        filter=worlds.settings(particles=20),
        **{"keyframe": EVERY_FRAME} | changes,
    )


def events(steps) -> list[list[PoseSample | ObservationSet]]:
    """Per robot, its odometry and observations in order; stamps 1 s, 2 s, ..."""
    streams = [[] for _ in steps[0]]
    poses = [np.zeros(3) for _ in steps[0]]
    for t, frames in enumerate(steps):
        for frame in frames:
            pose, u = poses[frame.robot], frame.motion
            c, s = np.cos(pose[2]), np.sin(pose[2])
            pose = np.array(
                [pose[0] + c * u[0] - s * u[1], pose[1] + s * u[0] + c * u[1], pose[2] + u[2]]
            )
            poses[frame.robot] = pose
            stamp, name, seen = (t + 1) * 10**9, NAMES[frame.robot], frame.observations
            streams[frame.robot] += [
                PoseSample(name, stamp, pose),
                ObservationSet(name, stamp, seen.positions, seen.covariances, seen.descriptors),
            ]
    return streams


def run(pipeline: Pipeline, sequence) -> list:
    return [step for event in sequence for step in pipeline.handle(event)] + pipeline.finish()


def summary(steps) -> list[tuple]:
    return [
        (s.stamp_ns, e.robot, e.pose.tobytes(), f.landmarks.tobytes(), f.mahalanobis.tobytes())
        for s in steps
        for e, f in zip(s.estimates, s.frames, strict=True)
    ]


def round_robin(streams):
    return [e for group in itertools.zip_longest(*streams) for e in group if e is not None]


def test_steps_equal_the_bare_filter():
    steps = worlds.drive(1, steps=10)
    pipeline = Pipeline(config())
    records = run(pipeline, round_robin(events(steps)))
    settings, rng = worlds.settings(particles=20), np.random.default_rng(0)
    state = rbpf.init(worlds.START, settings)
    for frames in steps:
        rbpf.step(state, frames, settings, rng)
    best = rbpf.best_particle(state)
    poses = np.array([e.pose for e in records[-1].estimates])
    np.testing.assert_allclose(np.cos(poses - state.poses[:, :, best]), 1, atol=1e-12)
    assert [r.step for r in records] == list(range(1, 11))
    assert all(len(r.frames) == 3 for r in records)


def test_warming_up_compiles_what_the_monitor_needs(monkeypatch):
    """Otherwise the first frame of a robot waits for it, and a camera beside it loses pictures."""
    moments, types = predictions.relative_moments, []

    def noted(*args):
        types.append([getattr(arg, "dtype", type(arg)) for arg in args])
        moments(*args)

    monkeypatch.setattr(predictions, "relative_moments", noted)
    own = config()
    often = RejuvenationSettings(ancestors_below=0.5)
    pipeline = Pipeline(replace(own, filter=replace(own.filter, rejuvenation=often)))
    pipeline.warm_up()
    warmed = types[0]
    types.clear()
    run(pipeline, round_robin(events(worlds.drive(1, steps=2))))
    assert len(types) > 1
    assert all(used == warmed for used in types)


@pytest.mark.parametrize("seed", range(5))
def test_arrival_order_does_not_matter(seed):
    """Any interleaving that keeps each topic's order gives the same bytes."""
    streams = events(worlds.drive(2, steps=12))
    topics = [
        [e for e in s if isinstance(e, kind)]
        for s in streams
        for kind in (PoseSample, ObservationSet)
    ]
    expected = summary(run(Pipeline(config(reorder_window_s=60)), round_robin(streams)))
    order = np.repeat(np.arange(6), 12)
    np.random.default_rng(seed).shuffle(order)
    iterators = [iter(t) for t in topics]
    pipeline = Pipeline(config(reorder_window_s=60))
    assert summary(run(pipeline, [next(iterators[i]) for i in order])) == expected
    assert not pipeline.dropped


def test_a_silent_robot_holds_the_others_for_the_window_only():
    streams = events(worlds.drive(3, steps=10))
    pipeline = Pipeline(config(reorder_window_s=3.0))
    talking = round_robin(streams[:2])
    done = [(e.stamp_ns, len(pipeline.handle(e))) for e in talking]
    first_step_at = next(stamp for stamp, steps in done if steps)
    assert first_step_at == 4 * 10**9
    assert sum(steps for _, steps in done) == 10


def test_a_robot_that_comes_back_is_filtered_again():
    """Its first frame finds that the others did not wait; from the next one on they do."""
    streams = events(worlds.drive(4, steps=20, robots=2))
    pipeline = Pipeline(config(2, reorder_window_s=3.0))
    absent = [e for e in streams[1] if not 6 * 10**9 <= e.stamp_ns <= 14 * 10**9]
    merged = sorted(streams[0] + absent, key=lambda e: e.stamp_ns)
    records = run(pipeline, merged)
    assert [len(r.frames) for r in records] == [2] * 5 + [1] * 10 + [2] * 5
    assert pipeline.dropped == {"late frame": 1}


def test_bad_order_is_dropped_counted_and_told():
    streams = events(worlds.drive(5, steps=8, robots=2))
    told = []
    pipeline = Pipeline(config(2, reorder_window_s=2.0), told.append)
    run(pipeline, round_robin(streams))
    for event in (streams[0][-1], streams[0][-3], streams[0][0]):
        assert pipeline.handle(event) == []
    stranger = PoseSample("robot_9", 10**10, np.zeros(3))
    pipeline.handle(stranger)
    assert pipeline.dropped == {
        "duplicate frame": 1,
        "late frame": 1,
        "odometry out of order": 1,
        "unknown robot": 1,
    }
    assert len(told) == 4
    assert "robot_9" in told[-1]
    assert "robot_1, robot_2" in told[-1]


def test_frames_without_odometry_are_dropped_when_the_window_is_over():
    streams = events(worlds.drive(6, steps=10, robots=2))
    blind = [e for e in streams[1] if isinstance(e, ObservationSet)]
    pipeline = Pipeline(config(2, reorder_window_s=2.0))
    records = run(pipeline, sorted(streams[0] + blind, key=lambda e: e.stamp_ns))
    assert set(pipeline.dropped) == {"frame without odometry", "late frame"}
    assert pipeline.dropped.total() == 10
    assert [len(r.frames) for r in records] == [1] * 10


def test_odometry_is_interpolated_at_the_frame():
    stream = events(worlds.drive(7, steps=2, robots=1))[0]
    seen = [e for e in stream if isinstance(e, ObservationSet)]
    pipeline = Pipeline(config(1))
    for stamp, x, yaw in ((10**9, 0.0, 3.1), (15 * 10**8, 1.0, -3.1), (25 * 10**8, 3.0, -3.0)):
        pipeline.handle(PoseSample("robot_1", stamp, np.array([x, 0.0, yaw])))
    assert [len(pipeline.handle(e)) for e in seen] == [1, 1]
    np.testing.assert_allclose(pipeline.odometry_pose("robot_1"), [2.0, 0.0, -3.05])


def test_map_and_paths_are_the_best_particle():
    steps = worlds.drive(8, steps=10)
    pipeline = Pipeline(config())
    records = run(pipeline, round_robin(events(steps)))
    landmarks, paths = pipeline.landmark_map(), pipeline.trajectories()
    assert landmarks.observations.sum() == 3 * 5 * 10
    assert set(landmarks.robots) <= set(range(1, 8))
    assert len(landmarks.ids) == len(landmarks.positions) == len(set(landmarks.ids))
    for estimate in records[-1].estimates:
        np.testing.assert_array_equal(paths[estimate.robot].poses[-1], estimate.pose)
        assert len(paths[estimate.robot].stamps_ns) == 10


def test_the_published_map_has_what_was_seen_from_two_places():
    """The others are as they were; what is published is so in every respect as without it."""
    stream = round_robin(events(worlds.drive(8, steps=10)))
    maps = []
    for existence in (EVERYTHING, ExistenceSettings()):
        settings = worlds.settings(particles=20, existence=existence)
        pipeline = Pipeline(replace(config(), filter=settings))
        run(pipeline, stream)
        maps.append(pipeline.landmark_map())
    whole, published = maps
    kept = np.isin(whole.ids, published.ids)
    assert 5 < kept.sum() < len(kept)
    for field in fields(whole):
        np.testing.assert_array_equal(
            getattr(whole, field.name)[kept], getattr(published, field.name)
        )
    np.testing.assert_array_equal(kept, whole.observations > 1)


def test_mean_paths_are_those_of_all_particles():
    pipeline = Pipeline(config())
    run(pipeline, round_robin(events(worlds.drive(9, steps=40))))
    state, means = pipeline._particles.state, pipeline.mean_trajectories()
    weights = resampling.normalise(state.log_weights)
    whole = [list(state.history.lineage(m))[::-1] for m in range(20)]
    for index, name in enumerate(NAMES):
        poses = [[r.poses[:, row] for r, row in past if r.robot == index] for past in whole]
        expected = np.tensordot(weights, np.array(poses), axes=1)
        difference = means[name].poses - expected
        np.testing.assert_allclose(difference[:, :2], 0, atol=1e-12)
        np.testing.assert_allclose(np.cos(difference[:, 2]), 1, atol=1e-12)


def test_estimates_have_the_particles_moments():
    pipeline = Pipeline(config(1))
    stream = events(worlds.drive(10, steps=1, robots=1))[0]
    (record,) = run(pipeline, stream)
    np.testing.assert_allclose(record.estimates[0].mean, worlds.START[0])
    np.testing.assert_allclose(record.estimates[0].covariance, 0, atol=1e-20)
