"""Files of arrays: read by NumPy alone, whole or not there, and safe whatever they hold."""

import os
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from msg_defs.errors import InputError
from multi_robot_slam.maps import container

ARRAYS = st.dictionaries(
    st.from_regex(r"[a-z]{1,5}(/[a-z]{1,5})?", fullmatch=True),
    hnp.arrays(
        st.sampled_from(["<f8", "<f4", "<i8", "|b1", "|u1", "<U3"]),
        hnp.array_shapes(min_dims=0, min_side=0, max_side=4),
    ),
    max_size=4,
)
IN_FOLDER = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@IN_FOLDER
@given(ARRAYS)
def test_read_is_what_was_written_and_numpy_reads_it(tmp_path, arrays):
    path = tmp_path / "a.npz"
    container.write(path, arrays)
    found = container.read(path)
    with np.load(path, allow_pickle=False) as archive:
        assert list(found) == list(arrays) == list(archive)
        for name, array in arrays.items():
            for read in (found[name], archive[name]):
                assert read.dtype == array.dtype
                assert read.shape == array.shape
                assert read.tobytes() == array.tobytes()
    assert os.listdir(tmp_path) == ["a.npz"]


def test_equal_arrays_make_equal_files(tmp_path):
    for name in "ab":
        container.write(tmp_path / name, {"x": np.arange(5)})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_others_may_compress_and_use_other_layouts(tmp_path):
    arrays = {
        "f": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "big": np.arange(3, dtype=">i4"),
    }
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    found = container.read(tmp_path / "a.npz")
    assert all((found[name] == array).all() for name, array in arrays.items())
    assert found["big"].dtype == np.dtype("<i4")


def test_only_what_is_wanted_is_read(tmp_path):
    container.write(tmp_path / "a", {"x": np.zeros(3), "y": np.zeros(3)})
    assert list(container.read(tmp_path / "a", lambda name: name == "y")) == ["y"]


def test_a_file_that_cannot_be_finished_leaves_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "a.npz"
    container.write(path, {"x": np.arange(3)})
    before = path.read_bytes()

    def full(handle):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match=r"cannot write .*No space left"):
        container.write(path, {"x": np.arange(4)})
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.npz"]


def test_no_place_to_write_is_told(tmp_path):
    with pytest.raises(InputError, match=r"cannot write .*choose another place"):
        container.write(tmp_path / "no" / "a.npz", {})


def read_or_refused(path):
    """The arrays; none where the file is refused in one line."""
    try:
        return container.read(path)
    except InputError as error:
        return {} if "\n" not in str(error) else {"": np.array(str(error))}


@IN_FOLDER
@given(st.data())
def test_a_damaged_file_is_refused_or_reads_as_it_was(tmp_path, data):
    path = tmp_path / "a.npz"
    arrays = {"x": np.arange(20.0), "y": np.ones((3, 4), np.int32)}
    container.write(path, arrays)
    whole = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        del whole[data.draw(st.integers(0, len(whole) - 1)) :]
    else:
        whole[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(whole)
    # names, times and the like are not covered by checksums
    for array in read_or_refused(path).values():
        assert any(array.tobytes() == own.tobytes() for own in arrays.values())


def archive_of(path, data, name="x.npy", compression=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr(name, data)


def header(text):
    head = text.encode()
    head += b" " * (63 - (10 + len(head)) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head


@pytest.mark.parametrize(
    "text",
    [
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,)}",
        "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (0, 99999999999999999999)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}",
        "{'descr': '<m8[s]', 'fortran_order': False, 'shape': (1,)}",
        "{'descr': '|V8', 'fortran_order': False, 'shape': (1,)}",
        "__import__('os').abort()",
        "",
    ],
)
def test_objects_lies_and_code_are_refused(tmp_path, text):
    archive_of(tmp_path / "a", header(text) + bytes(8))
    with pytest.raises(InputError, match="damaged, or no file of arrays"):
        container.read(tmp_path / "a")


def test_a_bomb_is_refused_before_it_takes_memory(tmp_path):
    zeros = header("{'descr': '|u1', 'fortran_order': False, 'shape': (50000000,)}")
    archive_of(tmp_path / "a", zeros + bytes(50_000_000), compression=zipfile.ZIP_DEFLATED)
    assert (tmp_path / "a").stat().st_size < 100_000
    tracemalloc.start()
    with pytest.raises(InputError, match="too much"):
        container.read(tmp_path / "a")
    assert tracemalloc.get_traced_memory()[1] < 5_000_000
    tracemalloc.stop()


def test_what_is_no_file_of_arrays_is_told(tmp_path):
    with pytest.raises(InputError, match="no file"):
        container.read(tmp_path / "a")
    with pytest.raises(InputError, match="damaged"):
        container.read(tmp_path)
    (tmp_path / "b").write_bytes(b"")
    with pytest.raises(InputError, match="damaged"):
        container.read(tmp_path / "b")
    archive_of(tmp_path / "c", b"hello", "hello.txt")
    with pytest.raises(InputError, match="damaged"):
        container.read(tmp_path / "c")
