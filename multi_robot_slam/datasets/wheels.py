"""Odometry for robots that have none: their true motion, with the errors that (7) describes."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from msg_defs.types import PoseSample, Trajectory
from multi_robot_slam.models.motion import (
    MotionSettings,
    increment,
    move,
    predicted,
    standard_deviations,
)


def noisy_odometry(
    robot: str, truth: Trajectory, noise: MotionSettings, rng: np.random.Generator
) -> Iterator[PoseSample]:
    """One sample for each pose of the `truth`, in a frame `odom` that begins at its first.

    Each movement from pose to pose is measured with the errors of (7), independently. The
    covariance is what the robot knows: it is that of the measured movements.
    """
    pose, covariance = np.zeros(3), np.zeros((3, 3))
    yield PoseSample(robot, int(truth.stamps_ns[0]), pose)
    steps = zip(pairwise(truth.stamps_ns.tolist()), pairwise(truth.poses), strict=True)
    for (before_ns, after_ns), (before, after) in steps:
        seconds = (after_ns - before_ns) / 1e9
        motion = increment(before, after)
        motion = motion + standard_deviations(motion, seconds, noise) * rng.standard_normal(3)
        _, covariance = predicted(pose, covariance, motion, seconds, noise)
        moved = pose[:, None].copy()
        move(moved, motion[:, None])
        pose = moved[:, 0]
        yield PoseSample(robot, after_ns, pose, motion[[0, 2]] / seconds, covariance)
