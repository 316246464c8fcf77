"""Poses in the plane: odometry, paths, particles, transforms."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from msg_defs.errors import InputError
from msg_defs.topics import MAP_FRAME, base_frame, odom_frame
from msg_defs.types import PoseSample, Trajectory
from msg_defs.wire.messages import (
    Odometry,
    Path,
    Point,
    Pose,
    PoseArray,
    PoseStamped,
    PoseWithCovariance,
    Quaternion,
    TFMessage,
    Transform,
    TransformStamped,
    Twist,
    TwistWithCovariance,
    Vector3,
    decode,
    encode,
    header_of,
    require_finite,
    require_frame,
    stamp_of,
)

PLANAR = np.ix_((0, 1, 5), (0, 1, 5))
"""Where x, y, yaw are among x, y, z, roll, pitch, yaw."""

UNIT_TOLERANCE = 1e-3
"""How far the norm of a quaternion may be from 1."""


def encode_pose(sample: PoseSample, frame_id: str, child_frame_id: str) -> bytes:
    """Odometry."""
    forward, yaw_rate = map(float, sample.twist)
    twist = Twist(Vector3(forward, 0.0, 0.0), Vector3(0.0, 0.0, yaw_rate))
    return encode(
        Odometry(
            header=header_of(sample.stamp_ns, frame_id),
            child_frame_id=child_frame_id,
            pose=_covariant_pose(sample.pose, sample.covariance),
            twist=TwistWithCovariance(twist, np.zeros(36)),
        )
    )


def decode_pose(data: bytes, robot: str) -> PoseSample:
    """Height, roll and pitch are dropped."""
    what = f"odometry of {robot}"
    message = decode(Odometry, data, what)
    require_frame(message.header.frame_id, (odom_frame(robot), MAP_FRAME), what)
    require_frame(message.child_frame_id, (base_frame(robot),), what, "child_frame_id")
    pose, covariance = planar_with_covariance(message.pose, what)
    twist = np.array([message.twist.twist.linear.x, message.twist.twist.angular.z])
    require_finite(twist, what, "twist (forward, yaw rate)")
    return PoseSample(robot, stamp_of(message.header, what), pose, twist, covariance)


def encode_path(path: Trajectory, stamp_ns: int) -> bytes:
    """Path in `map`."""
    poses = [
        PoseStamped(header_of(stamp, MAP_FRAME), spatial_pose(pose))
        for stamp, pose in zip(path.stamps_ns, path.poses.tolist(), strict=True)
    ]
    return encode(Path(header_of(stamp_ns, MAP_FRAME), poses))


def decode_path(data: bytes, robot: str) -> Trajectory:
    what = f"path of {robot}"
    message = decode(Path, data, what)
    require_frame(message.header.frame_id, (MAP_FRAME,), what)
    stamps = np.array([stamp_of(pose.header, what) for pose in message.poses], np.int64)
    backwards = np.flatnonzero(np.diff(stamps) < 0)
    if backwards.size:
        raise InputError(f"{what}: time goes back after pose {backwards[0]}; sort poses by stamp")
    return Trajectory(stamps, _planar_rows((pose.pose for pose in message.poses), what))


def encode_particles(poses: np.ndarray, stamp_ns: int) -> bytes:
    """PoseArray in `map` of `poses` (M, 3): x [m], y [m], yaw [rad]."""
    return encode(
        PoseArray(header_of(stamp_ns, MAP_FRAME), [spatial_pose(p) for p in poses.tolist()])
    )


def decode_particles(data: bytes, robot: str) -> np.ndarray:
    """(M, 3) float64: x [m], y [m], yaw [rad] in `map`."""
    what = f"particles of {robot}"
    message = decode(PoseArray, data, what)
    require_frame(message.header.frame_id, (MAP_FRAME,), what)
    return _planar_rows(message.poses, what)


def encode_transform(stamp_ns: int, frame_id: str, child_frame_id: str, pose: np.ndarray) -> bytes:
    """TFMessage with the one `pose` (3,) of `child_frame_id` in `frame_id`."""
    spatial = spatial_pose(pose)
    x, y = spatial.position.x, spatial.position.y
    transform = Transform(Vector3(x, y, 0.0), spatial.orientation)
    stamped = TransformStamped(header_of(stamp_ns, frame_id), child_frame_id, transform)
    return encode(TFMessage([stamped]))


def spatial_pose(pose: Iterable[float]) -> Any:
    """The 3D pose of a planar one."""
    x, y, yaw = map(float, pose)
    half = yaw / 2
    return Pose(Point(x, y, 0.0), Quaternion(0.0, 0.0, math.sin(half), math.cos(half)))


def _planar(pose: Any, what: str) -> tuple[float, float, float]:
    x, y = pose.position.x, pose.position.y
    if not (math.isfinite(x) and math.isfinite(y)):
        raise InputError(f"{what}: position x = {x}, y = {y}; publish finite numbers")
    return x, y, _yaw(pose.orientation, what)


def _yaw(q: Any, what: str) -> float:
    """Rotation about z of the convention yaw, pitch, roll."""
    norm = math.hypot(q.x, q.y, q.z, q.w)
    if not abs(norm - 1) <= UNIT_TOLERANCE:
        raise InputError(
            f"{what}: quaternion x, y, z, w = {q.x}, {q.y}, {q.z}, {q.w} has the norm {norm:g}; "
            "publish unit quaternions"
        )
    return math.atan2(2 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)


def _planar_rows(poses: Iterable[Any], what: str) -> np.ndarray:
    return np.array([_planar(pose, what) for pose in poses], np.float64).reshape(-1, 3)


def _covariant_pose(pose: np.ndarray, covariance: np.ndarray) -> Any:
    spatial = np.zeros((6, 6))
    spatial[PLANAR] = covariance
    return PoseWithCovariance(spatial_pose(pose), spatial.ravel())


def planar_with_covariance(pose: Any, what: str) -> tuple[np.ndarray, np.ndarray]:
    """x, y [m], yaw [rad] (3,) and their covariance (3, 3) of a PoseWithCovariance."""
    covariance = pose.covariance.reshape(6, 6)[PLANAR].astype(np.float64)
    require_finite(covariance, what, "covariance")
    scaled = covariance / (np.abs(covariance).max() or 1.0)
    symmetric = np.abs(scaled - scaled.T).max() <= 1e-6
    if not symmetric or np.linalg.eigvalsh(scaled)[0] < -1e-6:
        raise InputError(
            f"{what}: covariance of x, y, yaw {covariance.tolist()} is not symmetric and positive "
            "semidefinite; publish zeros when it is unknown"
        )
    return np.array(_planar(pose.pose, what)), covariance
