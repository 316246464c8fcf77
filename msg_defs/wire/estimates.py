"""Estimates of poses: they go out at the odometry's rate, and a run of hours leaves a million.

So each is packed in one go, and many are read at once. The layout is that of the CDR bytes of a
PoseWithCovarianceStamped in `map`, little-endian.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from msg_defs.topics import MAP_FRAME
from msg_defs.types import Estimate
from msg_defs.wire.messages import PoseWithCovarianceStamped, decode, require_frame, stamp_of
from msg_defs.wire.poses import PLANAR, UNIT_TOLERANCE, planar_with_covariance

_FRAME = MAP_FRAME.encode() + b"\0"
_BEFORE = b"\0\1\0\0"
_PACKED = struct.Struct(f"<4siII{len(_FRAME)}s43d")
_ROW = np.dtype(
    [
        ("before", "V4"),
        ("sec", "<i4"),
        ("nanosec", "<u4"),
        ("length", "<u4"),
        ("frame", f"V{len(_FRAME)}"),
        ("position", "<f8", 3),
        ("orientation", "<f8", 4),
        ("covariance", "<f8", (6, 6)),
    ]
)


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
    seconds, nanoseconds = divmod(int(estimate.stamp_ns), 10**9)
    x, y, yaw = estimate.pose.tolist()
    by_x, by_y, by_yaw = estimate.covariance.tolist()
    return _PACKED.pack(
        *(_BEFORE, seconds, nanoseconds, len(_FRAME), _FRAME),
        *(x, y, 0.0, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)),
        *(by_x[0], by_x[1], 0.0, 0.0, 0.0, by_x[2]),
        *(by_y[0], by_y[1], 0.0, 0.0, 0.0, by_y[2]),
        *_NOTHING,
        *(by_yaw[0], by_yaw[1], 0.0, 0.0, 0.0, by_yaw[2]),
    )


_NOTHING = (0.0,) * 18
"""Height, roll and pitch are certain."""


def encode_mean(estimate: Estimate) -> bytes:
    """PoseWithCovarianceStamped of the particles' mean in `map`; `ValueError` without one."""
    if estimate.mean is None:
        raise ValueError(f"the estimate of {estimate.robot} has no mean")
    return encode_estimate(replace(estimate, pose=estimate.mean))


def decode_estimate(data: bytes, robot: str) -> Estimate:
    """The message of `encode_estimate`, or of `encode_mean` with the mean as the pose."""
    what = f"estimate of {robot}"
    message = decode(PoseWithCovarianceStamped, data, what)
    require_frame(message.header.frame_id, (MAP_FRAME,), what)
    return Estimate(
        robot, stamp_of(message.header, what), *planar_with_covariance(message.pose, what)
    )


def decode_estimates(messages: Sequence[bytes], robot: str) -> Estimates:
    """The messages of `decode_estimate`, at once where they are as `encode_estimate` makes them."""
    if all(len(data) == _PACKED.size for data in messages):
        rows = np.frombuffer(b"".join(messages), _ROW)
        if _are_ours(rows):
            stamps = rows["sec"].astype(np.int64) * 10**9 + rows["nanosec"]
            return Estimates(stamps, _planar(rows), _planar_covariances(rows))
    decoded = [decode_estimate(data, robot) for data in messages]
    return Estimates(
        np.array([estimate.stamp_ns for estimate in decoded], np.int64),
        np.array([estimate.pose for estimate in decoded]).reshape(-1, 3),
        np.array([estimate.covariance for estimate in decoded]).reshape(-1, 3, 3),
    )


def _are_ours(rows: np.ndarray) -> bool:
    """All are laid out as `_PACKED`, and mean something."""
    ours = (rows["before"] == np.void(_BEFORE)) & (rows["length"] == len(_FRAME))
    ours &= (rows["frame"] == np.void(_FRAME)) & (rows["nanosec"] < 10**9)
    norms = np.linalg.norm(rows["orientation"], axis=1)
    ours &= np.isfinite(rows["position"]).all(axis=1) & (np.abs(norms - 1) <= UNIT_TOLERANCE)
    covariances = _planar_covariances(rows)
    ours &= np.isfinite(covariances).all(axis=(1, 2))
    if not ours.all():
        return False
    scaled = covariances / _or_one(np.abs(covariances).max(axis=(1, 2)))[:, None, None]
    is_symmetric = np.abs(scaled - scaled.transpose(0, 2, 1)).max(initial=0.0) <= 1e-6
    return bool(is_symmetric and np.linalg.eigvalsh(scaled).min(initial=0.0) >= -1e-6)


def _planar_covariances(rows: np.ndarray) -> np.ndarray:
    """(T, 3, 3) of x, y, yaw."""
    places = PLANAR[0].ravel()
    return rows["covariance"][:, places][:, :, places]


def _or_one(values: np.ndarray) -> np.ndarray:
    return np.where(values > 0, values, 1.0)


def _planar(rows: np.ndarray) -> np.ndarray:
    """(T, 3): x, y [m], yaw [rad]."""
    x, y, z, w = rows["orientation"].T
    yaws = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return np.column_stack([rows["position"][:, :2], yaws])
