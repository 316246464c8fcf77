"""D of what is expected is chi2: truth and particles are draws from one posterior."""

import numpy as np
import pytest
import worlds
from scipy.stats import chi2, kstest

from multi_robot_slam.filter import rbpf
from multi_robot_slam.filter.landmarks import Landmarks
from multi_robot_slam.models.frames import RobotFrame, Start
from multi_robot_slam.models.motion import move, standard_deviations
from multi_robot_slam.models.symmetric import pack
from multi_robot_slam.monitor import predictions

WORLDS, PARTICLES = 400, 128
SETTINGS = worlds.settings(particles=PARTICLES)
MOTION = np.array([0.3, 0.02, 0.2])
POSE_SIGMAS = np.array([0.2, 0.1, 0.05])
START = np.array([3.0, -2.0, 2.0])
DESCRIPTOR = np.eye(1, 128, dtype=np.float32)


def root(rng, size):
    return size * (np.eye(3) + rng.normal(0, 0.3, (3, 3)))


def turned(yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def world(seed, noisier=1.0, starts=False):
    """D of one landmark, seen twice with `noisier` times the noise that is told.

    Truth and particles have a pose each. From there the landmark was seen, with an error in truth
    and an uncertainty in the particles; then the robot moves and sees it again.
    """
    rng = np.random.default_rng(seed)
    poses = START[:, None] + POSE_SIGMAS[:, None] * rng.standard_normal((3, PARTICLES + 1))
    first, again = root(rng, 0.05), root(rng, 0.05)
    landmark = rng.uniform([2, -2, 0], [6, 2, 2])
    seen = landmark + noisier * first @ rng.standard_normal(3)
    planes = np.empty((1, 9, PARTICLES), np.float32)
    for m in range(PARTICLES):
        x, y, yaw = poses[:, m]
        planes[0, :3, m] = turned(yaw) @ seen + [x, y, 0]
        planes[0, 3:, m] = pack(turned(yaw) @ first @ first.T @ turned(yaw).T)
    truth = poses[:, -1:].copy()
    place = turned(truth[2, 0]) @ landmark + [truth[0, 0], truth[1, 0], 0]
    sigma = standard_deviations(MOTION, 0.0, SETTINGS.motion)
    motion = MOTION + noisier * sigma * rng.standard_normal(3)
    move(truth, motion[:, None])
    start = None
    if starts:
        covariance = np.diag([0.04, 0.01, 0.01])
        start = Start(np.array([2.0, 1.0, -1.0]), covariance)
        truth = (start.mean + np.sqrt(np.diag(covariance)) * rng.standard_normal(3))[:, None]
        place = turned(poses[2, -1]) @ landmark + [*poses[:2, -1], 0]
    local = turned(truth[2, 0]).T @ (place - [truth[0, 0], truth[1, 0], 0])
    observed = local + noisier * again @ rng.standard_normal(3)
    state = rbpf.init(np.zeros((2, 3)), SETTINGS)
    robot = 1 if starts else 0
    state.poses[0] = poses[:, :-1]
    state.landmarks = Landmarks.holding(np.array([7]), planes, DESCRIPTOR.copy(), 8)
    noise = pack((again @ again.T)[None])
    told = np.zeros(3) if starts else MOTION
    frame = RobotFrame(robot, 0, told, observed[None], noise, DESCRIPTOR, start=start)
    before = state.poses.copy()
    found = predictions.predict(state, frame, SETTINGS)
    np.testing.assert_array_equal(state.poses, before)
    assert found.ids.tolist() == [7]
    assert found.next_id == 8
    return found.mahalanobis_sq[0]


@pytest.mark.parametrize("starts", [False, True], ids=["moves", "starts"])
def test_d_is_chi2_with_three_degrees(starts):
    squared = [world(seed, starts=starts) for seed in range(WORLDS)]
    assert kstest(squared, chi2(3).cdf).pvalue > 0.01


def test_noise_that_is_larger_than_told_is_seen_to_be():
    squared = [world(seed, noisier=1.5) for seed in range(WORLDS)]
    assert kstest(squared, chi2(3).cdf).pvalue < 1e-6


def pairs(observations, ids, squared):
    count = len(ids)
    points = np.arange(3.0 * count).reshape(count, 3)
    return predictions.Predictions(
        np.array(observations),
        np.array(ids, np.int32),
        np.array(squared, float),
        points,
        points + 1,
        np.ones(count),
        np.array([1.0, 2.0, np.pi / 2]),
        100,
    )


def test_of_each_observation_the_oldest_landmark_and_the_nearest():
    seen = pairs([0, 0, 2, 2, 2], [9, 4, 8, 3, 5], [1.0, 50.0, 7.0, 8.0, 0.5])
    assert seen.oldest().ids.tolist() == [4, 3]
    assert seen.oldest().mahalanobis_sq.tolist() == [50.0, 8.0]
    assert seen.nearest().tolist() == [1.0, 0.5]
    nothing = seen.only(np.zeros(5, bool))
    assert not len(nothing.oldest().ids)
    assert not len(nothing.nearest())


def test_in_the_map_as_seen_from_the_pose():
    points, places, _ = pairs([0], [1], [1.0]).in_map()
    np.testing.assert_allclose(places, [[0.0, 2.0]], atol=1e-12)
    np.testing.assert_allclose(points, [[-1.0, 3.0]], atol=1e-12)


def test_an_unusable_frame_expects_nothing():
    state = rbpf.init(np.zeros((1, 3)), SETTINGS)
    frame = RobotFrame(0, 0, np.zeros(3), np.full((1, 3), np.nan), np.eye(1, 6), DESCRIPTOR)
    assert not len(predictions.predict(state, frame, SETTINGS).ids)
