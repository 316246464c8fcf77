"""Objects taken apart into JSON and flat arrays, and put together again: equal, and shared alike.

Every object is a row of one table, and whoever has it names the row. So what two objects share they
share again, and a cycle is no trouble. Arrays keep their dtype, shape and layout in memory, on
which sums depend in their last bit. Nothing in a table is code: classes and functions are looked up
among those that are known here, and no other is ever made.
"""

import json
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from types import MethodType
from typing import Any, NamedTuple

import numpy as np

from msg_defs.errors import InputError

PLAIN = (type(None), bool, int, float, str)
"""What JSON has itself; of a float every bit."""

CONTAINERS: dict[str, type] = {"tuple": tuple, "list": list, "set": set}

KINDS = (
    *("external of", "array", "scalar", "bytes", "dtype", "generator", "method", "partial"),
    *("tuple", "list", "set", "deque", "dict", "Counter", "tuple of", "object"),
)

WRONG = (LookupError, TypeError, ValueError, AttributeError, RecursionError, OverflowError)
"""What putting together what never was a graph raises."""


class Parts(NamedTuple):
    """A graph taken apart."""

    table: str
    """JSON: a list, of each object its kind and what it consists of; first a tuple of the root.

    A list of one number is the row of an object, everything else is itself.
    """
    buffers: dict[str, np.ndarray]
    """By dtype, such as `<f8`, the elements (n,) of all arrays, one after the other."""


class Known:
    """What a graph may consist of.

    Parameters
    ----------
    classes : whose objects are told by their attributes, or by what `__getstate__` gives.
    functions : that may be the first part of a `partial`.
    lasting : those of the classes whose objects nobody changes, nor anything that they consist of.

    """

    def __init__(
        self,
        classes: Iterable[type],
        functions: Iterable[Callable] = (),
        lasting: Iterable[type] = (),
    ) -> None:
        self.classes = {name_of(one): one for one in classes}
        self.functions = {one.__name__: one for one in functions}
        self.lasting = frozenset(lasting)


def name_of(cls: type) -> str:
    """The name of a class with that of its module."""
    return f"{cls.__module__.rpartition('.')[2]}.{cls.__name__}"


def put_together(parts: Parts, known: Known, external: Mapping[str, object]) -> Any:
    """The root of a graph, with the `external` objects in their places.

    `InputError` where the parts are none of a graph of what is known.
    """
    try:
        table = json.loads(parts.table)
        return _Maker(table, parts.buffers, known, external).of([0])[0]
    except WRONG as error:
        in_one_line = " ".join(f"{type(error).__name__}: {error}".split())
        raise InputError(f"no state of this program ({in_one_line})") from None


class Taken:
    """The graph of all that an object consists of, as it is now: what happens later has no effect.

    What is lasting is only looked at by `parts`, which may be called elsewhere, and once.
    `TypeError` for an object of a class that is not known.

    Parameters
    ----------
    root : the object.
    external : objects that are told by their names alone.

    """

    def __init__(self, root: object, known: Known, external: Mapping[str, object]) -> None:
        self._known = known
        self._external = {id(one): name for name, one in external.items()}
        self._rows: dict[int, int] = {}
        self._table: list[list] = []
        self._alive: list[object] = []
        """Objects told so far, so that no id is used again."""
        self._later: list[tuple[list, object]] | None = []
        """Rows that are empty yet, and what they will tell of."""
        self._elements: dict[str, list[np.ndarray]] = {}
        self._counts: Counter[str] = Counter()
        self._of((root,))

    def parts(self) -> Parts:
        """The graph."""
        later, self._later = self._later or [], None
        for entry, value in later:
            entry += self._entry(value)
        buffers = {dtype: np.concatenate(own) for dtype, own in self._elements.items()}
        return Parts(json.dumps(self._table, separators=(",", ":")), buffers)

    def _of(self, value: Any) -> Any:
        if type(value) in PLAIN:
            return value
        row = self._rows.get(id(value))
        if row is None:
            row = self._rows[id(value)] = len(self._table)
            self._alive.append(value)
            entry: list = []
            self._table.append(entry)
            if self._later is not None and type(value) in self._known.lasting:
                self._later.append((entry, value))
            else:
                entry += self._entry(value)
        return [row]

    def _entry(self, value: Any) -> list:
        kind = type(value)
        if id(value) in self._external:
            return ["external of", self._external[id(value)]]
        if kind is np.ndarray:
            return ["array", *self._array(value)]
        if isinstance(value, np.generic):
            return ["scalar", *self._array(np.array(value))]
        if kind.__name__ in CONTAINERS and kind is CONTAINERS[kind.__name__]:
            return [kind.__name__, *map(self._of, value)]
        if kind in (dict, Counter):
            return [kind.__name__, *([self._of(k), self._of(v)] for k, v in value.items())]
        if self._known.classes.get(name_of(kind)) is kind:
            return self._object(value)
        return self._special(value)

    def _object(self, value: Any) -> list:
        name = name_of(type(value))
        if isinstance(value, tuple):
            return ["tuple of", name, *map(self._of, value)]
        state = value.__getstate__()
        return ["object", name, *([key, self._of(own)] for key, own in (state or {}).items())]

    def _special(self, value: Any) -> list:
        if isinstance(value, deque):
            return ["deque", value.maxlen, *map(self._of, value)]
        if isinstance(value, bytes):
            return ["bytes", *self._array(np.frombuffer(value, np.uint8))]
        if isinstance(value, np.dtype):
            return ["dtype", value.str]
        if isinstance(value, np.random.Generator):
            return ["generator", *_of_generator(value)]
        if isinstance(value, MethodType):
            return ["method", self._of(value.__self__), value.__name__]
        if isinstance(value, partial) and value.func in self._known.functions.values():
            own = [self._of(value.args), self._of(value.keywords)]
            return ["partial", value.func.__name__, *own]
        raise TypeError(f"a {type(value).__name__} cannot be saved: {value!r:.80}")

    def _array(self, array: np.ndarray) -> list:
        """Dtype, place of the first element, shape of what is stored, order of its axes, shape.

        Along an axis on which all is one in memory (`broadcast_to`), one element is stored.
        """
        if array.dtype.hasobject or array.dtype.names:
            raise TypeError(f"an array of {array.dtype} cannot be saved")
        once = tuple(slice(0, 1) if s == 0 else slice(None) for s in array.strides)
        stored = array[once] if array.size else array
        order = sorted(range(array.ndim), key=lambda axis: -abs(stored.strides[axis]))
        dtype = array.dtype.str
        place = self._counts[dtype]
        self._counts[dtype] += stored.size
        self._elements.setdefault(dtype, []).append(stored.transpose(order).flatten())
        return [dtype, place, list(stored.shape), order, list(array.shape)]


class _Maker:
    def __init__(
        self,
        table: list,
        buffers: Mapping[str, np.ndarray],
        known: Known,
        external: Mapping[str, object],
    ) -> None:
        self._table, self._buffers = table, buffers
        self._known, self._external = known, external
        self._made: dict[int, Any] = {}

    def of(self, value: Any) -> Any:
        if not isinstance(value, list):
            return value
        (row,) = value
        if row not in self._made:
            kind, *rest = self._table[row]
            if kind not in KINDS:
                raise ValueError(f"no kind {kind!r}")
            self._made[row] = getattr(self, f"_{kind.replace(' ', '_')}")(row, rest)
        return self._made[row]

    def _external_of(self, row: int, rest: list) -> Any:
        return self._external[rest[0]]

    def _tuple(self, row: int, rest: list) -> tuple:
        return tuple(map(self.of, rest))

    def _list(self, row: int, rest: list) -> list:
        made: list = []
        self._made[row] = made
        made.extend(map(self.of, rest))
        return made

    def _set(self, row: int, rest: list) -> set:
        return set(map(self.of, rest))

    def _deque(self, row: int, rest: list) -> deque:
        return deque(map(self.of, rest[1:]), rest[0])

    def _dict(self, row: int, rest: list) -> dict:
        made: dict = {}
        self._made[row] = made
        made.update((self.of(key), self.of(own)) for key, own in rest)
        return made

    def _Counter(self, row: int, rest: list) -> Counter:
        return Counter(self._dict(row, rest))

    def _tuple_of(self, row: int, rest: list) -> tuple:
        made: Any = self._known.classes[rest[0]]
        return made(*map(self.of, rest[1:]))

    def _object(self, row: int, rest: list) -> Any:
        cls: Any = self._known.classes[rest[0]]
        self._made[row] = made = cls.__new__(cls)
        state = {key: self.of(own) for key, own in rest[1:]}
        if is_dataclass(cls) and state.keys() != {field.name for field in fields(cls)}:
            raise ValueError(f"{rest[0]} has other attributes in this version")
        if hasattr(cls, "__setstate__"):
            made.__setstate__(state)
        else:
            made.__dict__.update(state)
        return made

    def _array(self, row: int, rest: list) -> np.ndarray:
        dtype, place, stored, order, shape = rest
        size = int(np.prod(stored, dtype=object))
        flat = self._buffers[dtype][place : place + size] if size else np.empty(0, dtype)
        if flat.dtype.str != dtype or len(flat) != size or sorted(order) != [*range(len(shape))]:
            raise ValueError("an array is not whole")
        array = flat.reshape([stored[axis] for axis in order]).copy()
        array = array.transpose(np.argsort(order)) if order else array
        return array if stored == shape else np.broadcast_to(array, shape)

    def _scalar(self, row: int, rest: list) -> Any:
        return self._array(row, rest)[()]

    def _bytes(self, row: int, rest: list) -> bytes:
        return self._array(row, rest).tobytes()

    def _dtype(self, row: int, rest: list) -> np.dtype:
        return np.dtype(rest[0])

    def _generator(self, row: int, rest: list) -> np.random.Generator:
        return _generator_of(*rest)

    def _method(self, row: int, rest: list) -> Any:
        owner = self.of(rest[0])
        if not (type(owner) in self._known.classes.values() and hasattr(type(owner), rest[1])):
            raise ValueError(f"no method {rest[1]}")
        return getattr(owner, rest[1])

    def _partial(self, row: int, rest: list) -> partial:
        return partial(self._known.functions[rest[0]], *self.of(rest[1]), **self.of(rest[2]))


def _of_generator(rng: np.random.Generator) -> list:
    """The state of a PCG64 generator, and of the seeds that it spawns."""
    seeds: Any = rng.bit_generator.seed_seq
    bits: Any = rng.bit_generator.state
    spawned = [seeds.entropy, list(seeds.spawn_key), seeds.pool_size, seeds.n_children_spawned]
    return [bits["state"], bits["has_uint32"], bits["uinteger"], *spawned]


def _generator_of(
    state: Any,
    has_uint32: int,
    uinteger: int,
    entropy: Any,
    spawn_key: list,
    pool_size: int,
    spawned: int,
) -> np.random.Generator:
    seeds = np.random.SeedSequence(
        entropy, spawn_key=spawn_key, pool_size=pool_size, n_children_spawned=spawned
    )
    bits = np.random.PCG64(seeds)
    bits.state = {
        "bit_generator": "PCG64",
        "state": state,
        "has_uint32": has_uint32,
        "uinteger": uinteger,
    }
    return np.random.Generator(bits)
