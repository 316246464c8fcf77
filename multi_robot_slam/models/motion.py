"""Odometry increments and the motion model's noise (7)."""

import math
from typing import Annotated

import numpy as np
from annotated_types import Ge

from msg_defs.types import settings
from multi_robot_slam.models.compiled import kernel

PIECES = 22
"""Of a way of which only the ends are known: two turns, and a drive whose heading gets worse."""


@settings
class MotionSettings:
    """Noise of one odometry increment: variances grow with the distance, the turn and the time.

    So the uncertainty of a path does not depend on how many increments it is cut into.
    """

    forward_per_sqrt_m: Annotated[
        float, Ge(0), "standard deviation along the robot after 1 m [m/sqrt(m)]"
    ] = 0.02
    left_per_sqrt_m: Annotated[
        float, Ge(0), "standard deviation across the robot after 1 m [m/sqrt(m)]"
    ] = 0.005
    yaw_per_sqrt_m: Annotated[
        float, Ge(0), "standard deviation of the heading after 1 m [rad/sqrt(m)]"
    ] = 0.01
    yaw_per_sqrt_rad: Annotated[
        float, Ge(0), "standard deviation of the heading after turning 1 rad [rad/sqrt(rad)]"
    ] = 0.02
    forward_per_sqrt_s: Annotated[
        float, Ge(0), "standard deviation along the robot after 1 s [m/sqrt(s)]"
    ] = 0.0
    left_per_sqrt_s: Annotated[
        float, Ge(0), "standard deviation across the robot after 1 s [m/sqrt(s)]"
    ] = 0.0
    yaw_per_sqrt_s: Annotated[
        float, Ge(0), "standard deviation of the heading after 1 s [rad/sqrt(s)]"
    ] = 0.0
    scale_sigma: Annotated[
        float,
        Ge(0),
        "standard deviation of unknown factors of each robot's distances and turns, around 1; they "
        "are estimated by smoothing; 0: the odometry has none",
    ] = 0.0


NO_EXTRA = np.zeros(3)
"""What a motion hides whose whole way was heard: nothing."""


def increment(previous: np.ndarray, current: np.ndarray) -> np.ndarray:
    """Motion u between two poses of one frame, seen from the first.

    Both poses are (3,): x, y [m], yaw [rad]. Returns (3,): dx, dy [m], dyaw [rad] in (-pi, pi].
    """
    dx, dy, dyaw = current - previous
    cos, sin = np.cos(previous[2]), np.sin(previous[2])
    return np.array([cos * dx + sin * dy, cos * dy - sin * dx, wrap(dyaw)])


def standard_deviations(
    motion: np.ndarray,
    seconds: float | np.ndarray,
    noise: MotionSettings,
    extra: np.ndarray = NO_EXTRA,
    factor: float | np.ndarray = 1.0,
) -> np.ndarray:
    """Standard deviations (3, ...) of `motion` (3, ...) that took `seconds`, in its own units.

    `factor` times those of (7), and in quadrature the `extra` (3, ...) of what gaps in the odometry
    hide.
    """
    root = np.sqrt(np.hypot(motion[0], motion[1]))
    turn, time = np.sqrt(abs(motion[2])), np.sqrt(seconds)
    told = factor * np.array(
        [
            np.hypot(noise.forward_per_sqrt_m * root, noise.forward_per_sqrt_s * time),
            np.hypot(noise.left_per_sqrt_m * root, noise.left_per_sqrt_s * time),
            np.hypot(
                np.hypot(noise.yaw_per_sqrt_m * root, noise.yaw_per_sqrt_rad * turn),
                noise.yaw_per_sqrt_s * time,
            ),
        ]
    )
    return np.hypot(told, extra)


def spread(
    motion: np.ndarray,
    seconds: float,
    noise: MotionSettings,
    extra: np.ndarray = NO_EXTRA,
    factor: float = 1.0,
) -> np.ndarray:
    """Covariance xx xy yy of the position and variance of the yaw after `motion`: (4,).

    Seen from the pose that `motion` (3,) leads to; the noise itself acts in the pose before.
    """
    forward, left, yaw = np.square(standard_deviations(motion, seconds, noise, extra, factor))
    cos, sin = np.cos(motion[2]), np.sin(motion[2])
    return np.array(
        [
            cos * cos * forward + sin * sin * left,
            cos * sin * (left - forward),
            sin * sin * forward + cos * cos * left,
            yaw,
        ]
    )


def predicted(
    pose: np.ndarray,
    covariance: np.ndarray,
    motion: np.ndarray,
    seconds: float,
    noise: MotionSettings,
    extra: np.ndarray = NO_EXTRA,
    factor: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Pose (3,) and covariance (3, 3) after `motion` (3,) that took `seconds`: (7), to first order.

    `motion` is seen from `pose`, in which its noise and `extra` act; `pose` has the `covariance`.
    """
    after, by_pose, by_noise = _linearised(pose, motion)
    by_noise *= standard_deviations(motion, seconds, noise, extra, factor)
    grown = by_pose @ covariance @ by_pose.T + by_noise @ by_noise.T
    after[2] = wrap(after[2])
    return after, grown


def composed(
    pose: np.ndarray, covariance: np.ndarray, motion: np.ndarray, its_covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pose (3,) and covariance (3, 3), to first order (B1), of one that is seen from another.

    `motion` (3,) leads from `pose` (3,) to it; both have covariances (3, 3), independent.
    """
    after, by_pose, by_motion = _linearised(pose, motion)
    grown = by_pose @ covariance @ by_pose.T + by_motion @ its_covariance @ by_motion.T
    return after, grown


def least_covariance(motion: np.ndarray, seconds: float, noise: MotionSettings) -> np.ndarray:
    """Covariance (3, 3), by (7), of a `motion` (3,) of which nothing but its ends is known (B2).

    As if the robot had turned to where it was going, forwards or backwards, had driven straight,
    and had turned again, in `seconds`. A way with detours, or one that came back, is less certain:
    the ends do not tell.
    """
    distance, ahead = math.hypot(motion[0], motion[1]), math.atan2(motion[1], motion[0])
    if abs(ahead) > np.pi / 2:
        distance, ahead = -distance, float(wrap(ahead + np.pi))
    way = np.zeros((PIECES, 3))
    way[1:-1, 0] = distance / (PIECES - 2)
    way[0, 2], way[-1, 2] = ahead, wrap(motion[2] - ahead)
    pose, covariance = np.zeros(3), np.zeros((3, 3))
    for piece in way:
        pose, covariance = predicted(pose, covariance, piece, seconds / PIECES, noise)
    return covariance


def _linearised(pose: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pose (3,) after `motion`, and its Jacobians (3, 3) by `pose` and by `motion`."""
    (x, y, yaw), (forward, left, turn) = pose.tolist(), motion.tolist()
    cos, sin = math.cos(yaw), math.sin(yaw)
    dx, dy = cos * forward - sin * left, sin * forward + cos * left
    by_pose = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    by_motion = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return np.array([x + dx, y + dy, yaw + turn]), by_pose, by_motion


def move(poses: np.ndarray, motions: np.ndarray) -> None:
    """Compose `poses` (3, M) with `motions` (3, M) or (3, 1), in place: x_t = x_{t-1} (+) u_t."""
    _move(poses, np.cos(poses[2]), np.sin(poses[2]), motions)


@kernel
def _move(poses: np.ndarray, cos: np.ndarray, sin: np.ndarray, motions: np.ndarray) -> None:
    """`move`, given the cosines and sines (M,) of the yaws."""
    x, y, yaw = poses[0], poses[1], poses[2]
    if motions.shape[1] == 1:
        forward, left, turn = motions[0, 0], motions[1, 0], motions[2, 0]
        for m in range(cos.size):
            x[m] += cos[m] * forward - sin[m] * left
            y[m] += sin[m] * forward + cos[m] * left
            yaw[m] += turn
    else:
        for m in range(cos.size):
            x[m] += cos[m] * motions[0, m] - sin[m] * motions[1, m]
            y[m] += sin[m] * motions[0, m] + cos[m] * motions[1, m]
            yaw[m] += motions[2, m]


def odom_in_map(estimate: np.ndarray, odometry: np.ndarray) -> np.ndarray:
    """Pose (3,) of `odom` in `map` that puts the `odometry` pose (3,) at the `estimate` (3,)."""
    pose = estimate[:, None].copy()
    move(pose, increment(odometry, np.zeros(3))[:, None])
    return pose[:, 0]


def wrap(angle: float | np.ndarray) -> float | np.ndarray:
    """The same angle in [-pi, pi) [rad]."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
