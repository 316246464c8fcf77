"""Poses in the plane: odometry, paths, particles, transforms."""

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from msg_defs.errors import InputError
from msg_defs.topics import MAP_FRAME, base_frame, odom_frame
from msg_defs.types import PoseSample, Trajectory
from msg_defs.wire.cdr import (
    LITTLE_ENDIAN,
    MOST_TRAILING,
    NANOSECONDS,
    Found,
    Layout,
    Writer,
)
from msg_defs.wire.messages import (
    Odometry,
    Path,
    PoseArray,
    decode,
    require_finite,
    require_frame,
    stamp_in,
    stamp_of,
)

_PLANAR = np.ix_((0, 1, 5), (0, 1, 5))
"""Where x, y, yaw are among x, y, z, roll, pitch, yaw."""

_UNIT_TOLERANCE = 1e-3
"""How far the norm of a quaternion may be from 1."""

_CLEAR = 1e-9
"""A matrix whose correlations leave this share of its determinant is clearly no singular one."""

_SPATIAL = 7
"""Numbers of a pose in space; a covariance of 36 follows."""
POSE_NUMBERS = _SPATIAL + 36
_ODOMETRY_NUMBERS = POSE_NUMBERS + 6 + 36
_TWIST_FORWARD, _TWIST_YAW = POSE_NUMBERS, POSE_NUMBERS + 5
_PLACES = [_SPATIAL + 6 * row + column for row in (0, 1, 5) for column in (0, 1, 5)]
PLANAR_NUMBERS = [0, 1, 3, 4, 5, 6, *_PLACES]
"""Of a pose with covariance, those that a planar one has: x, y, quaternion, nine covariances."""
PLANAR_COUNT = len(PLANAR_NUMBERS)

_MAP_TEXT = MAP_FRAME.encode() + b"\0"
_STAMPED_POSE = np.dtype(
    [
        ("seconds", "<i4"),
        ("nanoseconds", "<u4"),
        ("length", "<u4"),
        ("frame_id", np.uint8, len(_MAP_TEXT)),
        ("pose", "<f8", 7),
    ]
)
"""A pose of a Path but the first, whose header and numbers have four bytes between them."""
_STAMP_SIZE = _STAMPED_POSE.itemsize - 7 * 8
_FIRST_GAP = bytes(4)
_PATH_HEAD = Writer().header(0, MAP_FRAME).done()


def encode_pose(sample: PoseSample, frame_id: str, child_frame_id: str) -> bytes:
    """Odometry."""
    forward, yaw_rate = map(float, sample.twist)
    numbers = [0.0] * _ODOMETRY_NUMBERS
    numbers[_TWIST_FORWARD], numbers[_TWIST_YAW] = forward, yaw_rate
    put_planar(numbers, sample.pose, sample.covariance)
    return _odometry_layout(frame_id, child_frame_id).write(sample.stamp_ns, numbers)


def decode_pose(data: bytes, robot: str) -> PoseSample:
    """Height, roll and pitch are dropped."""
    what = f"odometry of {robot}"
    seconds, nanoseconds, numbers = _odometry_in(data, robot, what)
    pose, covariance = planar_with_covariance(numbers, what)
    twist = np.array(numbers[PLANAR_COUNT:])
    if not all(map(math.isfinite, numbers[PLANAR_COUNT:])):
        require_finite(twist, what, "twist (forward, yaw rate)")
    return PoseSample(robot, stamp_in(seconds, nanoseconds, what), pose, twist, covariance)


def decode_poses(messages: Sequence[bytes], robot: str) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (n,) int64 [ns] and poses (n, 3) of what n calls of `decode_pose` give."""
    for layout in _odometry_layouts(robot):
        found = layout.read_all(messages)
        if found and np.isfinite(found[1][:, PLANAR_COUNT:]).all():
            stamps, numbers = found
            poses = plain_planar(numbers)
            if poses is not None:
                return stamps, poses
    samples = [decode_pose(data, robot) for data in messages]
    stamps = np.array([sample.stamp_ns for sample in samples], np.int64)
    return stamps, np.array([sample.pose for sample in samples]).reshape(-1, 3)


def encode_path(path: Trajectory, stamp_ns: int) -> bytes:
    """Path in `map`."""
    rows = np.zeros(len(path.stamps_ns), _STAMPED_POSE)
    rows["seconds"], rows["nanoseconds"] = np.divmod(path.stamps_ns, NANOSECONDS)
    rows["length"], rows["frame_id"] = len(_MAP_TEXT), np.frombuffer(_MAP_TEXT, np.uint8)
    rows["pose"] = _spatial(path.poses)
    data = rows.tobytes()
    message = Writer().header(stamp_ns, MAP_FRAME).numbers("I", len(rows))
    if len(rows):
        # The first pose follows a number of four bytes, and the others poses.
        message.raw(data[:_STAMP_SIZE]).raw(_FIRST_GAP).raw(data[_STAMP_SIZE:])
    return message.done()


def decode_path(data: bytes, robot: str) -> Trajectory:
    what = f"path of {robot}"
    plain = _plain_path(data)
    if plain is not None:
        return plain
    message = decode(Path, data, what)
    require_frame(message.header.frame_id, (MAP_FRAME,), what)
    stamps = np.array([stamp_of(pose.header, what) for pose in message.poses], np.int64)
    backwards = np.flatnonzero(np.diff(stamps) < 0)
    if backwards.size:
        raise InputError(f"{what}: time goes back after pose {backwards[0]}; sort poses by stamp")
    return Trajectory(stamps, _planar_rows((pose.pose for pose in message.poses), what))


def encode_particles(poses: np.ndarray, stamp_ns: int) -> bytes:
    """PoseArray in `map` of `poses` (M, 3): x [m], y [m], yaw [rad]."""
    return Writer().header(stamp_ns, MAP_FRAME).rows(_spatial(poses)).done()


def decode_particles(data: bytes, robot: str) -> np.ndarray:
    """(M, 3) float64: x [m], y [m], yaw [rad] in `map`."""
    what = f"particles of {robot}"
    message = decode(PoseArray, data, what)
    require_frame(message.header.frame_id, (MAP_FRAME,), what)
    return _planar_rows(message.poses, what)


def encode_transform(stamp_ns: int, frame_id: str, child_frame_id: str, pose: np.ndarray) -> bytes:
    """TFMessage with the one `pose` (3,) of `child_frame_id` in `frame_id`."""
    return encode_transforms(stamp_ns, [Transform(frame_id, child_frame_id, spatial_pose(pose))])


def encode_transforms(stamp_ns: int, transforms: Sequence["Transform"]) -> bytes:
    """TFMessage with all of them."""
    message = Writer().numbers("I", len(transforms))
    for frame_id, child_frame_id, pose in transforms:
        message.header(stamp_ns, frame_id).text(child_frame_id).numbers("7d", *pose)
    return message.done()


class Transform(NamedTuple):
    """Where one frame is in another."""

    frame_id: str
    child_frame_id: str
    pose: tuple[float, ...]
    """x, y, z [m] and the quaternion x, y, z, w of the child frame."""


def spatial_pose(pose: Iterable[float]) -> tuple[float, ...]:
    """The 3D pose of a planar one: position x, y, z, and quaternion x, y, z, w."""
    x, y, yaw = map(float, pose)
    half = yaw / 2
    return x, y, 0.0, 0.0, 0.0, math.sin(half), math.cos(half)


def _spatial(poses: np.ndarray) -> np.ndarray:
    """(n, 7): `spatial_pose` of each of `poses` (n, 3)."""
    spatial = np.zeros((len(poses), 7))
    spatial[:, :2] = poses[:, :2]
    halves = (poses[:, 2] / 2).tolist()
    spatial[:, 5], spatial[:, 6] = [*map(math.sin, halves)], [*map(math.cos, halves)]
    return spatial


def put_planar(numbers: list[float], pose: np.ndarray, covariance: np.ndarray) -> None:
    """Write a planar pose and its covariance at the head of a message's `numbers`."""
    numbers[:_SPATIAL] = spatial_pose(pose)
    for place, value in zip(_PLACES, covariance.ravel().tolist(), strict=True):
        numbers[place] = value


def _odometry_in(data: bytes, robot: str, what: str) -> Found:
    """The numbers of an Odometry message: those of `planar_with_covariance`, then the twist."""
    for layout in _odometry_layouts(robot):
        found = layout.read(data)
        if found is not None:
            return found
    message = decode(Odometry, data, what)
    require_frame(message.header.frame_id, (odom_frame(robot), MAP_FRAME), what)
    require_frame(message.child_frame_id, (base_frame(robot),), what, "child_frame_id")
    twist = message.twist.twist
    numbers = (*numbers_of(message.pose), twist.linear.x, twist.angular.z)
    return Found(*time_of(message.header), numbers)


@lru_cache(maxsize=256)
def _odometry_layouts(robot: str) -> tuple[Layout, ...]:
    frames = odom_frame(robot), MAP_FRAME
    return tuple(_odometry_layout(frame, base_frame(robot)) for frame in frames)


@lru_cache(maxsize=256)
def _odometry_layout(frame_id: str, child_frame_id: str) -> Layout:
    wanted = [*PLANAR_NUMBERS, _TWIST_FORWARD, _TWIST_YAW]
    return Layout([frame_id, child_frame_id], _ODOMETRY_NUMBERS, wanted)


def time_of(header: Any) -> tuple[int, int]:
    return header.stamp.sec, header.stamp.nanosec


def numbers_of(pose: Any) -> tuple[float, ...]:
    """Of a PoseWithCovariance, as `planar_with_covariance` takes them."""
    place, turn = pose.pose.position, pose.pose.orientation
    covariance = pose.covariance.reshape(6, 6)[_PLANAR].ravel().tolist()
    return place.x, place.y, turn.x, turn.y, turn.z, turn.w, *covariance


def planar_with_covariance(numbers: tuple[float, ...], what: str) -> tuple[np.ndarray, np.ndarray]:
    """Pose (3,) and covariance (3, 3) of x, y, quaternion x, y, z, w, and nine covariances."""
    values = numbers[PLANAR_COUNT - 9 : PLANAR_COUNT]
    covariance = np.array(values).reshape(3, 3)
    if any(values) and not _is_plainly_definite(values):
        _require_semidefinite(covariance, what)
    x, y, *turn = numbers[:6]
    return np.array(_planar(x, y, turn, what)), covariance


def _is_plainly_definite(elements: Iterable[Any]) -> Any:
    """Whether nine elements, each a number or an array, are certainly a finite covariance.

    Of a matrix that is nearly singular, or far from one in its scale, this does not tell.
    """
    xx, xy, xw, yx, yy, yw, wx, wy, ww = elements
    volume = xx * yy * ww
    area = xx * yy
    minor = area - xy * xy
    determinant = xx * (yy * ww - yw * yw) - xy * (xy * ww - yw * xw) + xw * (xy * yw - yy * xw)
    # Each product is positive, so the squares are compared instead of the roots.
    almost = _CLEAR * _CLEAR
    is_symmetric = (xy - yx) * (xy - yx) <= almost * area
    is_symmetric &= (xw - wx) * (xw - wx) <= almost * xx * ww
    is_symmetric &= (yw - wy) * (yw - wy) <= almost * yy * ww
    is_positive = (xx > 0) & (yy > 0) & (ww > 0) & (volume < math.inf)
    return is_symmetric & is_positive & (minor > _CLEAR * area) & (determinant > _CLEAR * volume)


def _is_semidefinite(covariance: np.ndarray) -> bool:
    """Whether finite elements (3, 3) are a covariance but for rounding."""
    scaled = covariance / (np.abs(covariance).max() or 1.0)
    symmetric = np.abs(scaled - scaled.T).max() <= 1e-6
    return bool(symmetric and np.linalg.eigvalsh(scaled)[0] >= -1e-6)


def _require_semidefinite(covariance: np.ndarray, what: str) -> None:
    require_finite(covariance, what, "covariance")
    if not _is_semidefinite(covariance):
        raise InputError(
            f"{what}: covariance of x, y, yaw {covariance.tolist()} is not symmetric and positive "
            "semidefinite; publish zeros when it is unknown"
        )


def _planar(x: float, y: float, turn: Sequence[float], what: str) -> tuple[float, float, float]:
    """x, y, and of the quaternion x, y, z, w the rotation about z of the convention yaw, pitch,
    roll.
    """
    if not (math.isfinite(x) and math.isfinite(y)):
        raise InputError(f"{what}: position x = {x}, y = {y}; publish finite numbers")
    qx, qy, qz, qw = turn
    norm = math.hypot(qx, qy, qz, qw)
    if not abs(norm - 1) <= _UNIT_TOLERANCE:
        raise InputError(
            f"{what}: quaternion x, y, z, w = {qx}, {qy}, {qz}, {qw} has the norm {norm:g}; "
            "publish unit quaternions"
        )
    return x, y, math.atan2(*_sine_and_cosine(qx, qy, qz, qw))


def _sine_and_cosine(qx: Any, qy: Any, qz: Any, qw: Any) -> tuple[Any, Any]:
    """Of the yaw, of numbers or arrays, each times the same."""
    return 2 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz


def _planar_rows(poses: Iterable[Any], what: str) -> np.ndarray:
    found = ((pose.position, pose.orientation) for pose in poses)
    rows = [_planar(p.x, p.y, (q.x, q.y, q.z, q.w), what) for p, q in found]
    return np.array(rows, np.float64).reshape(-1, 3)


def plain_planar(numbers: np.ndarray) -> np.ndarray | None:
    """Poses (n, 3) of x, y, quaternion, and covariance if any, in the columns of `numbers`.

    None where one of them is not certainly right.
    """
    place, turn, values = numbers[:, :2], numbers[:, 2:6].T, numbers[:, 6:PLANAR_COUNT]
    with np.errstate(all="ignore"):
        norms = np.sqrt((turn * turn).sum(axis=0))
        is_unit = (np.abs(norms - 1) < _UNIT_TOLERANCE / 2).all()
        if values.size:
            values = values[values.any(axis=1)]
            values = values[~_is_plainly_definite(values.T)]
    if not (is_unit and np.isfinite(place).all() and np.isfinite(values).all()):
        return None
    if not all(map(_is_semidefinite, values.reshape(-1, 3, 3))):
        return None
    sines, cosines = _sine_and_cosine(*turn)
    return np.column_stack([place, [*map(math.atan2, sines.tolist(), cosines.tolist())]])


def _plain_path(data: bytes) -> Trajectory | None:
    """The path in a message laid out as `encode_path` does; None where it is not, or wrong."""
    head = len(_PATH_HEAD)
    if len(data) <= head + 4 or data[:2] != LITTLE_ENDIAN or data[12:head] != _PATH_HEAD[12:]:
        return None
    count = int.from_bytes(data[head : head + 4], "little")
    first = head + 4
    size = first + len(_FIRST_GAP) + count * _STAMPED_POSE.itemsize
    if not count or not 0 <= len(data) - size <= MOST_TRAILING:
        return None
    gap = first + _STAMP_SIZE
    rows = np.frombuffer(data[first:gap] + data[gap + len(_FIRST_GAP) : size], _STAMPED_POSE)
    is_plain = (rows["length"] == len(_MAP_TEXT)) & (rows["nanoseconds"] < NANOSECONDS)
    is_plain &= (rows["frame_id"] == np.frombuffer(_MAP_TEXT, np.uint8)).all(axis=1)
    stamps = rows["seconds"].astype(np.int64) * NANOSECONDS + rows["nanoseconds"]
    if not is_plain.all() or (np.diff(stamps) < 0).any():
        return None
    poses = plain_planar(rows["pose"][:, [0, 1, 3, 4, 5, 6]])
    return None if poses is None else Trajectory(stamps, poses)
