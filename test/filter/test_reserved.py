"""Arrays that grow without being moved."""

import copy
import mmap

import numpy as np
import pytest

from multi_robot_slam.filter import reserved as module
from multi_robot_slam.filter.reserved import LEAST, enlarged, reserved

ROWS = LEAST // 1000


def filled(rows=ROWS):
    array = reserved((rows, 250), np.float32)
    array[:] = np.arange(rows)[:, None]
    return array


def assert_grown(larger, rows=ROWS):
    assert len(larger) == rows * 3 // 2 + 1
    assert larger.dtype == np.float32
    assert (larger[:rows] == np.arange(rows)[:, None]).all()
    larger[rows:] = -1
    assert (larger[:rows] == np.arange(rows)[:, None]).all()


def test_what_is_reserved_stays_where_it_is():
    array = filled(2 * ROWS)
    larger = enlarged(enlarged(array))
    assert larger.ctypes.data == array.ctypes.data
    array[0] = 7
    assert (larger[0] == 7).all()


def test_so_does_the_beginning_of_it():
    array = filled(2 * ROWS)
    larger = enlarged(array[:ROWS])
    assert larger.ctypes.data == array.ctypes.data
    assert_grown(larger)


@pytest.mark.parametrize("part", ["middle", "small", "foreign", "copied", "strided"])
def test_everything_else_is_copied(part):
    array = {
        "middle": lambda: filled(ROWS + 5)[5:],
        "small": lambda: reserved((4, 250), np.float32),
        "foreign": lambda: filled().copy(),
        "copied": lambda: copy.deepcopy(filled()),
        "strided": lambda: filled(2 * ROWS)[::2],
    }[part]()
    array[:] = np.arange(len(array))[:, None]
    larger = enlarged(array)
    assert not np.shares_memory(larger, array)
    assert_grown(larger, len(array))


def test_a_view_from_the_middle_never_extends_into_the_beginning():
    array = filled(ROWS + 5)
    larger = enlarged(array[5:])
    larger[:] = 0
    assert (array == np.arange(ROWS + 5)[:, None]).all()


def test_where_the_space_ends_the_array_moves_once(monkeypatch):
    monkeypatch.setattr(module, "SPACE", 0)
    array = filled(2 * ROWS)
    first = enlarged(array)
    assert first.ctypes.data == array.ctypes.data
    second = enlarged(first)
    assert second.ctypes.data != first.ctypes.data
    assert (second[: 2 * ROWS] == array).all()
    assert enlarged(second).ctypes.data == second.ctypes.data


@pytest.mark.parametrize("error", [OSError(12, "no"), OverflowError("no")])
def test_without_address_space_arrays_move(monkeypatch, error):
    def refuse(*_, **__):
        raise error

    monkeypatch.setattr(mmap, "mmap", refuse)
    monkeypatch.setattr(module, "_space_of", lambda array: None)
    array = filled()
    assert_grown(enlarged(array))
