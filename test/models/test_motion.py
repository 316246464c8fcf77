"""Odometry increments and the motion model (7)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from multi_robot_slam.models.motion import (
    NO_EXTRA,
    MotionSettings,
    increment,
    move,
    predicted,
    spread,
    standard_deviations,
    wrap,
)

coordinates = st.floats(-50, 50)
poses = st.tuples(coordinates, coordinates, st.floats(-10, 10)).map(np.array)


@given(poses, poses)
def test_move_undoes_increment(a, b):
    moved = a[:, None].copy()
    move(moved, increment(a, b)[:, None])
    np.testing.assert_allclose(moved[:2, 0], b[:2], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * moved[2, 0]), np.exp(1j * b[2]), atol=1e-9)


@given(poses, poses, poses)
def test_increment_does_not_see_the_frame(a, b, frame):
    """The same two poses in another frame have the same increment."""
    cos, sin = np.cos(frame[2]), np.sin(frame[2])

    def seen(p):
        return np.array(
            [
                frame[0] + cos * p[0] - sin * p[1],
                frame[1] + sin * p[0] + cos * p[1],
                p[2] + frame[2],
            ]
        )

    difference = increment(seen(a), seen(b)) - increment(a, b)
    difference[2] = wrap(difference[2])
    np.testing.assert_allclose(difference, 0, atol=1e-9)


@given(st.floats(-100, 100))
def test_wrap_is_the_same_angle(angle):
    wrapped = wrap(angle)
    assert -np.pi <= wrapped < np.pi
    assert np.isclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-9)


def test_variances_add_up_however_the_motion_is_cut():
    noise = MotionSettings()
    motion = np.array([0.0, -2.0, -0.5])
    once = standard_deviations(motion, 0.0, noise) ** 2
    np.testing.assert_allclose(8 * standard_deviations(motion / 8, 0.0, noise) ** 2, once)
    assert (standard_deviations(np.zeros(3), 0.0, noise) == 0).all()


def test_noise_after_one_metre_and_one_radian_is_what_the_settings_say():
    noise = MotionSettings(0.1, 0.2, 0.3, 0.4)
    straight = standard_deviations(np.array([0.6, -0.8, 0.0]), 0.0, noise)
    np.testing.assert_allclose(straight, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(standard_deviations(np.array([0, 0, -1.0]), 0.0, noise), [0, 0, 0.4])


def test_spread_is_the_covariance_of_noisy_moves():
    noise = MotionSettings(0.1, 0.02, 0.05, 0.03)
    motion = np.array([0.7, 0.2, 0.9])
    poses = np.zeros((3, 200_000))
    sigma = standard_deviations(motion, 0.0, noise)[:, None]
    drawn = motion[:, None] + sigma * np.random.default_rng(0).standard_normal(poses.shape)
    move(poses, drawn)
    cos, sin = np.cos(motion[2]), np.sin(motion[2])
    body = np.array([[cos, sin], [-sin, cos]]) @ poses[:2]
    xx, xy, yy, yaw = spread(motion, 0.0, noise)
    np.testing.assert_allclose(np.cov(body), [[xx, xy], [xy, yy]], atol=1e-4)
    assert np.isclose(poses[2].var(), yaw, rtol=0.02)


def test_noise_of_time_alone_grows_with_its_root():
    noise = MotionSettings(0, 0, 0, 0, 0.1, 0.2, 0.3)
    still = standard_deviations(np.zeros(3), 4.0, noise)
    np.testing.assert_allclose(still, [0.2, 0.4, 0.6])
    moving = standard_deviations(np.array([1.0, 0, 0]), 4.0, MotionSettings(0.3, 0, 0, 0, 0.2))
    np.testing.assert_allclose(moving, [0.5, 0, 0])


@pytest.mark.parametrize("turn", [0.0, 0.3, -2.0])
def test_predicted_is_what_many_draws_of_the_model_spread_to(turn):
    rng = np.random.default_rng(1)
    noise = MotionSettings(
        forward_per_sqrt_m=0.05, left_per_sqrt_m=0.02, yaw_per_sqrt_m=0.03, yaw_per_sqrt_s=0.02
    )
    root = rng.normal(0, 0.02, (3, 3))
    pose, covariance, u = np.array([1.0, -2.0, 2.5]), root @ root.T, np.array([0.4, 0.1, turn])
    where, grown = predicted(pose, covariance, u, 0.7, noise)
    draws = rng.multivariate_normal(pose, covariance, 200_000).T
    sigma = standard_deviations(u, 0.7, noise)
    move(draws, u[:, None] + sigma[:, None] * rng.standard_normal(draws.shape))
    off = draws - where[:, None]
    off[2] = wrap(off[2])
    scale = np.sqrt(np.diag(grown))
    np.testing.assert_allclose(off.mean(axis=1) / scale, 0, atol=0.02)
    np.testing.assert_allclose(
        np.cov(off) / np.outer(scale, scale), grown / np.outer(scale, scale), atol=0.02
    )


def test_predicted_is_the_increment_in_reverse_and_certain_without_noise():
    pose, u = np.array([3.0, 1.0, 3.0]), np.array([0.2, -0.1, 0.5])
    still = MotionSettings(**dict.fromkeys(vars(MotionSettings()), 0.0))
    where, grown = predicted(pose, np.zeros((3, 3)), u, 1.0, still)
    np.testing.assert_allclose(increment(pose, where), u, atol=1e-12)
    assert -np.pi <= where[2] < np.pi
    assert not grown.any()


def test_what_gaps_hide_is_added_in_quadrature():
    u, noise, extra = np.array([0.7, 0.1, 0.3]), MotionSettings(), np.array([0.2, 0.1, 0.05])
    told = standard_deviations(u, 0.5, noise)
    more = standard_deviations(u, 0.5, noise, extra)
    np.testing.assert_allclose(more**2, told**2 + extra**2)
    np.testing.assert_array_equal(standard_deviations(u, 0.5, noise, NO_EXTRA), told)
    _, wider = predicted(np.zeros(3), np.zeros((3, 3)), u, 0.5, noise, extra)
    np.testing.assert_allclose(np.diag(wider), more**2)
    xx, _, yy, yaw = spread(u, 0.5, noise, extra)
    np.testing.assert_allclose([xx + yy, yaw], [more[0] ** 2 + more[1] ** 2, more[2] ** 2])


def test_a_factor_is_on_the_noise_and_not_on_what_a_gap_hides():
    noise, motion = MotionSettings(0.1, 0.2, 0.3, 0.4), np.array([1.0, 0.5, -0.3])
    extra = np.array([0.3, 0.0, 0.1])
    told = standard_deviations(motion, 2.0, noise)
    found = standard_deviations(motion, 2.0, noise, extra, 3.0)
    np.testing.assert_allclose(found, np.hypot(3 * told, extra))
    start, known = np.array([1.0, 2.0, 0.5]), 0.01 * np.eye(3)
    _, once = predicted(start, known, motion, 2.0, noise)
    _, grown = predicted(start, known, motion, 2.0, noise, factor=3.0)
    _, certain = predicted(start, known, motion, 2.0, MotionSettings(0, 0, 0, 0))
    np.testing.assert_allclose(grown - certain, 9 * (once - certain), atol=1e-12)
    told, found = (spread(motion, 2.0, noise, factor=factor) for factor in (1.0, 3.0))
    np.testing.assert_allclose(found, 9 * told)
