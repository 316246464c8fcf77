"""Named arrays in one file: NumPy's .npz, written as a whole or not at all, read without trust.

`numpy.load` reads it without pickles. Equal arrays make equal files, byte for byte.
"""

import io
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from msg_defs.errors import InputError

MOST_BYTES = 2**32
"""Of all arrays of a file together."""

MOST_RATIO = 100
"""Of what a compressed file becomes to its size: arrays of measurements reach ten at most."""

MOST_MEMBERS = 256
KINDS = "biufU"
"""Booleans, numbers and texts; objects would be code."""

LONG_AGO = (1980, 1, 1, 0, 0, 0)
"""The earliest time that a member of an archive can have: nobody needs to know when it was."""

SUFFIX = ".npy"
DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, struct.error, OverflowError),
    *(EOFError, OSError, ValueError, RuntimeError, KeyError),
)
"""What reading a damaged archive raises; of an encrypted one, or one that asks for more than there
is, `RuntimeError` and its `NotImplementedError`."""


def write(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write a file that holds `arrays` by name, in their order; what was there is replaced.

    Whoever reads finds the file as it was or as it is now, whatever happens in between: it is
    written beside the place, forced to the disk, and then renamed. `InputError` if it cannot be.
    """
    path = Path(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with beside.open("wb") as file:
            _write(file, arrays)
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
        _force_folder(path.parent)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}; choose another place") from None
    finally:
        beside.unlink(missing_ok=True)


def _write(file: io.BufferedWriter, arrays: Mapping[str, np.ndarray]) -> None:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            with archive.open(zipfile.ZipInfo(name + SUFFIX, LONG_AGO), "w") as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)


def _force_folder(folder: Path) -> None:
    """Have the disk know the new name, too."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def read(path: Path, wanted: Callable[[str], bool] = lambda name: True) -> dict[str, np.ndarray]:
    """The arrays of a file whose names are `wanted`, by name.

    Memory is bounded whatever the file says: by `MOST_BYTES`, and by `MOST_RATIO` times its size.
    `InputError` where it is no such file, is damaged, or holds anything but booleans, numbers and
    texts.
    """
    path = Path(path)
    try:
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            total = sum(member.file_size for member in members)
            if len(members) > MOST_MEMBERS or total > _most(path.stat().st_size):
                raise ValueError(f"{len(members)} arrays of {total} bytes are too much")
            return {
                name: _array(archive, member)
                for member in members
                if wanted(name := member.filename.removesuffix(SUFFIX))
            }
    except FileNotFoundError:
        raise InputError(f"no file {path}") from None
    except DAMAGED as error:
        told = error.strerror if isinstance(error, OSError) else error
        in_one_line = " ".join(str(told).split())
        raise InputError(
            f"{path} is damaged, or no file of arrays (.npz): {in_one_line}; take another, or a "
            "copy"
        ) from None


def _most(size: int) -> int:
    return min(MOST_BYTES, MOST_RATIO * size)


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    data = archive.read(member)
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"{member.filename} is of version {version}")
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else _header_2_0
    shape, is_fortran, dtype = header(file)
    if dtype.kind not in KINDS or dtype.subdtype is not None:
        raise ValueError(f"{member.filename} is of {dtype}")
    if math.prod(shape) * dtype.itemsize != len(data) - file.tell():
        raise ValueError(f"{member.filename} has not as many elements as it says")
    flat = (
        np.frombuffer(data, dtype, offset=file.tell()) if math.prod(shape) else np.empty(0, dtype)
    )
    array = flat.reshape(shape, order="F" if is_fortran else "C")
    return array.astype(dtype.newbyteorder("="))


_header_2_0 = np.lib.format.read_array_header_2_0
