"""What a settings field may hold: its type and limits, checked, and put into words.

A field is declared as `Annotated[type, limits, "description [unit]"]`; limits come from
`annotated_types`. Types are bool, int, float, str, `Literal`, tuples and mappings of these, and
other settings.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from functools import cache
from math import isfinite
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeGuard,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np

from msg_defs.errors import InputError

AT_ANY_TIME = object()
"""Marks a field that, as a ROS parameter, may change while a node runs."""

_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text"}
_PLURALS = {bool: "booleans", int: "whole numbers", float: "numbers", str: "texts"}


class Field(NamedTuple):
    """One field of a settings class."""

    name: str
    kind: Any
    """Its type without the annotation."""
    metadata: tuple

    @property
    def description(self) -> str:
        """What it means, with its unit."""
        return "; ".join(text for text in self.metadata if isinstance(text, str))

    def allowed(self) -> str:
        """Its type and range in words: 'a whole number, 1 <= value <= 9'."""
        return ", ".join(filter(None, (_words(self.kind), bounds_of(self.metadata).words())))

    def wanted(self) -> str:
        """What to give for it, in words: what is allowed, and what it means."""
        if _is_settings(self.kind):
            names = ", ".join(field.name for field in fields_of(self.kind))
            return f"the settings in it by their names: {names}"
        list_of = "a list of " if get_origin(self.kind) is tuple else ""
        return list_of + ": ".join(filter(None, (self.allowed(), self.description)))


@dataclass(frozen=True)
class Bounds:
    """Limits of a number, or of a length."""

    ge: float | None = None
    gt: float | None = None
    le: float | None = None
    lt: float | None = None
    min_length: int | None = None

    def hold(self, value: Any) -> bool:
        """Whether the value lies within."""
        if self.min_length is not None and len(value) < self.min_length:
            return False
        return (
            (self.ge is None or value >= self.ge)
            and (self.gt is None or value > self.gt)
            and (self.le is None or value <= self.le)
            and (self.lt is None or value < self.lt)
        )

    def words(self) -> str:
        """The range, such as '0 < value <= 1'; empty where there is none."""
        if self.min_length is not None:
            return f"{self.min_length} or more"
        low = "" if self.ge is None else f"{self.ge} <= "
        low = low if self.gt is None else f"{self.gt} < "
        high = "" if self.le is None else f" <= {self.le}"
        high = high if self.lt is None else f" < {self.lt}"
        return f"{low}value{high}" if low or high else ""


@cache
def fields_of(cls: type) -> tuple[Field, ...]:
    """The fields of a settings class, in order."""
    found = []
    for name, hint in get_type_hints(cls, include_extras=True).items():
        kind, *metadata = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        found.append(Field(name, kind, tuple(metadata)))
    return tuple(found)


def leaves(cls: type, prefix: str = "") -> Iterator[Field]:
    """The fields of a settings class and of those nested in it, with dotted names."""
    for field in fields_of(cls):
        if _is_settings(field.kind):
            yield from leaves(field.kind, f"{prefix}{field.name}.")
        else:
            yield field._replace(name=prefix + field.name)


def find(cls: type, keys: Iterable[str | int]) -> Field | None:
    """The innermost field on the way of `keys` into a settings class and what it nests."""
    found, inner = None, cls
    for key in keys:
        fields = {field.name: field for field in fields_of(inner)}
        if not isinstance(key, str) or key not in fields:
            break
        found = fields[key]
        if not _is_settings(found.kind):
            break
        inner = found.kind
    return found


def row_or_word(kind: Any) -> tuple[int, str] | None:
    """Length of the row and the word, where a `kind` is either: `tuple[...] | Literal["word"]`."""
    if get_origin(kind) not in (Union, UnionType):
        return None
    row, word = get_args(kind)
    if get_origin(row) is not tuple or get_origin(word) is not Literal:
        return None
    return len(get_args(row)), get_args(word)[0]


def bounds_of(metadata: tuple) -> Bounds:
    """The limits among an annotation's metadata."""
    limits = {
        name: limit
        for one in metadata
        for name in Bounds.__dataclass_fields__
        if (limit := getattr(one, name, None)) is not None
    }
    return Bounds(**limits)


def check(record: Any) -> None:
    """Check every field of a new settings record; `InputError` names one that does not fit.

    Whatever means the same is turned into the field's own type: a list into a tuple, a NumPy number
    into a Python one.
    """
    cls: type = type(record)
    for field in fields_of(cls):
        given = getattr(record, field.name)
        try:
            value = _fitting(field.kind, given)
        except (TypeError, ValueError):
            raise _complaint(record, field, given) from None
        if not bounds_of(field.metadata).hold(value):
            raise _complaint(record, field, given)
        if value is not given:
            object.__setattr__(record, field.name, value)


def _complaint(record: object, field: Field, given: object) -> InputError:
    said = f": {field.description}" if field.description else ""
    name = f"{type(record).__name__}: {field.name}"
    return InputError(f"{name} = {given!r}; give {field.allowed()}{said}")


def _fitting(kind: Any, value: Any) -> Any:
    """The value as `kind`; `ValueError` or `TypeError` where it is none."""
    if kind in _SCALARS:
        return _SCALARS[kind](value)
    if kind is NoneType:
        return _required(value, value is None)
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Literal:
        return _required(value, value in arguments)
    if origin is tuple:
        return _tuple(arguments, value)
    if origin in (Union, UnionType):
        return _one_of(arguments, value)
    if _is_settings(kind):
        return _required(value, isinstance(value, kind))
    if origin in (dict, Mapping):
        key_kind, value_kind = arguments
        return {_fitting(key_kind, k): _fitting(value_kind, v) for k, v in dict(value).items()}
    return value


def _one_of(kinds: tuple, value: Any) -> Any:
    """The value as the first of `kinds` that it fits."""
    for kind in kinds[:-1]:
        try:
            return _fitting(kind, value)
        except (TypeError, ValueError):
            pass
    return _fitting(kinds[-1], value)


def _is_settings(kind: Any) -> TypeGuard[type]:
    return isinstance(kind, type) and is_dataclass(kind)


def _required(value: Any, fits: bool) -> Any:
    if not fits:
        raise ValueError
    return value


def _bool(value: Any) -> bool:
    return bool(_required(value, isinstance(value, bool | np.bool_)))


def _int(value: Any) -> int:
    fits = isinstance(value, Integral) and not isinstance(value, bool)
    return value if type(value) is int else int(_required(value, fits))


def _float(value: Any) -> float:
    fits = isinstance(value, Real) and not isinstance(value, bool) and isfinite(value)
    _required(value, fits)
    return value if type(value) is float else float(value)


def _str(value: Any) -> str:
    return _required(value, isinstance(value, str))


_SCALARS = {bool: _bool, int: _int, float: _float, str: _str}


def _tuple(kinds: tuple, value: Any) -> tuple:
    """A tuple of fixed length or, where `kinds` ends in `...`, of any."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    _required(value, isinstance(value, Sequence) and not isinstance(value, str | bytes))
    if kinds[-1] is ...:
        kinds = kinds[:1] * len(value)
    result = tuple(_fitting(kind, one) for kind, one in zip(kinds, value, strict=True))
    same = type(value) is tuple and all(a is b for a, b in zip(result, value, strict=True))
    return value if same else result


def _words(kind: Any) -> str:
    """A type in plain words."""
    if kind in _WORDS:
        return _WORDS[kind]
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Literal:
        return " or ".join(map(str, arguments))
    if origin is not tuple:
        return getattr(kind, "__name__", str(kind))
    count = "" if arguments[-1] is ... else f"{len(arguments)} "
    if get_origin(arguments[0]) is tuple:
        return f"{count}rows of {_words(arguments[0])}"
    if row_or_word(arguments[0]):
        row, word = get_args(arguments[0])
        return f"{count}rows of {_words(row)}, or {_words(word)}"
    return f"{count}{_PLURALS.get(arguments[0]) or _words(arguments[0])}"
