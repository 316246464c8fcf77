"""Taken apart and put together again: equal, shared alike, and nothing that is not known."""

import json
from collections import Counter, deque
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from msg_defs.errors import InputError
from multi_robot_slam.maps.graph import Known, Parts, Taken, put_together


class Pair(NamedTuple):
    first: object
    second: object


@dataclass(frozen=True, eq=False)
class Frozen:
    value: object


class Speaker:
    def __init__(self):
        self.said = []
        self.say = self.note

    def note(self, text):
        self.said.append(text)


def times(factor, value):
    return factor * value


KNOWN = Known([Pair, Frozen, Speaker], [times])


def through(value, known=KNOWN, **external):
    return put_together(Taken(value, known, external).parts(), known, external)


def same(one, other):
    """Equal in value, type and, of arrays, layout."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray | np.generic):
        equal = one.dtype == other.dtype and one.tobytes() == other.tobytes()
        return equal and one.shape == other.shape
    if isinstance(one, Frozen):
        return same(one.value, other.value)
    if isinstance(one, tuple | list | deque):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, dict):
        return same(list(one), list(other)) and same(list(one.values()), list(other.values()))
    return one == other or (one != one and other != other)


ARRAYS = hnp.arrays(
    st.sampled_from(["<f8", "<f4", "<i4", "<i8", "<u8", "|b1", "|u1", "<i2"]),
    hnp.array_shapes(min_dims=0, min_side=0, max_side=4),
)
KEYS = st.text(max_size=3) | st.integers() | st.tuples(st.integers(0, 9), st.integers(0, 9))
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary() | ARRAYS,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.lists(inner, max_size=4).map(tuple)
        | st.lists(inner, max_size=4).map(lambda own: deque(own, maxlen=5))
        | st.dictionaries(KEYS, inner, max_size=3)
        | st.builds(Pair, inner, inner)
        | st.builds(Frozen, inner)
    ),
    max_leaves=12,
)


@given(VALUES)
def test_what_is_put_together_equals_what_was_taken_apart(value):
    assert same(through(value), value)
    lasting = Known([Pair, Frozen, Speaker], lasting=[Pair, Frozen])
    assert same(through(value, lasting), value)


@given(ARRAYS, st.randoms())
def test_arrays_keep_their_layout_in_memory(array, random):
    axes = list(range(array.ndim))
    random.shuffle(axes)
    moved = array.transpose(axes)
    again = through(moved)
    assert same(again, moved)
    if array.size > 1 and 1 not in array.shape:
        assert again.strides == moved.strides
    wide = np.broadcast_to(array, (3, *array.shape))
    assert same(through(wide), wide)
    assert Taken(wide, KNOWN, {}).parts().buffers[array.dtype.str].size == array.size


def test_what_is_shared_is_shared_again_and_cycles_are_no_trouble():
    array, speaker = np.arange(3.0), Speaker()
    speaker.said.append(speaker)
    first, second, again = through([array, array, speaker])
    assert first is second
    assert again.said[0] is again
    again.say("hello")
    assert again.said[1:] == ["hello"]
    assert speaker.said == [speaker]


def test_what_happens_later_has_no_effect():
    array = np.zeros(3)
    taken = Taken([array, [array]], KNOWN, {})
    array[:] = 1
    assert (put_together(taken.parts(), KNOWN, {})[0] == 0).all()


def test_generators_go_on_and_spawn_as_they_would_have():
    rng = np.random.default_rng(5)
    rng.spawn(2)
    rng.random(7)
    rng.integers(0, 10, dtype=np.int32)
    again = through(rng)
    for one, other in ((rng, again), (rng.spawn(1)[0], again.spawn(1)[0])):
        assert (
            one.integers(0, 9, 5, np.int32).tobytes() == other.integers(0, 9, 5, np.int32).tobytes()
        )
        assert one.standard_normal(5).tobytes() == other.standard_normal(5).tobytes()


def test_sets_counters_scalars_functions_and_strangers():
    value = [{1, 2}, Counter(a=2), np.float32(0.1), np.dtype("<f4"), partial(times, 3, value=b"a")]
    again = through(value)
    assert again[:4] == value[:4]
    assert [type(one) for one in again] == [type(one) for one in value]
    assert again[4]() == b"aaa"
    assert through([print], say=print) == [print]


@pytest.mark.parametrize(
    "stranger", [object(), print, lambda: 1, np.array([None]), partial(print), 1j, Counter]
)
def test_what_is_not_known_cannot_be_taken_apart(stranger):
    with pytest.raises(TypeError, match="cannot be saved"):
        Taken([stranger], KNOWN, {})


def parts_of_something():
    value = {"a": [Pair(np.arange(6.0).reshape(2, 3), Frozen(b"x")), Speaker(), Counter("ab")]}
    value["b"] = [np.random.default_rng(1), partial(times, 2), deque([1.5], 3), {"c"}]
    return Taken(value, KNOWN, {}).parts()


@given(st.data())
def test_a_table_that_is_none_is_refused(data):
    parts = parts_of_something()
    table = json.loads(parts.table)
    row = data.draw(st.sampled_from(table))
    junk = st.recursive(
        st.none() | st.integers(-3, 30) | st.text(max_size=5) | st.floats(),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=2), inner),
        max_leaves=5,
    )
    row[data.draw(st.integers(0, len(row) - 1))] = data.draw(junk)
    with suppress(InputError):  # and nothing else
        put_together(Parts(json.dumps(table), parts.buffers), KNOWN, {})


@pytest.mark.parametrize(
    "table",
    [
        "",
        "[]",
        "{}",
        "[[0]]",
        '[["_init__"]]',
        '[["object", "os.system"]]',
        '[["method", [0], "note"]]',
        '[["partial", "print", [1], [2]], ["tuple"], ["dict"]]',
        '[["list", [0], ' + "[" * 10_000,
        '[["array", "|O", 0, [1], [0], [1]]]',
        '[["array", "<f8", 0, [1000000000000, 1000000000000], [0, 1], [1, 1]]]',
        '[["object", "test_graph.Frozen"]]',
        '[["object", "test_graph.Frozen", ["value", 1], ["other", 1]]]',
    ],
)
def test_nothing_strange_is_put_together(table):
    with pytest.raises(InputError, match="no state of this program"):
        put_together(Parts(table, {"<f8": np.zeros(1)}), KNOWN, {})
