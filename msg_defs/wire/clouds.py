"""PointCloud2: observations, which landmark each is of, and the landmark map."""

import struct
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from msg_defs.errors import InputError
from msg_defs.topics import CAMERA_FRAME, MAP_FRAME, PIECE_FRAME, camera_frame
from msg_defs.types import (
    DESCRIPTOR_SIZE,
    LandmarkMap,
    ObservationSet,
    ObservationTruth,
    Sightings,
)
from msg_defs.wire.cdr import LITTLE_ENDIAN, MOST_TRAILING, START, Writer
from msg_defs.wire.messages import (
    PointCloud2,
    PointField,
    decode,
    encode,
    header_of,
    require_finite,
    require_frame,
    stamp_in,
)


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
    size: int = 1
    datatypes: tuple[_Datatype, ...] = (_FLOAT32,)

    def __str__(self) -> str:
        return f"{' or '.join(d.name for d in self.datatypes)} x {self.size}"


_POSITION = (_Column("x"), _Column("y"), _Column("z"))
_OBSERVATION = (
    *_POSITION,
    _Column("covariance", 6),
    _Column("descriptor", DESCRIPTOR_SIZE, (_FLOAT32, _UINT8)),
)
_SIGHTINGS = (*_POSITION, _Column("covariance", 6), _Column("robot", 1, (_UINT32,)))
_TRUTH = (_Column("landmark", 1, (_UINT32,)),)
_MAP = (
    *_POSITION,
    _Column("covariance", 6),
    _Column("id", 1, (_UINT32,)),
    _Column("observations", 1, (_UINT32,)),
    _Column("robots", 1, (_UINT32,)),
    _Column("descriptor", DESCRIPTOR_SIZE),
)

_PIECES = (*_MAP, _Column("piece", 1, (_UINT32,)))

_UINT8_DESCRIPTOR_SCALE = np.float32(1 / 512)
"""SIFT as bytes is 512 times the unit vector."""

_FLIP_POSITION = np.array([1, -1, 1], np.float32)
"""Camera frame (Y up) <-> optical frame (y down)."""
_FLIP_COVARIANCE = np.array([1, -1, 1, 1, -1, 1], np.float32)


def encode_observations(observations: ObservationSet, frame: str = CAMERA_FRAME) -> bytes:
    """PointCloud2 in the `frame`, in which {robot} stands for the name."""
    columns = {
        **_position_columns(observations.positions * _FLIP_POSITION),
        "covariance": observations.covariances * _FLIP_COVARIANCE,
        "descriptor": observations.descriptors,
    }
    frame_id = camera_frame(observations.robot, frame)
    return _encode_cloud(_OBSERVATION, columns, observations.stamp_ns, frame_id)


def decode_observations(data: bytes, robot: str, frame: str = CAMERA_FRAME) -> ObservationSet:
    """The message in the `frame`, in which {robot} stands for the name; if empty, in any.

    Descriptors may be FLOAT32, or UINT8 for 512 times the value.
    """
    what = f"observations of {robot}"
    stamp_ns, columns = _decode_cloud(data, _OBSERVATION, camera_frame(robot, frame), what)
    return ObservationSet(
        robot,
        stamp_ns,
        *_seen_by_camera(columns, what),
        descriptors=_float_descriptors(columns["descriptor"]),
    )


def encode_sightings(sightings: Sightings, frame: str = CAMERA_FRAME) -> bytes:
    """PointCloud2 in the `frame` of the robot that sees, as `encode_observations`."""
    columns = {
        **_position_columns(sightings.positions * _FLIP_POSITION),
        "covariance": sightings.covariances * _FLIP_COVARIANCE,
        "robot": sightings.others,
    }
    frame_id = camera_frame(sightings.robot, frame)
    return _encode_cloud(_SIGHTINGS, columns, sightings.stamp_ns, frame_id)


def decode_sightings(data: bytes, robot: str, frame: str = CAMERA_FRAME) -> Sightings:
    """As `decode_observations`."""
    what = f"sightings of {robot}"
    stamp_ns, columns = _decode_cloud(data, _SIGHTINGS, camera_frame(robot, frame), what)
    positions, covariances = _seen_by_camera(columns, what)
    return Sightings(robot, stamp_ns, columns["robot"], positions, covariances)


def _seen_by_camera(columns: dict[str, np.ndarray], what: str) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 3) in front of the camera and covariances (n, 6), in the camera frame."""
    depth = columns["z"]
    behind = np.flatnonzero(depth <= 0)
    if behind.size:
        raise InputError(
            f"{what}: depth z = {depth[behind[0]]:g} m of point {behind[0]} is not in front of "
            "the camera; publish points in the optical frame, z forward"
        )
    covariances = columns["covariance"]
    _require_definite(_is_definite(covariances), covariances, what)
    return _positions(columns) * _FLIP_POSITION, covariances * _FLIP_COVARIANCE


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
    return _encode_cloud(_MAP, _map_columns(landmarks), stamp_ns, MAP_FRAME)


def _map_columns(landmarks: LandmarkMap) -> dict[str, np.ndarray]:
    return {
        **_position_columns(landmarks.positions),
        "covariance": landmarks.covariances,
        "id": landmarks.ids,
        "observations": landmarks.observations,
        "robots": landmarks.robots,
        "descriptor": landmarks.descriptors,
    }


def encode_pieces(landmarks: LandmarkMap, pieces: np.ndarray, stamp_ns: int) -> bytes:
    """PointCloud2 of landmarks, each in the frame of its piece, whose numbers are `pieces` (N,)."""
    columns = {**_map_columns(landmarks), "piece": pieces.astype(np.uint32)}
    return _encode_cloud(_PIECES, columns, stamp_ns, PIECE_FRAME)


def decode_pieces(data: bytes) -> tuple[LandmarkMap, np.ndarray]:
    """The landmarks, and the pieces (N,) uint32 that they belong to."""
    what = "landmarks of pieces"
    _, columns = _decode_cloud(data, _PIECES, PIECE_FRAME, what)
    return _map_in(columns, what), columns["piece"]


def decode_map(data: bytes) -> LandmarkMap:
    """A covariance is positive definite, or zero as in a true map."""
    what = "landmark map"
    _, columns = _decode_cloud(data, _MAP, MAP_FRAME, what)
    return _map_in(columns, what)


def _map_in(columns: dict[str, np.ndarray], what: str) -> LandmarkMap:
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
    dtype, fields, _ = _LAYOUTS[table]
    count = len(columns[table[0].name])
    points = np.empty(count, dtype)
    for column in table:
        points[column.name] = columns[column.name]
    return encode(
        PointCloud2(
            header=header_of(stamp_ns, frame_id),
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


def _layout(table: tuple[_Column, ...]) -> tuple[np.dtype, list, bytes]:
    """The fields of `table`, one after the other without gaps; and how a message states them."""
    dtype = np.dtype([(c.name, c.datatypes[0].dtype, (c.size,) * (c.size > 1)) for c in table])
    places: Mapping[str, Any] = dtype.fields or {}
    fields = [PointField(c.name, places[c.name][1], c.datatypes[0].code, c.size) for c in table]
    stated = Writer().numbers("I", len(fields))
    for field in fields:
        stated.text(field.name).numbers("I", field.offset).numbers("B", field.datatype)
        stated.numbers("I", field.count)
    return dtype, fields, stated.done()[START:]


_TABLES: tuple[tuple[_Column, ...], ...] = (_OBSERVATION, _SIGHTINGS, _TRUTH, _MAP, _PIECES)
_LAYOUTS = {table: _layout(table) for table in _TABLES}


def _decode_cloud(
    data: bytes, table: tuple[_Column, ...], frame_id: str, what: str
) -> tuple[int, dict[str, np.ndarray]]:
    """Stamp, and one array (n,) or (n, count) for each column of `table`; more fields may be there.

    Fields may come in any order and with gaps, rows may be padded, a cloud may have several rows
    and either byte order.
    """
    cloud = _plain_cloud(data, table) or _general_cloud(data, what)
    if frame_id:
        setting = "" if frame_id in (MAP_FRAME, PIECE_FRAME) else "camera_frame"
        require_frame(cloud.frame_id, (frame_id,), what, setting=setting)
    stamp_ns = stamp_in(cloud.seconds, cloud.nanoseconds, what)
    fields = {field.name: field for field in cloud.fields}
    if len(fields) < len(cloud.fields):
        raise InputError(f"{what}: fields {_names(cloud)}; name each once")
    points = _point_bytes(cloud, what)
    return stamp_ns, {c.name: _column(points, c, fields.get(c.name), cloud, what) for c in table}


class _Cloud(NamedTuple):
    """What is read of a PointCloud2."""

    seconds: int
    nanoseconds: int
    frame_id: str
    fields: list
    height: int
    width: int
    is_bigendian: bool
    point_step: int
    row_step: int
    data: np.ndarray


def _general_cloud(data: bytes, what: str) -> _Cloud:
    cloud = decode(PointCloud2, data, what)
    return _Cloud(
        cloud.header.stamp.sec,
        cloud.header.stamp.nanosec,
        cloud.header.frame_id,
        cloud.fields,
        cloud.height,
        cloud.width,
        cloud.is_bigendian,
        cloud.point_step,
        cloud.row_step,
        cloud.data,
    )


def _plain_cloud(data: bytes, table: tuple[_Column, ...]) -> _Cloud | None:
    """The cloud, where its fields are stated as `_encode_cloud` does; else None."""
    if len(data) < _HEADER.size or data[:2] != LITTLE_ENDIAN:
        return None
    seconds, nanoseconds, length = _HEADER.unpack_from(data)
    _, fields, stated = _LAYOUTS[table]
    text_end = _HEADER.size + length
    size_at = text_end + -length % 4
    fields_at = size_at + _SIZE.size
    points_at = fields_at + len(stated)
    if (
        data[points_at - len(stated) : points_at] != stated
        or data[text_end - 1 : text_end] != b"\0"
    ):
        return None
    if len(data) < points_at + _POINTS.size:
        return None
    is_bigendian, point_step, row_step, size = _POINTS.unpack_from(data, points_at)
    start = points_at + _POINTS.size
    trailing = len(data) - (start + size + 1)
    if not 0 <= trailing <= MOST_TRAILING or is_bigendian > 1:
        return None
    try:
        frame_id = data[_HEADER.size : text_end - 1].decode()
    except UnicodeDecodeError:
        return None
    points = np.frombuffer(data, np.uint8, size, start)
    height, width = _SIZE.unpack_from(data, size_at)
    return _Cloud(
        seconds,
        nanoseconds,
        frame_id,
        fields,
        height,
        width,
        bool(is_bigendian),
        point_step,
        row_step,
        points,
    )


_HEADER = struct.Struct("<4xiII")
"""Stamp, and the length of frame_id, which follows."""
_SIZE = struct.Struct("<II")
"""Height and width; the fields follow."""
_POINTS = struct.Struct("<B3xIII")
"""Byte order, sizes of a point, a row, and the data, which follow, and then whether it is dense."""


def _point_bytes(cloud: _Cloud, what: str) -> np.ndarray:
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


def _column(
    points: np.ndarray, column: _Column, field: Any, cloud: _Cloud, what: str
) -> np.ndarray:
    if field is None:
        raise InputError(
            f"{what}: no field '{column.name}' among {_names(cloud)}; publish it as {column}"
        )
    datatype = next((d for d in column.datatypes if d.code == field.datatype), None)
    if datatype is None or field.count != column.size:
        raise InputError(
            f"{what}: field '{column.name}' has datatype {field.datatype} x {field.count}; "
            f"publish it as {column}"
        )
    end = field.offset + datatype.dtype.itemsize * column.size
    if end > cloud.point_step:
        raise InputError(
            f"{what}: field '{column.name}' ends at byte {end} of a point of {cloud.point_step} "
            "bytes; correct its offset or point_step"
        )
    stored = datatype.dtype.newbyteorder(">") if cloud.is_bigendian else datatype.dtype
    values = points[:, field.offset : end].copy().view(stored).astype(datatype.dtype, copy=False)
    if datatype is _FLOAT32:
        require_finite(values, what, column.name)
    return values if column.size > 1 else values[:, 0]


def _names(cloud: _Cloud) -> str:
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
