"""Range-bearing recordings -> bags: odometry, points at the frames, their covariances."""

import numpy as np
import pytest

from msg_defs.types import CameraMount
from multi_robot_slam.datasets import bag, dead_reckoning, views
from multi_robot_slam.datasets.recording import Commands, Noise, Readings
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.models import stereo
from multi_robot_slam.models.symmetric import unpack

EXACT = Noise(0.05, 0.04, 0.015, 0.0, 0.0, 0.0, 0.0)
AHEAD = CameraMount(forward_m=0.3, left_m=0.0, up_m=0.0)


def nanoseconds(seconds):
    return np.rint(np.asarray(seconds) * 1e9).astype(np.int64)


@pytest.fixture
def commands():
    rng = np.random.default_rng(0)
    stamps = np.unique(rng.integers(0, 20_000, 60)) * 10**6
    return Commands(stamps, rng.uniform(-0.2, 0.5, len(stamps)), rng.normal(0, 0.5, len(stamps)))


def test_dead_reckoning_is_the_integral_of_the_commands_that_hold(commands):
    times = np.arange(0, 22, 2e-4)
    twists = dead_reckoning.twists_at(commands, nanoseconds(times))
    forward, yaw_rate = twists[:-1].T * 2e-4
    yaw = np.concatenate([[0], np.cumsum(yaw_rate)])
    middle = yaw[:-1] + yaw_rate / 2
    x, y = np.cumsum(forward * np.cos(middle)), np.cumsum(forward * np.sin(middle))
    poses = dead_reckoning.poses_at(commands, nanoseconds(times))
    np.testing.assert_allclose(poses[1:], np.column_stack([x, y, yaw[1:]]), atol=1e-6)


def test_a_robot_stands_before_its_first_command():
    commands = Commands(np.array([10**9, 2 * 10**9]), np.ones(2), np.ones(2))
    assert not dead_reckoning.poses_at(commands, np.array([0, 10**9])).any()
    assert not dead_reckoning.twists_at(commands, np.array([0])).any()


def exact_readings(commands, times, landmarks, mount):
    """What a perfect sensor at `mount` reads of all `landmarks` (N, 2) at `times`."""
    stamps = nanoseconds(times)
    parts = []
    for stamp, pose in zip(stamps, dead_reckoning.poses_at(commands, stamps), strict=True):
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        points = (landmarks - pose[:2]) @ np.array([[cos, -sin], [sin, cos]])
        x, y = (points - [mount.forward_m, mount.left_m]).T
        parts.append((np.full(len(x), stamp), np.arange(len(x)), np.hypot(x, y), np.arctan2(y, x)))
    return Readings(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def test_points_are_where_the_landmarks_are_as_seen_from_the_frame(commands):
    landmarks = np.random.default_rng(1).uniform(-20, 20, (9, 2))
    frames = nanoseconds(np.arange(3, 18))
    readings = exact_readings(commands, np.arange(2.1, 19, 0.37), landmarks, AHEAD)
    seen = views.views(readings, frames, commands, EXACT, AHEAD)
    assert len(seen.frames) > 30
    assert (seen.positions[:, 2] > 0).all()
    points, _ = stereo.to_body(seen.positions, seen.covariances, AHEAD)
    poses = dead_reckoning.poses_at(commands, frames)[seen.frames]
    places = [
        stereo.to_map(pose, point[None])[0] for pose, point in zip(poses, points, strict=True)
    ]
    expected = np.column_stack([landmarks[seen.targets], np.zeros(len(places))])
    np.testing.assert_allclose(places, expected, atol=1e-4)


def test_covariance_is_that_of_the_polar_reading_by_finite_differences():
    def point(distance, bearing):
        return np.array([distance * np.cos(bearing), distance * np.sin(bearing)])

    at, step = np.array([3.0, 0.4]), 1e-6
    jacobian = np.column_stack([(point(*(at + d)) - point(*(at - d))) / (2 * step)
                                for d in np.eye(2) * step])  # fmt: skip
    wanted = jacobian @ np.diag([0.17**2, 0.015**2]) @ jacobian.T
    still = Commands(np.array([0]), np.zeros(1), np.zeros(1))
    reading = Readings(nanoseconds([1.0]), np.array([0]), at[:1], at[1:])
    seen = views.views(reading, nanoseconds([0.0, 1.0, 2.0]), still, EXACT, AHEAD)
    _, covariances = stereo.to_body(seen.positions, seen.covariances, AHEAD)
    np.testing.assert_allclose(unpack(covariances)[0, :2, :2], wanted, rtol=1e-5)


def test_repeated_readings_tell_what_a_first_order_autoregression_tells():
    period, memory, count = 0.7, 2.0, 12
    noise = Noise(0.1, 0.0, 0.01, memory, 0.0, 0.0, 0.0)
    frames = nanoseconds(np.arange(count) * period)
    still = Commands(frames[:1], np.zeros(1), np.zeros(1))
    ones = np.ones(count)
    readings = Readings(frames, np.zeros(count, int), 2 * ones, 0 * ones)
    seen = views.views(readings, frames, still, noise, AHEAD)
    told = np.sum(1 / seen.covariances[:, 5])  # zz: along the line of sight
    apart = np.abs(np.subtract.outer(frames, frames)) * 1e-9
    correlated = 0.1**2 * np.exp(-apart / memory)
    assert told == pytest.approx(ones @ np.linalg.solve(correlated, ones), rel=1e-5)


def test_moving_a_reading_costs_certainty():
    noise = Noise(0.1, 0.0, 0.01, 0.0, 0.02, 0.0, 0.05)
    still = Commands(np.array([0]), np.zeros(1), np.zeros(1))
    readings = Readings(nanoseconds([1.0, 2.25]), np.arange(2), 2 * np.ones(2), np.zeros(2))
    seen = views.views(readings, nanoseconds([1.0, 2.0, 3.0]), still, noise, AHEAD)
    growth = seen.covariances[1].astype(float) - seen.covariances[0]
    np.testing.assert_allclose(growth[[0, 5]], [4 * 0.05**2 / 4, 0.02**2 / 4], rtol=1e-4)


def test_the_nearest_reading_of_each_target_counts_once_a_frame():
    times = np.array([0.2, 0.9, 1.05, 1.1, 1.4, 1.6, 3.6])
    targets = np.array([0, 0, 0, 1, 1, 0, 0])
    readings = Readings(nanoseconds(times), targets, np.ones(7), np.zeros(7))
    rows, frames = views.nearest(readings, nanoseconds([1.0, 2.0, 3.0]))
    assert (rows.tolist(), frames.tolist()) == ([2, 3, 5], [0, 0, 1])


def test_no_readings_are_no_views():
    nothing = Readings(*np.empty((2, 0), np.int64), *np.empty((2, 0)))
    still = Commands(np.array([0]), np.zeros(1), np.zeros(1))
    seen = views.views(nothing, nanoseconds([1.0, 2.0]), still, EXACT, AHEAD)
    assert [part.shape for part in seen] == [(0,), (0,), (0, 3), (0, 6)]


def test_identities_are_far_beyond_the_descriptor_gate():
    vectors = bag._descriptors(np.arange(20))
    apart = np.square(vectors[:, None] - vectors[None]).sum(axis=2)
    np.testing.assert_array_equal(apart, 2 * (1 - np.eye(20)))
    assert 0 < FilterSettings().descriptor_gate < 2
