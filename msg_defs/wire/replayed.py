"""What a replay needs beside the recorded bytes: the clock, and other names for the robots."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from msg_defs.wire.messages import Clock, Time, decode, encode, message_type

_FRAMES = ("frame_id", "child_frame_id")


def encode_clock(stamp_ns: int) -> bytes:
    """Clock."""
    return encode(Clock(Time(*divmod(stamp_ns, 10**9))))


def renamed(data: bytes, type_name: str, names: Mapping[str, str]) -> bytes:
    """The message with the frames of robots renamed as `names` tells, old to new.

    Every other value is kept; `InputError` where the bytes are no such message.
    """
    message = decode(message_type(type_name), data, type_name)
    _rename(message, names)
    return encode(message)


def _rename(value: Any, names: Mapping[str, str]) -> None:
    if isinstance(value, list):
        for element in value:
            _rename(element, names)
    elif is_dataclass(value):
        for field in fields(value):
            inner = getattr(value, field.name)
            if field.name in _FRAMES:
                robot, slash, frame = inner.partition("/")
                setattr(value, field.name, names.get(robot, robot) + slash + frame)
            else:
                _rename(inner, names)
