"""Observations far more precise than odometry: single precision must not lose what they say."""

import numpy as np
import pytest

from multi_robot_slam.filter import rbpf
from multi_robot_slam.filter.settings import NO_REJUVENATION, FilterSettings
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.models.motion import MotionSettings

LANDMARKS, STEPS = 21, 30
NOISE = MotionSettings(0.02, 0.005, 0.001, 0.005)
SETTINGS = FilterSettings(particles=100, motion=NOISE, rejuvenation=NO_REJUVENATION)
START = np.array([15.0, 15.0, 0.0])
TURNING = np.array([0.2, 0.0, 0.2])


def frames(sigma_m, along_ray, seed):
    """A robot on a small circle sees 7 of 21 landmarks a step; `along_ray` times worse in range."""
    rng = np.random.default_rng(seed)
    places = rng.uniform([15, 15, 0], [19, 19, 2], (LANDMARKS, 3))
    descriptors = np.eye(LANDMARKS, 128, dtype=np.float32)
    sigmas = np.array([0.02, 0.005, np.hypot(0.001, 0.005)]) * np.sqrt(0.2)
    pose = START
    for step in range(STEPS):
        u = TURNING * (step > 0)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        pose = pose + np.array([c * u[0], s * u[0], u[2]])
        seen = (np.arange(7) + 3 * step) % LANDMARKS
        c, s = np.cos(pose[2]), np.sin(pose[2])
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        body = (places[seen] - [pose[0], pose[1], 0]) @ turn
        rays = body / np.linalg.norm(body, axis=1, keepdims=True)
        roots = sigma_m * (np.eye(3) + (along_ray - 1) * rays[:, :, None] * rays[:, None, :])
        R = roots @ roots.transpose(0, 2, 1)
        v = body + (roots @ rng.standard_normal((7, 3, 1)))[:, :, 0]
        motion = u + sigmas * rng.standard_normal(3) * (step > 0)
        elements = R[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        yield RobotFrame(0, step, motion, v, elements, descriptors[seen])


def landmarks_made(sigma_m, along_ray, seed, dtype):
    state, rng = rbpf.init(START[None], SETTINGS, dtype), np.random.default_rng(1)
    for frame in frames(sigma_m, along_ray, seed):
        rbpf.step(state, [frame], SETTINGS, rng)
        assert np.isfinite(state.poses).all()
    return len(state.landmarks.of_particle(rbpf.best_particle(state))[0])


@pytest.mark.parametrize("along_ray", [1, 21])
@pytest.mark.parametrize("sigma_m", [1e-2, 1e-3, 1e-4, 3e-5])
def test_single_precision_makes_no_more_ghosts_than_double(sigma_m, along_ray):
    """The gate turns away 1 match in 100, 2 of 210; both precisions draw alike from that."""
    seeds = range(3)
    single = sum(landmarks_made(sigma_m, along_ray, seed, np.float32) for seed in seeds)
    double = sum(landmarks_made(sigma_m, along_ray, seed, np.float64) for seed in seeds)
    # Three standard deviations of the difference of two Poisson numbers, and one.
    expected = max(double - 3 * LANDMARKS, 1)
    assert single - double <= 3 * np.sqrt(2 * expected) + 1
