"""ROS's message types, their CDR bytes, and the header all of them have."""

import importlib
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from msg_defs.errors import InputError

_STORE = get_typestore(Stores.ROS2_JAZZY)
_TYPES: Mapping[str, Any] = _STORE.types
Time = _TYPES["builtin_interfaces/msg/Time"]
DiagnosticArray = _TYPES["diagnostic_msgs/msg/DiagnosticArray"]
PoseArray = _TYPES["geometry_msgs/msg/PoseArray"]
PoseWithCovarianceStamped = _TYPES["geometry_msgs/msg/PoseWithCovarianceStamped"]
Odometry = _TYPES["nav_msgs/msg/Odometry"]
Path = _TYPES["nav_msgs/msg/Path"]
Clock = _TYPES["rosgraph_msgs/msg/Clock"]
CameraInfo = _TYPES["sensor_msgs/msg/CameraInfo"]
CompressedImage = _TYPES["sensor_msgs/msg/CompressedImage"]
Image = _TYPES["sensor_msgs/msg/Image"]
PointCloud2 = _TYPES["sensor_msgs/msg/PointCloud2"]
PointField = _TYPES["sensor_msgs/msg/PointField"]
RegionOfInterest = _TYPES["sensor_msgs/msg/RegionOfInterest"]
Header = _TYPES["std_msgs/msg/Header"]
String = _TYPES["std_msgs/msg/String"]
Marker = _TYPES["visualization_msgs/msg/Marker"]


_CDR_HEADER = 4
"""Bytes before a message: the second of them tells the byte order."""
_STAMP_END = _CDR_HEADER + 8


def message_type(type_name: str) -> Any:
    """The class this module decodes a message type to; `InputError` where ROS has none such."""
    try:
        return _TYPES[type_name]
    except KeyError:
        raise InputError(f"{type_name} is no message type of ROS 2 Jazzy; use one") from None


def is_known(type_name: str) -> bool:
    """ROS 2 Jazzy has messages of this type."""
    return type_name in _TYPES


def message_class(type_name: str) -> type:
    """ROS's own class of a message type such as `nav_msgs/msg/Odometry`; needs ROS."""
    package, _, name = type_name.partition("/msg/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def message_schema(type_name: str) -> tuple[str, str]:
    """The `ros2msg` text of a message type with all it contains, and its RIHS01 hash."""
    return _STORE.generate_msgdef(type_name, ros_version=2)[0], _STORE.hash_rihs01(type_name)


def encode(message: Any) -> bytes:
    """CDR bytes of a message."""
    return bytes(_STORE.serialize_cdr(message, message.__msgtype__))


def decode(message_type: Any, data: bytes | memoryview, what: str) -> Any:
    """The message in CDR bytes; `what` it is begins the complaint when it is none."""
    name = message_type.__msgtype__
    try:
        return _STORE.deserialize_cdr(data, name)
    except SerdeError as error:
        raise InputError(
            f"{what}: {len(data)} bytes are no {name}: {error} Check the publisher's message type"
        ) from None


def header_of(stamp_ns: int, frame_id: str) -> Any:
    """Header of a stamp in nanoseconds."""
    return Header(Time(*divmod(int(stamp_ns), 10**9)), frame_id)


def stamp_of(header: Any, what: str) -> int:
    """Stamp of a header [ns]."""
    return stamp_in(header.stamp.sec, header.stamp.nanosec, what)


def peek_stamp(data: bytes, what: str) -> int:
    """Stamp [ns] of a message that begins with a header, without decoding the rest."""
    if len(data) < _STAMP_END:
        raise InputError(
            f"{what}: {len(data)} bytes are no message with a stamp; check the publisher's type"
        )
    order = "<" if data[1] else ">"
    seconds, nanoseconds = struct.unpack_from(order + "iI", data, _CDR_HEADER)
    return stamp_in(seconds, nanoseconds, what)


def stamp_in(seconds: int, nanoseconds: int, what: str) -> int:
    """Stamp of these two [ns]."""
    if nanoseconds >= 10**9:
        raise InputError(f"{what}: nanosec = {nanoseconds} of the stamp; it must be below 10^9")
    return seconds * 10**9 + nanoseconds


def require_frame(
    frame_id: str, expected: tuple[str, ...], what: str, name: str = "frame_id", setting: str = ""
) -> None:
    """Complain when a frame is none of those expected, which a `setting` may change."""
    if frame_id not in expected:
        remedy = f", or set {setting}" if setting else ""
        raise InputError(
            f"{what}: {name} is {frame_id!r}; publish it as {' or '.join(expected)}{remedy}"
        )


def require_finite(values: np.ndarray, what: str, name: str) -> None:
    """Complain when `values`, (n,) or (n, k), have a NaN or an infinity."""
    finite = np.isfinite(values)
    if not finite.all():
        row = int(np.argwhere(~finite)[0, 0])
        value = values[~finite][0]
        raise InputError(f"{what}: {name}[{row}] = {value}; publish finite numbers only")
