"""A world without turns, in which everything is linear and Gaussian."""

import numpy as np

from msg_defs.types import CameraMount
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.models.motion import NO_EXTRA

STEPS, LANDMARKS = 6, 4
SIGMA_MOVE, SIGMA_SEE = 0.3, 0.2
MOUNT = CameraMount(forward_m=0.0, left_m=0.0, up_m=0.0)


def world(seed):
    """Odometry (T, 2) and observations (T, N, 3), both in the map's axes."""
    rng = np.random.default_rng(seed)
    landmarks = rng.uniform(2, 8, (LANDMARKS, 3))
    moves = np.tile([1.0, 0.0], (STEPS, 1))
    moves[0] = 0
    noise = rng.normal(0, SIGMA_MOVE, (STEPS, 2)) * (np.arange(STEPS) > 0)[:, None]
    places = np.cumsum(moves + noise, axis=0)
    seen = landmarks[None] - np.pad(places, ((0, 0), (0, 1)))[:, None]
    return moves, seen + rng.normal(0, SIGMA_SEE, seen.shape)


def frame(t, move, observations, extra=NO_EXTRA):
    """The frame of instant `t`, after `move` (2,)."""
    motion = np.array([*move, 0.0])
    return RobotFrame.from_camera(0, motion, 0.0, observations, MOUNT, extra=extra)
