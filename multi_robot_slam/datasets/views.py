"""Range-bearing readings -> points with covariances, at the instants of frames.

A reading belongs to the nearest frame and is moved there by odometry: a point seen from the pose
x_s is seen from x_g as x_g^-1 x_s q. Of several readings of one target in a frame the one nearest
in time counts; the others would say the same again, since range errors hardly change in a frame.
A camera sees nothing beside or behind itself, so points of a wider sensor that are not ahead of it
are left out.

Errors that keep a correlation rho from one reading of a target to the next, as in a first-order
autoregression, make n readings tell no more than 1 + (n - 1) (1 - rho) / (1 + rho) independent
ones. So a reading that comes `gap` after the last one of its target has its range variance times
(1 + rho) / (1 - rho), which with rho = exp(-gap / memory) is coth(gap / (2 memory)).
"""

from typing import NamedTuple

import numpy as np

from msg_defs.types import CameraMount
from multi_robot_slam.datasets.dead_reckoning import poses_at
from multi_robot_slam.datasets.recording import Commands, Noise, Readings
from multi_robot_slam.models import stereo
from multi_robot_slam.models.symmetric import pack

HEIGHT_SIGMA_M = 0.1
"""Of points whose height is unknown and taken for that of the sensor."""

LEAST_DEPTH_M = 0.05
"""Points nearer to the sensor's plane, or behind it, are not ahead."""


class Views(NamedTuple):
    """V points in the camera frame, at most one of a target in a frame, by frame."""

    frames: np.ndarray
    """(V,) int64: index of the frame."""
    targets: np.ndarray
    """(V,) int64."""
    positions: np.ndarray
    """(V, 3) float32 [m]."""
    covariances: np.ndarray
    """(V, 6) float32 [m^2]."""


def nearest(readings: Readings, stamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which readings count, and in which frame.

    Parameters
    ----------
    stamps_ns : (F,) of the frames, evenly spaced.

    Returns
    -------
    rows (V,) of `readings` and frames (V,), by frame. A reading further than half a period from any
    frame is left out, so is one that another of the same target and frame is nearer than.

    """
    period = stamps_ns[1] - stamps_ns[0]
    frames = (readings.stamps_ns - stamps_ns[0] + period // 2) // period
    inside = np.flatnonzero((frames >= 0) & (frames < len(stamps_ns)))
    apart = np.abs(readings.stamps_ns[inside] - stamps_ns[frames[inside]])
    order = inside[np.lexsort((apart, readings.targets[inside], frames[inside]))]
    pairs = np.column_stack([frames[order], readings.targets[order]])
    is_first = np.append(True, (pairs[1:] != pairs[:-1]).any(axis=1))[: len(order)]
    return order[is_first], frames[order[is_first]]


def views(
    readings: Readings,
    stamps_ns: np.ndarray,
    commands: Commands,
    noise: Noise,
    mount: CameraMount,
) -> Views:
    """What the sensor at `mount` saw of its targets in the frames at `stamps_ns` (F,)."""
    rows, frames = nearest(readings, stamps_ns)
    points = _moved(
        _points(readings[rows], mount), readings.stamps_ns[rows], stamps_ns[frames], commands
    )
    points -= [mount.forward_m, mount.left_m]
    ahead = points[:, 0] > LEAST_DEPTH_M
    chosen, frames, points = readings[rows[ahead]], frames[ahead], points[ahead]
    seconds = np.abs(chosen.stamps_ns - stamps_ns[frames]) * 1e-9
    covariances = _covariances(points, seconds, _repetition(chosen, noise), noise)
    positions = np.column_stack([points, np.zeros(len(points))])
    return Views(
        frames,
        chosen.targets,
        (positions @ stereo.CAMERA_TO_BODY).astype(np.float32),
        pack(stereo.CAMERA_TO_BODY.T @ covariances @ stereo.CAMERA_TO_BODY).astype(np.float32),
    )


def _points(readings: Readings, mount: CameraMount) -> np.ndarray:
    """(V, 2) in `base_link` at each reading's own time."""
    directions = np.column_stack([np.cos(readings.bearings), np.sin(readings.bearings)])
    return readings.ranges[:, None] * directions + [mount.forward_m, mount.left_m]


def _moved(
    points: np.ndarray, from_ns: np.ndarray, to_ns: np.ndarray, commands: Commands
) -> np.ndarray:
    """`points` (V, 2) of `base_link` at `from_ns`, as seen from where the robot is at `to_ns`."""
    start, end = poses_at(commands, from_ns), poses_at(commands, to_ns)
    in_odometry = _turned(points, start[:, 2]) + start[:, :2]
    return _turned(in_odometry - end[:, :2], -end[:, 2])


def _turned(points: np.ndarray, angles: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(angles), np.sin(angles)
    x, y = points.T
    return np.column_stack([cos * x - sin * y, sin * x + cos * y])


def _repetition(readings: Readings, noise: Noise) -> np.ndarray:
    """(V,) factor of the range variance: coth(gap / (2 memory)), 1 where there is no memory."""
    factor = np.ones(len(readings))
    if not noise.range_memory_s:
        return factor
    for target in np.unique(readings.targets):
        rows = np.flatnonzero(readings.targets == target)
        gaps = np.diff(readings.stamps_ns[rows]) * 1e-9
        factor[rows[1:]] = 1 / np.tanh(gaps / (2 * noise.range_memory_s))
    return factor


def _covariances(
    points: np.ndarray, seconds: np.ndarray, repetition: np.ndarray, noise: Noise
) -> np.ndarray:
    """(V, 3, 3) around `points` (V, 2), body axes with the origin at the sensor [m^2].

    Variances along and across the line of sight are those of the reading, and of the motion in the
    `seconds` (V,) by which it was moved.
    """
    distance = np.hypot(*points.T)
    along = repetition * (noise.range_m + noise.range_per_m * distance) ** 2
    along += noise.forward_per_sqrt_s**2 * seconds
    across = noise.bearing_rad**2 + noise.yaw_per_sqrt_s**2 * seconds
    across *= distance**2
    x, y = (points / distance[:, None]).T
    covariances = np.zeros((len(points), 3, 3))
    covariances[:, 0, 0] = along * x * x + across * y * y
    covariances[:, 1, 1] = along * y * y + across * x * x
    covariances[:, 0, 1] = covariances[:, 1, 0] = (along - across) * x * y
    covariances[:, 2, 2] = HEIGHT_SIGMA_M**2
    return covariances
