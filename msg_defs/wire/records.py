"""Words and numbers: text, diagnostics, and the filter's step records."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, get_args

import numpy as np

from msg_defs.errors import InputError
from msg_defs.types import FrameRecord, Level, StepRecord, Tied, Verdict
from msg_defs.wire.cdr import Writer
from msg_defs.wire.messages import (
    DiagnosticArray,
    String,
    decode,
    encode,
    stamp_of,
)

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
    return encode(String(text))


def decode_text(data: bytes) -> str:
    return decode(String, data, "text").data


def encode_diagnostics(stamp_ns: int, statuses: Iterable[Status]) -> bytes:
    """DiagnosticArray."""
    entries = list(statuses)
    message = Writer().header(stamp_ns, "").numbers("I", len(entries))
    for entry in entries:
        message.numbers("B", entry.level)
        for text in (entry.name, entry.message, entry.hardware_id):
            message.text(text)
        message.numbers("I", len(entry.values))
        for key, value in entry.values.items():
            message.text(key).text(value)
    return message.done()


def decode_diagnostics(data: bytes, what: str = "diagnostics") -> tuple[int, tuple[Status, ...]]:
    """Stamp [ns] and entries."""
    message = decode(DiagnosticArray, data, what)
    return stamp_of(message.header, what), tuple(_status(s, what) for s in message.status)


def _status(status: Any, what: str) -> Status:
    if status.level not in (OK, WARN, ERROR, STALE):
        raise InputError(f"{what}: level = {status.level} of {status.name!r}; it must be 0 to 3")
    values = {pair.key: pair.value for pair in status.values}
    return Status(status.name, values, status.level, status.message, status.hardware_id)


def encode_step(record: StepRecord) -> bytes:
    """DiagnosticArray: one entry for the step, then one for each robot's frame, with its verdict.

    Numbers are written with as many digits as bring back every bit. Estimates are not part of it:
    they are published on each robot's `pose`.
    """
    values = {
        "step": str(record.step),
        "effective_particles": repr(float(record.effective_particles)),
        "resampled": str(int(record.resampled)),
        "duration_ms": repr(float(record.duration_ms)),
        "rejuvenated": "" if record.rejuvenated is None else repr(float(record.rejuvenated)),
        **({} if record.tied is None else tied_values(record.tied)),
    }
    step = Status("fusion: step", values, message=f"step {record.step}")
    verdicts = {verdict.robot: verdict for verdict in record.verdicts}
    robots = [_judged(_frame_status(frame), verdicts.get(frame.robot)) for frame in record.frames]
    return encode_diagnostics(record.stamp_ns, [step, *robots])


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
        rejuvenated=_number(values, "rejuvenated", float) if values.get("rejuvenated") else None,
        verdicts=tuple(_verdict(status) for status in statuses[1:] if _LEVEL in status.values),
        tied=_tied(values) if _TIED in values else None,
    )


_STEP = "filter step"

LEVELS: dict[Level, int] = {
    "consistent": OK,
    "place unknown": WARN,
    "noisier than told": WARN,
    "start wrong": ERROR,
    "lost": ERROR,
}
"""Level of the `Status` of a robot with this verdict; the best first."""

_LEVEL, _CAUSE, _REMEDY, _FOUND = "level", "cause", "remedy", "found: "
"""Keys of a verdict's values; the last is the prefix of its numbers' names."""


def verdict_values(verdict: Verdict) -> dict[str, str]:
    """The values of a `Status` that hold a verdict."""
    numbers = {f"{_FOUND}{name}": repr(float(x)) for name, x in verdict.numbers.items()}
    return {_LEVEL: verdict.level, _CAUSE: verdict.cause, _REMEDY: verdict.remedy, **numbers}


_TIED, _IN_MAP, _POSE = "tied", "tied: is in map", "tied: pose [m, m, rad]"
_OF_TIE = {
    "landmarks": "tied: landmarks that agree",
    "places": "tied: places that agree",
    "runner_up": "tied: places by another pose",
    "seconds": "tied: after eight were common [s]",
}
"""Field of `Tied` -> key of its number."""


def tied_values(tied: Tied) -> dict[str, str]:
    """The values of a `Status` that hold a tie."""
    return {
        _TIED: " ".join(tied.robots),
        _IN_MAP: str(int(tied.is_in_map)),
        _POSE: " ".join(repr(float(x)) for x in tied.pose),
        **{key: repr(getattr(tied, name)) for name, key in _OF_TIE.items()},
    }


def _tied(values: Mapping[str, str]) -> Tied:
    kinds = {name: float if name == "seconds" else int for name in _OF_TIE}
    return Tied(
        robots=tuple(_text(values, _TIED).split()),
        is_in_map=_number(values, _IN_MAP, _flag),
        pose=_number(values, _POSE, _pose),
        **{name: _number(values, key, kinds[name]) for name, key in _OF_TIE.items()},
    )


def _pose(text: str) -> np.ndarray:
    x, y, yaw = map(float, text.split())
    return np.array([x, y, yaw])


def _judged(status: Status, verdict: Verdict | None) -> Status:
    if verdict is None:
        return status
    return status._replace(
        values={**status.values, **verdict_values(verdict)},
        level=LEVELS[verdict.level],
        message=verdict.level,
    )


def _verdict(status: Status) -> Verdict:
    level = _text(status.values, _LEVEL)
    if level not in LEVELS:
        raise InputError(
            f"{_STEP}: level = {level!r}; it must be one of {', '.join(get_args(Level))}"
        )
    names = [key for key in status.values if key.startswith(_FOUND)]
    return Verdict(
        status.hardware_id,
        level,
        _text(status.values, _CAUSE),
        _text(status.values, _REMEDY),
        {name.removeprefix(_FOUND): _number(status.values, name, float) for name in names},
    )


_FRAME_LISTS = {
    "landmarks": np.int64,
    "is_new": bool,
    "is_rejected": bool,
    "mahalanobis": np.float32,
    "descriptor_distance": np.float32,
}
"""Values of each observation of a frame; true and false are written as 1 and 0."""

_SIGHTING_LISTS = {"others": np.int64, "other_mahalanobis": np.float32, "is_other_rejected": bool}
"""Values of each robot it sees."""


def _frame_status(frame: FrameRecord) -> Status:
    observed, new = len(frame.landmarks), int(np.count_nonzero(frame.is_new))
    values = {
        "observed": str(observed),
        "new": str(new),
        "matched": str(observed - new),
        "rejected": str(int(np.count_nonzero(frame.is_rejected))),
    }
    for name, dtype in (_FRAME_LISTS | _SIGHTING_LISTS).items():
        numbers = getattr(frame, name).astype(np.uint8 if dtype is bool else dtype)
        # As float32 a number has fewer digits.
        values[name] = " ".join(map(str, numbers if dtype is np.float32 else numbers.tolist()))
    values["sighted"] = str(len(frame.others))
    return Status(f"fusion: {frame.robot}", values, hardware_id=frame.robot)


def _frame(status: Status) -> FrameRecord:
    # Bags from before robots saw robots have none of these values.
    values = {"sighted": "0"} | dict.fromkeys(_SIGHTING_LISTS, "") | dict(status.values)
    status = status._replace(values=values)
    return FrameRecord(
        status.hardware_id,
        **_lists(status, _FRAME_LISTS, "observed"),
        **_lists(status, _SIGHTING_LISTS, "sighted"),
    )


def _lists(status: Status, dtypes: Mapping[str, type], count: str) -> dict[str, np.ndarray]:
    """The values of `dtypes`, each as many as the value `count` says."""
    lists = {name: _numbers(status, name, dtype) for name, dtype in dtypes.items()}
    expected = _number(status.values, count, int)
    for name, values in lists.items():
        if len(values) != expected:
            raise InputError(
                f"{_STEP}: {len(values)} {name} of {expected} {count}; record it again"
            )
    return lists


def _text(values: Mapping[str, str], key: str) -> str:
    try:
        return values[key]
    except KeyError:
        raise InputError(f"{_STEP}: no value '{key}'; record it again") from None


def _number(values: Mapping[str, str], key: str, kind: Callable[[str], Any]) -> Any:
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
