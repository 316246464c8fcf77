"""Estimates of poses: they go out at the odometry's rate, and a run of hours leaves a million.

So each is packed in one go, and many are read at once.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from msg_defs.topics import MAP_FRAME
from msg_defs.types import Estimate
from msg_defs.wire.cdr import Found, Layout
from msg_defs.wire.messages import PoseWithCovarianceStamped, decode, require_frame, stamp_in
from msg_defs.wire.poses import (
    PLANAR_NUMBERS,
    POSE_NUMBERS,
    numbers_of,
    plain_planar,
    planar_with_covariance,
    put_planar,
    time_of,
)

_LAYOUT = Layout([MAP_FRAME], POSE_NUMBERS, PLANAR_NUMBERS)


class Estimates(NamedTuple):
    """Poses of one robot in `map` as they were published, in that order."""

    stamps_ns: np.ndarray
    """(T,) int64."""
    poses: np.ndarray
    """(T, 3) float64: x [m], y [m], yaw [rad]."""
    covariances: np.ndarray
    """(T, 3, 3) float64 [m^2, m rad, rad^2]."""


def encode_estimate(estimate: Estimate) -> bytes:
    """PoseWithCovarianceStamped of the best particle in `map`, or of a prediction."""
    return _encode(estimate, estimate.pose)


def encode_mean(estimate: Estimate) -> bytes:
    """PoseWithCovarianceStamped of the particles' mean in `map`; `ValueError` without one."""
    if estimate.mean is None:
        raise ValueError(f"the estimate of {estimate.robot} has no mean")
    return _encode(estimate, estimate.mean)


def _encode(estimate: Estimate, pose: np.ndarray) -> bytes:
    numbers = [0.0] * POSE_NUMBERS
    put_planar(numbers, pose, estimate.covariance)
    return _LAYOUT.write(estimate.stamp_ns, numbers)


def decode_estimate(data: bytes, robot: str) -> Estimate:
    """The message of `encode_estimate`, or of `encode_mean` with the mean as the pose."""
    what = f"estimate of {robot}"
    found = _LAYOUT.read(data)
    if found is None:
        message = decode(PoseWithCovarianceStamped, data, what)
        require_frame(message.header.frame_id, (MAP_FRAME,), what)
        found = Found(*time_of(message.header), numbers_of(message.pose))
    seconds, nanoseconds, numbers = found
    return Estimate(
        robot, stamp_in(seconds, nanoseconds, what), *planar_with_covariance(numbers, what)
    )


def decode_estimates(messages: Sequence[bytes], robot: str) -> Estimates:
    """The messages of `decode_estimate`, at once where they are as `encode_estimate` makes them."""
    found = _LAYOUT.read_all(messages)
    poses = None if found is None else plain_planar(found[1])
    if found is not None and poses is not None:
        stamps, numbers = found
        return Estimates(stamps, poses, numbers[:, -9:].reshape(-1, 3, 3))
    decoded = [decode_estimate(data, robot) for data in messages]
    return Estimates(
        np.array([estimate.stamp_ns for estimate in decoded], np.int64),
        np.array([estimate.pose for estimate in decoded]).reshape(-1, 3),
        np.array([estimate.covariance for estimate in decoded]).reshape(-1, 3, 3),
    )
