"""Types <-> CDR bytes of standard ROS messages: the only place that knows field layouts.

Nodes publish these bytes and subscribe raw, bags hold them, so live and recorded data go through
the same code, and none of it imports ROS. Each `encode_x` makes the bytes of one message; each
`decode_x` checks what comes in and raises `InputError` where it is damaged or means nothing.

Frames are those of `msg_defs.types`. Clouds of observations are in the camera's optical frame of
REP-103 (x right, y down, z forward); here, and nowhere else, their y changes sign.
"""

import importlib
import itertools
import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from msg_defs.errors import InputError
from msg_defs.topics import MAP_FRAME, base_frame, camera_frame, odom_frame
from msg_defs.types import (
    DESCRIPTOR_SIZE,
    Estimate,
    FrameRecord,
    LandmarkMap,
    ObservationSet,
    ObservationTruth,
    PoseSample,
    StepRecord,
    Trajectory,
    Walls,
)

_STORE = get_typestore(Stores.ROS2_JAZZY)
Duration = _STORE.types["builtin_interfaces/msg/Duration"]
Time = _STORE.types["builtin_interfaces/msg/Time"]
DiagnosticArray = _STORE.types["diagnostic_msgs/msg/DiagnosticArray"]
DiagnosticStatus = _STORE.types["diagnostic_msgs/msg/DiagnosticStatus"]
KeyValue = _STORE.types["diagnostic_msgs/msg/KeyValue"]
Point = _STORE.types["geometry_msgs/msg/Point"]
Pose = _STORE.types["geometry_msgs/msg/Pose"]
PoseArray = _STORE.types["geometry_msgs/msg/PoseArray"]
PoseStamped = _STORE.types["geometry_msgs/msg/PoseStamped"]
PoseWithCovariance = _STORE.types["geometry_msgs/msg/PoseWithCovariance"]
PoseWithCovarianceStamped = _STORE.types["geometry_msgs/msg/PoseWithCovarianceStamped"]
Quaternion = _STORE.types["geometry_msgs/msg/Quaternion"]
Transform = _STORE.types["geometry_msgs/msg/Transform"]
TransformStamped = _STORE.types["geometry_msgs/msg/TransformStamped"]
Twist = _STORE.types["geometry_msgs/msg/Twist"]
TwistWithCovariance = _STORE.types["geometry_msgs/msg/TwistWithCovariance"]
Vector3 = _STORE.types["geometry_msgs/msg/Vector3"]
Odometry = _STORE.types["nav_msgs/msg/Odometry"]
Path = _STORE.types["nav_msgs/msg/Path"]
CompressedImage = _STORE.types["sensor_msgs/msg/CompressedImage"]
PointCloud2 = _STORE.types["sensor_msgs/msg/PointCloud2"]
PointField = _STORE.types["sensor_msgs/msg/PointField"]
ColorRGBA = _STORE.types["std_msgs/msg/ColorRGBA"]
Header = _STORE.types["std_msgs/msg/Header"]
String = _STORE.types["std_msgs/msg/String"]
TFMessage = _STORE.types["tf2_msgs/msg/TFMessage"]
Marker = _STORE.types["visualization_msgs/msg/Marker"]
MarkerArray = _STORE.types["visualization_msgs/msg/MarkerArray"]
MeshFile = _STORE.types["visualization_msgs/msg/MeshFile"]


def message_class(type_name: str) -> type:
    """ROS's own class of a message type such as `nav_msgs/msg/Odometry`; needs ROS."""
    package, _, name = type_name.partition("/msg/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def message_schema(type_name: str) -> tuple[str, str]:
    """The `ros2msg` text of a message type with all it contains, and its RIHS01 hash."""
    return _STORE.generate_msgdef(type_name, ros_version=2)[0], _STORE.hash_rihs01(type_name)


# Messages and headers


def _encode(message: Any) -> bytes:
    return bytes(_STORE.serialize_cdr(message, message.__msgtype__))


def _decode(message_type: type, data: bytes, what: str) -> Any:
    name = message_type.__msgtype__
    try:
        return _STORE.deserialize_cdr(data, name)
    except SerdeError as error:
        raise InputError(
            f"{what}: {len(data)} bytes are no {name}: {error} Check the publisher's message type"
        ) from None


def _time(stamp_ns: int) -> Any:
    return Time(*divmod(int(stamp_ns), 10**9))


def _header(stamp_ns: int, frame_id: str) -> Any:
    return Header(_time(stamp_ns), frame_id)


def _stamp_ns(header: Any, what: str) -> int:
    seconds, nanoseconds = header.stamp.sec, header.stamp.nanosec
    if nanoseconds >= 10**9:
        raise InputError(f"{what}: nanosec = {nanoseconds} of the stamp; it must be below 10^9")
    return seconds * 10**9 + nanoseconds


def _require_frame(frame_id: str, expected: tuple[str, ...], what: str, name="frame_id") -> None:
    if frame_id not in expected:
        raise InputError(f"{what}: {name} is {frame_id!r}; publish it as {' or '.join(expected)}")


def _require_finite(values: np.ndarray, what: str, name: str) -> None:
    """`values` (n,) or (n, k)."""
    finite = np.isfinite(values)
    if not finite.all():
        row = int(np.argwhere(~finite)[0, 0])
        value = values[~finite][0]
        raise InputError(f"{what}: {name}[{row}] = {value}; publish finite numbers only")


# Point clouds


class _Datatype(NamedTuple):
    code: int
    name: str
    dtype: np.dtype


_UINT8 = _Datatype(PointField.UINT8, "UINT8", np.dtype("u1"))
_UINT32 = _Datatype(PointField.UINT32, "UINT32", np.dtype("<u4"))
_FLOAT32 = _Datatype(PointField.FLOAT32, "FLOAT32", np.dtype("<f4"))


class _Column(NamedTuple):
    """One field of a cloud: written as the first of `datatypes`, read as any of them."""

    name: str
    count: int = 1
    datatypes: tuple[_Datatype, ...] = (_FLOAT32,)

    def __str__(self) -> str:
        return f"{' or '.join(d.name for d in self.datatypes)} x {self.count}"


_POSITION = (_Column("x"), _Column("y"), _Column("z"))
_OBSERVATION = (
    *_POSITION,
    _Column("covariance", 6),
    _Column("descriptor", DESCRIPTOR_SIZE, (_FLOAT32, _UINT8)),
)
_TRUTH = (_Column("landmark", 1, (_UINT32,)),)
_MAP = (
    *_POSITION,
    _Column("covariance", 6),
    _Column("id", 1, (_UINT32,)),
    _Column("observations", 1, (_UINT32,)),
    _Column("robots", 1, (_UINT32,)),
    _Column("descriptor", DESCRIPTOR_SIZE),
)

_UINT8_DESCRIPTOR_SCALE = np.float32(1 / 512)
"""SIFT as bytes is 512 times the unit vector."""

_FLIP_POSITION = np.array([1, -1, 1], np.float32)
"""Camera frame (Y up) <-> optical frame (y down)."""
_FLIP_COVARIANCE = np.array([1, -1, 1, 1, -1, 1], np.float32)


def encode_observations(observations: ObservationSet) -> bytes:
    """PointCloud2 in the robot's optical frame."""
    columns = {
        **_position_columns(observations.positions * _FLIP_POSITION),
        "covariance": observations.covariances * _FLIP_COVARIANCE,
        "descriptor": observations.descriptors,
    }
    frame_id = camera_frame(observations.robot)
    return _encode_cloud(_OBSERVATION, columns, observations.stamp_ns, frame_id)


def decode_observations(data: bytes, robot: str) -> ObservationSet:
    """Descriptors may be FLOAT32, or UINT8 for 512 times the value."""
    what = f"observations of {robot}"
    stamp_ns, columns = _decode_cloud(data, _OBSERVATION, camera_frame(robot), what)
    depth = columns["z"]
    behind = np.flatnonzero(depth <= 0)
    if behind.size:
        raise InputError(
            f"{what}: depth z = {depth[behind[0]]:g} m of point {behind[0]} is not in front of "
            "the camera; publish points in the optical frame, z forward"
        )
    covariances = columns["covariance"]
    _require_definite(_is_definite(covariances), covariances, what)
    return ObservationSet(
        robot,
        stamp_ns,
        positions=_positions(columns) * _FLIP_POSITION,
        covariances=covariances * _FLIP_COVARIANCE,
        descriptors=_float_descriptors(columns["descriptor"]),
    )


def encode_observation_truth(truth: ObservationTruth) -> bytes:
    """PointCloud2 with frame and stamp of the observations it belongs to."""
    columns = {"landmark": truth.landmarks}
    return _encode_cloud(_TRUTH, columns, truth.stamp_ns, camera_frame(truth.robot))


def decode_observation_truth(data: bytes, robot: str) -> ObservationTruth:
    what = f"observation truth of {robot}"
    stamp_ns, columns = _decode_cloud(data, _TRUTH, camera_frame(robot), what)
    return ObservationTruth(robot, stamp_ns, columns["landmark"])


def encode_map(landmarks: LandmarkMap, stamp_ns: int) -> bytes:
    """PointCloud2 in `map`."""
    columns = {
        **_position_columns(landmarks.positions),
        "covariance": landmarks.covariances,
        "id": landmarks.ids,
        "observations": landmarks.observations,
        "robots": landmarks.robots,
        "descriptor": landmarks.descriptors,
    }
    return _encode_cloud(_MAP, columns, stamp_ns, MAP_FRAME)


def decode_map(data: bytes) -> LandmarkMap:
    """A covariance is positive definite, or zero as in a true map."""
    what = "landmark map"
    _, columns = _decode_cloud(data, _MAP, MAP_FRAME, what)
    covariances = columns["covariance"]
    definite = _is_definite(covariances) | (covariances == 0).all(axis=1)
    _require_definite(definite, covariances, what)
    ids, counts = np.unique(columns["id"], return_counts=True)
    if (counts > 1).any():
        raise InputError(f"{what}: id {ids[counts > 1][0]} occurs twice; number landmarks uniquely")
    return LandmarkMap(
        ids=columns["id"],
        positions=_positions(columns),
        covariances=covariances,
        observations=columns["observations"],
        robots=columns["robots"],
        descriptors=columns["descriptor"],
    )


def _position_columns(positions: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip("xyz", positions.T, strict=True))


def _positions(columns: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([columns[name] for name in "xyz"], axis=1)


def _float_descriptors(values: np.ndarray) -> np.ndarray:
    return values * _UINT8_DESCRIPTOR_SCALE if values.dtype == np.uint8 else values


def _encode_cloud(
    table: tuple[_Column, ...], columns: dict[str, np.ndarray], stamp_ns: int, frame_id: str
) -> bytes:
    dtype, fields = _LAYOUTS[table]
    count = len(columns[table[0].name])
    points = np.empty(count, dtype)
    for column in table:
        points[column.name] = columns[column.name]
    return _encode(
        PointCloud2(
            header=_header(stamp_ns, frame_id),
            height=1,
            width=count,
            fields=fields,
            is_bigendian=False,
            point_step=dtype.itemsize,
            row_step=dtype.itemsize * count,
            data=points.view(np.uint8),
            is_dense=True,
        )
    )


def _layout(table: tuple[_Column, ...]) -> tuple[np.dtype, list]:
    """The fields of `table`, one after the other without gaps."""
    dtype = np.dtype([(c.name, c.datatypes[0].dtype, (c.count,) * (c.count > 1)) for c in table])
    fields = [
        PointField(c.name, dtype.fields[c.name][1], c.datatypes[0].code, c.count) for c in table
    ]
    return dtype, fields


_LAYOUTS = {table: _layout(table) for table in (_OBSERVATION, _TRUTH, _MAP)}


def _decode_cloud(
    data: bytes, table: tuple[_Column, ...], frame_id: str, what: str
) -> tuple[int, dict[str, np.ndarray]]:
    """Stamp, and one array (n,) or (n, count) for each column of `table`; more fields may be there.

    Fields may come in any order and with gaps, rows may be padded, a cloud may have several rows
    and either byte order.
    """
    cloud = _decode(PointCloud2, data, what)
    _require_frame(cloud.header.frame_id, (frame_id,), what)
    stamp_ns = _stamp_ns(cloud.header, what)
    fields = {field.name: field for field in cloud.fields}
    if len(fields) < len(cloud.fields):
        raise InputError(f"{what}: fields {_names(cloud)}; name each once")
    points = _point_bytes(cloud, what)
    return stamp_ns, {c.name: _column(points, c, fields.get(c.name), cloud, what) for c in table}


def _point_bytes(cloud: Any, what: str) -> np.ndarray:
    """(n, point_step) uint8."""
    used = cloud.width * cloud.point_step
    sizes_agree = cloud.row_step >= used and cloud.data.size == cloud.height * cloud.row_step
    if not sizes_agree or cloud.point_step == 0:
        raise InputError(
            f"{what}: height {cloud.height}, width {cloud.width}, point_step {cloud.point_step}, "
            f"row_step {cloud.row_step} and {cloud.data.size} bytes of data disagree; "
            "row_step is width * point_step, data is height * row_step"
        )
    rows = cloud.data.reshape(cloud.height, cloud.row_step)[:, :used]
    return rows.reshape(cloud.height * cloud.width, cloud.point_step)


def _column(points: np.ndarray, column: _Column, field: Any, cloud: Any, what: str) -> np.ndarray:
    if field is None:
        raise InputError(
            f"{what}: no field '{column.name}' among {_names(cloud)}; publish it as {column}"
        )
    datatype = next((d for d in column.datatypes if d.code == field.datatype), None)
    if datatype is None or field.count != column.count:
        raise InputError(
            f"{what}: field '{column.name}' has datatype {field.datatype} x {field.count}; "
            f"publish it as {column}"
        )
    end = field.offset + datatype.dtype.itemsize * column.count
    if end > cloud.point_step:
        raise InputError(
            f"{what}: field '{column.name}' ends at byte {end} of a point of {cloud.point_step} "
            "bytes; correct its offset or point_step"
        )
    stored = datatype.dtype.newbyteorder(">") if cloud.is_bigendian else datatype.dtype
    values = points[:, field.offset : end].copy().view(stored).astype(datatype.dtype, copy=False)
    if datatype is _FLOAT32:
        _require_finite(values, what, column.name)
    return values if column.count > 1 else values[:, 0]


def _names(cloud: Any) -> str:
    return repr([field.name for field in cloud.fields])


def _is_definite(covariances: np.ndarray) -> np.ndarray:
    """(n,) bool: Sylvester's criterion on (n, 6) finite float32 numbers."""
    xx, xy, xz, yy, yz, zz = covariances.astype(np.float64).T
    minor = xx * yy - xy * xy
    determinant = zz * minor - xx * yz * yz + 2 * xy * yz * xz - yy * xz * xz
    return (xx > 0) & (minor > 0) & (determinant > 0)


def _require_definite(definite: np.ndarray, covariances: np.ndarray, what: str) -> None:
    if not definite.all():
        row = int(np.argmin(definite))
        raise InputError(
            f"{what}: covariance {covariances[row].tolist()} of point {row} is not positive "
            "definite; publish xx xy xz yy yz zz [m^2]"
        )


# Poses

_PLANAR = np.ix_((0, 1, 5), (0, 1, 5))
"""Where x, y, yaw are among x, y, z, roll, pitch, yaw."""

_UNIT_TOLERANCE = 1e-3
"""How far the norm of a quaternion may be from 1."""


def encode_pose(sample: PoseSample, frame_id: str, child_frame_id: str) -> bytes:
    """Odometry."""
    forward, yaw_rate = map(float, sample.twist)
    twist = Twist(Vector3(forward, 0.0, 0.0), Vector3(0.0, 0.0, yaw_rate))
    return _encode(
        Odometry(
            header=_header(sample.stamp_ns, frame_id),
            child_frame_id=child_frame_id,
            pose=_covariant_pose(sample.pose, sample.covariance),
            twist=TwistWithCovariance(twist, np.zeros(36)),
        )
    )


def decode_pose(data: bytes, robot: str) -> PoseSample:
    """Height, roll and pitch are dropped."""
    what = f"odometry of {robot}"
    message = _decode(Odometry, data, what)
    _require_frame(message.header.frame_id, (odom_frame(robot), MAP_FRAME), what)
    _require_frame(message.child_frame_id, (base_frame(robot),), what, "child_frame_id")
    pose, covariance = _planar_with_covariance(message.pose, what)
    twist = np.array([message.twist.twist.linear.x, message.twist.twist.angular.z])
    _require_finite(twist, what, "twist (forward, yaw rate)")
    return PoseSample(robot, _stamp_ns(message.header, what), pose, twist, covariance)


def encode_estimate(estimate: Estimate) -> bytes:
    """PoseWithCovarianceStamped in `map`."""
    pose = _covariant_pose(estimate.pose, estimate.covariance)
    return _encode(PoseWithCovarianceStamped(_header(estimate.stamp_ns, MAP_FRAME), pose))


def decode_estimate(data: bytes, robot: str) -> Estimate:
    what = f"estimate of {robot}"
    message = _decode(PoseWithCovarianceStamped, data, what)
    _require_frame(message.header.frame_id, (MAP_FRAME,), what)
    return Estimate(
        robot, _stamp_ns(message.header, what), *_planar_with_covariance(message.pose, what)
    )


def encode_path(path: Trajectory, stamp_ns: int) -> bytes:
    """Path in `map`."""
    poses = [
        PoseStamped(_header(stamp, MAP_FRAME), _spatial(pose))
        for stamp, pose in zip(path.stamps_ns, path.poses.tolist(), strict=True)
    ]
    return _encode(Path(_header(stamp_ns, MAP_FRAME), poses))


def decode_path(data: bytes, robot: str) -> Trajectory:
    what = f"path of {robot}"
    message = _decode(Path, data, what)
    _require_frame(message.header.frame_id, (MAP_FRAME,), what)
    stamps = np.array([_stamp_ns(pose.header, what) for pose in message.poses], np.int64)
    backwards = np.flatnonzero(np.diff(stamps) < 0)
    if backwards.size:
        raise InputError(f"{what}: time goes back after pose {backwards[0]}; sort poses by stamp")
    return Trajectory(stamps, _planar_rows((pose.pose for pose in message.poses), what))


def encode_particles(poses: np.ndarray, stamp_ns: int) -> bytes:
    """PoseArray in `map` of `poses` (M, 3): x [m], y [m], yaw [rad]."""
    return _encode(PoseArray(_header(stamp_ns, MAP_FRAME), [_spatial(p) for p in poses.tolist()]))


def decode_particles(data: bytes, robot: str) -> np.ndarray:
    """(M, 3) float64: x [m], y [m], yaw [rad] in `map`."""
    what = f"particles of {robot}"
    message = _decode(PoseArray, data, what)
    _require_frame(message.header.frame_id, (MAP_FRAME,), what)
    return _planar_rows(message.poses, what)


def encode_transform(stamp_ns: int, frame_id: str, child_frame_id: str, pose: np.ndarray) -> bytes:
    """TFMessage with the one `pose` (3,) of `child_frame_id` in `frame_id`."""
    spatial = _spatial(pose)
    x, y = spatial.position.x, spatial.position.y
    transform = Transform(Vector3(x, y, 0.0), spatial.orientation)
    stamped = TransformStamped(_header(stamp_ns, frame_id), child_frame_id, transform)
    return _encode(TFMessage([stamped]))


def _spatial(pose: Iterable[float]) -> Any:
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
    if not abs(norm - 1) <= _UNIT_TOLERANCE:
        raise InputError(
            f"{what}: quaternion x, y, z, w = {q.x}, {q.y}, {q.z}, {q.w} has the norm {norm:g}; "
            "publish unit quaternions"
        )
    return math.atan2(2 * (q.w * q.z + q.x * q.y), q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z)


def _planar_rows(poses: Iterable[Any], what: str) -> np.ndarray:
    return np.array([_planar(pose, what) for pose in poses], np.float64).reshape(-1, 3)


def _covariant_pose(pose: np.ndarray, covariance: np.ndarray) -> Any:
    spatial = np.zeros((6, 6))
    spatial[_PLANAR] = covariance
    return PoseWithCovariance(_spatial(pose), spatial.ravel())


def _planar_with_covariance(pose: Any, what: str) -> tuple[np.ndarray, np.ndarray]:
    covariance = pose.covariance.reshape(6, 6)[_PLANAR].astype(np.float64)
    _require_finite(covariance, what, "covariance")
    scaled = covariance / (np.abs(covariance).max() or 1.0)
    symmetric = np.allclose(scaled, scaled.T, rtol=0, atol=1e-6)
    if not symmetric or np.linalg.eigvalsh(scaled)[0] < -1e-6:
        raise InputError(
            f"{what}: covariance of x, y, yaw {covariance.tolist()} is not symmetric and positive "
            "semidefinite; publish zeros when it is unknown"
        )
    return np.array(_planar(pose.pose, what)), covariance


# Pictures for RViz

_COLOURS = (
    (0.90, 0.30, 0.23),
    (0.20, 0.60, 0.86),
    (0.18, 0.72, 0.42),
    (0.95, 0.62, 0.07),
    (0.61, 0.35, 0.71),
    (0.10, 0.74, 0.74),
)
"""Red, green, blue of the first robot, the second, ...; then over again."""
_LANDMARK_COLOUR = (0.75, 0.75, 0.75)
_WALL_COLOUR = (0.45, 0.45, 0.50)
_LINE_WIDTH_M = 0.05
_POINT_WIDTH_M = 0.1
_SIGMAS = 3.0

_WALL_CORNERS = np.array([[0, 0], [1, 0], [1, 1], [1, 1], [0, 1], [0, 0]])
"""Which end of a wall, and which of its edges (0 bottom, 1 top): two triangles."""
_WALL_SIZE = len(_WALL_CORNERS)

_MATRIX = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Where the elements of a 3 x 3 covariance are among its six."""


def encode_walls(walls: Walls, stamp_ns: int) -> bytes:
    """Marker in `map`: two triangles a wall, one metre high, with the height as their scale."""
    return _encode(
        _marker(
            stamp_ns,
            "walls",
            Marker.TRIANGLE_LIST,
            _wall_points(walls.segments),
            (1.0, 1.0, walls.height_m),
            _WALL_COLOUR,
        )
    )


def decode_walls(data: bytes) -> Walls:
    """Exactly the walls that were encoded."""
    what = "walls"
    marker = _decode(Marker, data, what)
    _stamp_ns(marker.header, what)
    _require_frame(marker.header.frame_id, (MAP_FRAME,), what)
    points = np.array([(p.x, p.y, p.z) for p in marker.points], np.float64).reshape(-1, 3)
    _require_finite(points, what, "corner")
    segments = points[: len(points) // _WALL_SIZE * _WALL_SIZE].reshape(-1, _WALL_SIZE, 3)
    segments = segments[:, :2, :2].reshape(-1, 4)
    height_m = marker.scale.z
    if not (
        marker.type == Marker.TRIANGLE_LIST
        and np.array_equal(points, _wall_points(segments))
        and 0 < height_m < math.inf
    ):
        raise InputError(
            f"{what}: marker of type {marker.type} with {len(points)} corners and scale.z = "
            f"{height_m} is no list of upright walls; publish two triangles a wall, z from 0 to 1, "
            "and the height as scale.z"
        )
    return Walls(segments, height_m)


def encode_markers(landmarks: LandmarkMap, paths: Mapping[str, Trajectory], stamp_ns: int) -> bytes:
    """MarkerArray in `map`, a whole picture: it replaces the one before.

    However many landmarks there are, they make two markers: a point each, and the three principal
    axes of each one's 3-sigma ellipsoid as lines. Each robot's path is one line in its colour.
    """
    centres = landmarks.positions.astype(np.float64)
    axes = _principal_axes(landmarks.covariances)
    ends = centres[:, None, None] + np.stack([axes, -axes], axis=2)
    pictures = [
        ("landmarks", Marker.POINTS, centres, (_POINT_WIDTH_M,) * 3, _LANDMARK_COLOUR),
        ("3 sigma", Marker.LINE_LIST, ends.reshape(-1, 3), _line_scale(0.4), _LANDMARK_COLOUR),
    ]
    for (robot, path), colour in zip(paths.items(), itertools.cycle(_COLOURS), strict=False):
        points = path.poses * (1, 1, 0)
        pictures.append((f"path of {robot}", Marker.LINE_STRIP, points, _line_scale(1.0), colour))
    clear = _marker(stamp_ns, "", Marker.POINTS, np.zeros((0, 3)), (0.0,) * 3, (0.0,) * 3)
    clear.action = Marker.DELETEALL
    drawn = [_marker(stamp_ns, *picture) for picture in pictures]
    return _encode(MarkerArray([clear, *(marker for marker in drawn if _is_visible(marker))]))


def _is_visible(marker: Any) -> bool:
    """RViz complains about lists without points, and about a line strip of one."""
    return len(marker.points) > (marker.type == Marker.LINE_STRIP)


def _principal_axes(covariances: np.ndarray) -> np.ndarray:
    """(N, 3, 3): half axes of the 3-sigma ellipsoids [m], one a row, of `covariances` (N, 6)."""
    variances, directions = np.linalg.eigh(covariances.astype(np.float64)[:, _MATRIX])
    lengths = _SIGMAS * np.sqrt(variances.clip(min=0))
    return lengths[:, :, None] * directions.swapaxes(1, 2)


def _line_scale(share: float) -> tuple[float, float, float]:
    return (_LINE_WIDTH_M * share, 0.0, 0.0)


def _wall_points(segments: np.ndarray) -> np.ndarray:
    """(6 W, 3) corners of the triangles of `segments` (W, 4), one metre high."""
    end, edge = _WALL_CORNERS.T
    places = segments.reshape(-1, 2, 2)[:, end]
    edges = np.broadcast_to(edge[:, None], (len(segments), _WALL_SIZE, 1))
    return np.concatenate([places, edges], axis=2).reshape(-1, 3)


def _marker(
    stamp_ns: int,
    namespace: str,
    kind: int,
    points: np.ndarray,
    scale: tuple[float, float, float],
    colour: tuple[float, float, float],
) -> Any:
    header = _header(stamp_ns, MAP_FRAME)
    return Marker(
        header=header,
        ns=namespace,
        id=0,
        type=kind,
        action=Marker.ADD,
        pose=_spatial((0, 0, 0)),
        scale=Vector3(*scale),
        color=ColorRGBA(*colour, 1.0),
        lifetime=Duration(0, 0),
        frame_locked=False,
        points=[Point(*point) for point in points.tolist()],
        colors=[],
        texture_resource="",
        texture=CompressedImage(header, "", np.zeros(0, np.uint8)),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=MeshFile("", np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )


# Words and numbers

OK, WARN, ERROR, STALE = range(4)
"""Levels of a `Status`."""


class Status(NamedTuple):
    """One entry of a DiagnosticArray."""

    name: str
    values: Mapping[str, str]
    level: int = OK
    message: str = ""
    hardware_id: str = ""


def encode_text(text: str) -> bytes:
    """String."""
    return _encode(String(text))


def decode_text(data: bytes) -> str:
    return _decode(String, data, "text").data


def encode_diagnostics(stamp_ns: int, statuses: Iterable[Status]) -> bytes:
    """DiagnosticArray."""
    entries = [
        DiagnosticStatus(
            s.level,
            s.name,
            s.message,
            s.hardware_id,
            [KeyValue(*pair) for pair in s.values.items()],
        )
        for s in statuses
    ]
    return _encode(DiagnosticArray(_header(stamp_ns, ""), entries))


def decode_diagnostics(data: bytes, what: str = "diagnostics") -> tuple[int, tuple[Status, ...]]:
    """Stamp [ns] and entries."""
    message = _decode(DiagnosticArray, data, what)
    return _stamp_ns(message.header, what), tuple(_status(s, what) for s in message.status)


def _status(status: Any, what: str) -> Status:
    if status.level not in (OK, WARN, ERROR, STALE):
        raise InputError(f"{what}: level = {status.level} of {status.name!r}; it must be 0 to 3")
    values = {pair.key: pair.value for pair in status.values}
    return Status(status.name, values, status.level, status.message, status.hardware_id)


def encode_step(record: StepRecord) -> bytes:
    """DiagnosticArray: one entry for the step, then one for each robot's frame.

    Numbers are written with as many digits as bring back every bit. Estimates are not part of it:
    they are published on each robot's `pose`.
    """
    values = {
        "step": str(record.step),
        "effective_particles": repr(float(record.effective_particles)),
        "resampled": str(int(record.resampled)),
        "duration_ms": repr(float(record.duration_ms)),
    }
    step = Status("fusion: step", values, message=f"step {record.step}")
    return encode_diagnostics(record.stamp_ns, [step, *map(_frame_status, record.frames)])


def decode_step(data: bytes) -> StepRecord:
    """The step without its estimates."""
    stamp_ns, statuses = decode_diagnostics(data, _STEP)
    if not statuses:
        raise InputError(f"{_STEP}: no entry for the step; record it again")
    values = statuses[0].values
    return StepRecord(
        stamp_ns,
        step=_number(values, "step", int),
        frames=tuple(_frame(status) for status in statuses[1:]),
        estimates=(),
        effective_particles=_number(values, "effective_particles", float),
        resampled=_number(values, "resampled", _flag),
        duration_ms=_number(values, "duration_ms", float),
    )


_STEP = "filter step"

_FRAME_LISTS = {
    "landmarks": np.int64,
    "is_new": bool,
    "is_rejected": bool,
    "mahalanobis": np.float32,
    "descriptor_distance": np.float32,
}
"""Per-observation values of a frame; true and false are written as 1 and 0."""


def _frame_status(frame: FrameRecord) -> Status:
    observed, new = len(frame.landmarks), int(np.count_nonzero(frame.is_new))
    values = {
        "observed": str(observed),
        "new": str(new),
        "matched": str(observed - new),
        "rejected": str(int(np.count_nonzero(frame.is_rejected))),
    }
    for name, dtype in _FRAME_LISTS.items():
        numbers = getattr(frame, name).astype(np.uint8 if dtype is bool else dtype)
        values[name] = " ".join(map(str, numbers))
    return Status(f"fusion: {frame.robot}", values, hardware_id=frame.robot)


def _frame(status: Status) -> FrameRecord:
    lists = {name: _numbers(status, name, dtype) for name, dtype in _FRAME_LISTS.items()}
    observed = _number(status.values, "observed", int)
    for name, values in lists.items():
        if len(values) != observed:
            raise InputError(
                f"{_STEP}: {len(values)} {name} of {observed} observations; record it again"
            )
    return FrameRecord(status.hardware_id, **lists)


def _text(values: Mapping[str, str], key: str) -> str:
    try:
        return values[key]
    except KeyError:
        raise InputError(f"{_STEP}: no value '{key}'; record it again") from None


def _number(values: Mapping[str, str], key: str, kind: type) -> Any:
    text = _text(values, key)
    try:
        return kind(text)
    except ValueError:
        raise InputError(f"{_STEP}: {key} = {text!r} is no number; record it again") from None


def _flag(text: str) -> bool:
    if text not in ("0", "1"):
        raise ValueError
    return text == "1"


def _numbers(status: Status, key: str, dtype: type) -> np.ndarray:
    text = _text(status.values, key)
    try:
        words = text.split()
        return np.array([_flag(word) for word in words] if dtype is bool else words, dtype)
    except (ValueError, OverflowError):
        raise InputError(f"{_STEP}: {key} = {text!r} are no numbers; record it again") from None
