"""Where a robot is believed to be at its first frame: start pose, odometry, and their errors."""

from dataclasses import replace

import numpy as np
import pytest

from msg_defs.types import ObservationSet, PoseSample
from multi_robot_slam.config import EVERY_FRAME, Config, Plausible
from multi_robot_slam.filter.settings import NO_REJUVENATION, FilterSettings
from multi_robot_slam.models.motion import MotionSettings, increment, least_covariance, move
from multi_robot_slam.pipeline.odometry import Odometry
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.pipeline.start import start_of

SECOND = 10**9
START = (2.0, -1.0, 0.6)
CONFIG = Config(
    robots=("a", "b"),
    start_poses=((0.0, 0.0, 0.0), START),
    keyframe=EVERY_FRAME,
    filter=FilterSettings(particles=5, rejuvenation=NO_REJUVENATION),
)
EXACT = replace(CONFIG, start_sigma=(0.0, 0.0))
B = 1


def heard(*samples):
    """What an `Odometry` has of these samples, each (second, pose, covariance)."""
    odometry = Odometry(Plausible(), MotionSettings(), lambda sample, refusal: None)
    for second, pose, covariance in samples:
        told = np.array(pose, float), np.zeros(2), np.array(covariance, float)
        odometry.take(PoseSample("b", round(second * SECOND), *told))
    return odometry


def arc(count, speed=0.5, turn=0.2):
    """A sample a second along an arc, without covariance."""
    pose, samples = np.zeros((3, 1)), []
    for second in range(count):
        samples.append((second, pose[:, 0].copy(), np.zeros((3, 3))))
        move(pose, np.array([[speed], [0.0], [turn]]))
    return samples


def composed(pose, motion):
    result = np.array(pose, float)[:, None]
    move(result, np.array(motion, float)[:, None])
    return result[:, 0]


def test_at_the_origin_of_its_odometry_a_robot_is_where_it_was_told_to_be():
    odometry = heard(*[(second, (0, 0, 0), 0.001 * np.eye(3)) for second in range(3)])
    start = start_of(B, 2 * SECOND, odometry, EXACT)
    assert start.mean.tobytes() == np.array(START).tobytes()
    assert not start.covariance.any()
    each = replace(CONFIG, start_sigmas=((0.0, 0.0), (0.3, 0.1)))
    start = start_of(B, 2 * SECOND, odometry, each)
    np.testing.assert_allclose(start.covariance, np.diag([0.09, 0.09, 0.01]), atol=1e-16)


def test_the_first_robot_is_known_unless_it_is_told_otherwise():
    odometry = heard((0, (0, 0, 0), np.zeros((3, 3))))
    assert not start_of(0, 0, odometry, CONFIG).covariance.any()
    each = replace(CONFIG, start_sigmas=((0.2, 0.1), (0.0, 0.0)))
    assert start_of(0, 0, odometry, each).covariance[2, 2] == pytest.approx(0.01)
    assert not start_of(B, 0, odometry, each).covariance.any()


def test_the_first_robot_s_error_is_the_others():
    """All starts err alike; then the team is turned and shifted until the first is where told."""
    sigma = (0.02, 0.03)
    rng, count = np.random.default_rng(0), 100_000
    errors = rng.normal(size=(2, 3, count)) * np.array([sigma[0], sigma[0], sigma[1]])[:, None]
    first, second = np.zeros((3, 1)) + errors[0], np.array(START)[:, None] + errors[1]
    cos, sin = np.cos(first[2]), np.sin(first[2])
    x, y = second[:2] - first[:2]
    seen = np.array([cos * x + sin * y, cos * y - sin * x, second[2] - first[2]])
    odometry = heard((0, (0, 0, 0), np.zeros((3, 3))))
    start = start_of(B, 0, odometry, replace(CONFIG, start_sigma=sigma))
    scale = np.sqrt(np.diag(start.covariance))
    np.testing.assert_allclose(
        np.cov(seen) / np.outer(scale, scale), start.covariance / np.outer(scale, scale), atol=0.02
    )


def test_a_later_frame_is_where_odometry_has_taken_the_robot():
    odometry = heard(*arc(9))
    where = odometry.at(round(7.5 * SECOND))
    start = start_of(B, round(7.5 * SECOND), odometry, EXACT)
    np.testing.assert_allclose(start.mean, composed(START, where), atol=1e-12)
    assert np.linalg.eigvalsh(start.covariance)[0] > 0


@pytest.mark.parametrize("from_second", [0, 5])
def test_odometry_that_was_heard_late_tells_the_same(from_second):
    """The robot went on while nobody listened; only the time it took is unknown."""
    early = start_of(B, 8 * SECOND, heard(*arc(9)), EXACT)
    late = start_of(B, 8 * SECOND, heard(*arc(9)[from_second:]), EXACT)
    np.testing.assert_allclose(late.mean, early.mean, atol=1e-12)
    np.testing.assert_allclose(late.covariance, early.covariance, atol=1e-12)


def test_from_its_first_message_on_a_robot_has_moved_by_the_difference():
    config = replace(EXACT, start_at="first message")
    samples = arc(12)
    start = start_of(B, 8 * SECOND, heard(*samples[5:]), config)
    way = increment(samples[5][1], samples[8][1])
    np.testing.assert_allclose(start.mean, composed(START, way), atol=1e-12)
    assert np.trace(start.covariance) < 0.01
    at_once = start_of(B, 5 * SECOND, heard(*samples[5:]), config)
    assert at_once.mean.tobytes() == np.array(START).tobytes()
    assert not at_once.covariance.any()


def test_a_first_message_that_was_taken_back_is_not_the_first():
    odometry = heard((9, (7, 0, 0), np.zeros((3, 3))), (1, (1, 0, 0), np.zeros((3, 3))))
    start = start_of(B, SECOND, odometry, replace(EXACT, start_at="first message"))
    np.testing.assert_array_equal(start.mean, START)


def test_after_a_reset_the_way_before_it_counts():
    poses = [(0.5 * i, 0.0, 0.0) for i in range(20)] + [(0.1 * i - 40, 0.0, 0.0) for i in range(6)]
    told = 0.5 * np.eye(3)
    odometry = heard(*[(0.1 * i, pose, told) for i, pose in enumerate(poses)])
    start = start_of(B, round(2.5 * SECOND), odometry, EXACT)
    np.testing.assert_allclose(start.mean, composed(START, (9.5 + 0.5, 0, 0)), atol=1e-9)
    assert start.covariance[2, 2] < 0.1  # not what the driver says of another way


USABLE = np.array([[0.5, 0.1, 0.0], [0.1, 0.4, 0.05], [0.0, 0.05, 0.2]])


@pytest.mark.parametrize(
    "told",
    [
        np.zeros((3, 3)),
        np.diag([1e-3, 1e-3, 1e-3]),
        np.diag([1e6, 1e6, 1e6]),
        np.diag([0.5, 0.5, 1e6]),
        np.diag([-1.0, 0.0, 0.0]),
        np.diag([0.5, np.nan, 0.2]),
        np.array([[0.5, 2.0, 0.0], [2.0, 0.5, 0.0], [0.0, 0.0, 0.2]]),
        np.array([[0.5, 0.1, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.2]]),
    ],
    ids=["none", "constant", "1e6", "any heading", "-1", "nan", "not semidefinite", "lopsided"],
)
def test_a_driver_s_covariance_counts_where_it_can_be_one(told):
    """`USABLE` does; others leave what (7) says of the way."""
    way = (10.0, 3.0, 0.5)
    least = start_of(B, 0, heard((0, way, np.zeros((3, 3)))), EXACT).covariance
    found = start_of(B, 0, heard((0, way, told)), EXACT).covariance
    np.testing.assert_array_equal(found, least)
    cos, sin = np.cos(START[2]), np.sin(START[2])
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    found = start_of(B, 0, heard((0, way, USABLE)), EXACT).covariance
    np.testing.assert_allclose(found, turn @ USABLE @ turn.T, atol=1e-12)
    assert not np.allclose(found, least)


def test_between_two_samples_the_driver_s_covariance_is_that_of_the_second():
    odometry = heard((0, (9, 0, 0), USABLE), (1, (9.1, 0, 0), 2 * USABLE))
    exact = replace(EXACT, start_poses=((0.0, 0.0, 0.0),) * 2)
    between = start_of(B, SECOND // 2, odometry, exact)
    np.testing.assert_allclose(between.covariance, 2 * USABLE, atol=1e-12)
    np.testing.assert_allclose(between.mean, (9.05, 0, 0))


def test_the_covariance_is_that_of_starts_and_ways_that_err():
    """Monte Carlo: start and way are drawn and composed."""
    config = replace(CONFIG, start_sigmas=((0.0, 0.0), (0.1, 0.03)))
    way, its = np.array([4.0, 1.0, 0.7]), 0.002 * (np.eye(3) + 0.3)
    start = start_of(B, 0, heard((0, way, USABLE * 0.01 + its)), config)
    rng = np.random.default_rng(0)
    count = 200_000
    poses = np.array(START)[:, None] + [[0.1], [0.1], [0.03]] * rng.standard_normal((3, count))
    root = np.linalg.cholesky(USABLE * 0.01 + its)
    move(poses, way[:, None] + root @ rng.standard_normal((3, count)))
    np.testing.assert_allclose(start.mean, poses.mean(axis=1), atol=0.01)
    np.testing.assert_allclose(start.covariance, np.cov(poses), atol=3e-4)


def test_the_least_covariance_is_that_of_a_straight_drive_between_two_turns():
    """Monte Carlo with small steps, by (7)."""
    noise = MotionSettings(forward_per_sqrt_s=0.01, left_per_sqrt_s=0.002, yaw_per_sqrt_s=0.003)
    end, seconds = np.array([6.0, 4.0, -0.5]), 20.0
    least = least_covariance(end, seconds, noise)
    rng = np.random.default_rng(0)
    ahead, distance = np.arctan2(4.0, 6.0), np.hypot(6.0, 4.0)
    poses = np.zeros((3, 20_000))
    ways = [(0, 0, ahead), *[(distance / 100, 0, 0)] * 100, (0, 0, -0.5 - ahead)]
    for way in ways:
        time = seconds / 22 if way[2] else seconds * 20 / 22 / 100
        rho, turn = np.hypot(way[0], way[1]), abs(way[2])
        variances = [
            noise.forward_per_sqrt_m**2 * rho + noise.forward_per_sqrt_s**2 * time,
            noise.left_per_sqrt_m**2 * rho + noise.left_per_sqrt_s**2 * time,
            noise.yaw_per_sqrt_m**2 * rho
            + noise.yaw_per_sqrt_rad**2 * turn
            + noise.yaw_per_sqrt_s**2 * time,
        ]
        errors = np.sqrt(variances)[:, None] * rng.standard_normal(poses.shape)
        move(poses, np.array(way)[:, None] + errors)
    np.testing.assert_allclose(least, np.cov(poses), rtol=0.08, atol=2e-4)


def test_a_robot_that_backed_away_did_not_turn():
    noise = MotionSettings()
    back = least_covariance(np.array([-5.0, 0.0, 0.0]), 0.0, noise)
    ahead = least_covariance(np.array([5.0, 0.0, 0.0]), 0.0, noise)
    np.testing.assert_allclose(np.diag(back), np.diag(ahead))
    assert not least_covariance(np.zeros(3), 0.0, noise).any()


@pytest.mark.parametrize("begins_s", [0, 3, 6])
def test_a_fusion_that_begins_late_begins_where_the_robots_are(begins_s):
    pipeline, frames = Pipeline(replace(CONFIG, filter=replace(CONFIG.filter, particles=400))), []
    step = pipeline._particles.step
    pipeline._particles.step = lambda given: frames.extend(given) or step(given)
    nothing = [np.empty((0, size), np.float32) for size in (3, 6, 128)]
    for second, pose, covariance in arc(9)[begins_s:]:
        for robot in CONFIG.robots:
            stamp = (second + 1) * SECOND
            pipeline.handle(PoseSample(robot, stamp, pose, np.zeros(2), covariance))
            pipeline.handle(ObservationSet(robot, stamp, *nothing))
    pipeline.finish()
    starts = [frame.start for frame in frames if frame.start is not None]
    assert len(starts) == 2
    assert [frame.start is not None for frame in frames[:2]] == [True, True]
    for robot, start in zip(CONFIG.robots, CONFIG.start_poses, strict=True):
        poses = pipeline.particles(robot)
        error = poses.mean(axis=0) - composed(start, arc(9)[-1][1])
        error[2] = np.sin(error[2])
        spread = poses.std(axis=0) + 1e-9
        assert (np.abs(error) < 5 * spread / np.sqrt(400) + 0.02).all()
    np.testing.assert_allclose(
        pipeline._particles.state.prior.poses, [start.mean for start in starts]
    )
