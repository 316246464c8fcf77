"""Arrays that grow by rows without being moved.

What is set aside is address space: a page takes memory from its first write on, and before that
counts against no limit but one on address space itself. Where there is such a limit, or where the
system promises no more memory than it has, an array moves when it grows, as any other.
"""

import math
import mmap

import numpy as np

SPACE = 2**37
"""Bytes of address space to set aside for an array: more than most machines have memory."""

LEAST = 2**21
"""Bytes of an array below which it may as well move: a large page would be half empty."""

MAP_NORESERVE = getattr(mmap, "MAP_NORESERVE", 0x4000)
"""Promise no memory for pages that are never written; Python before 3.13 has no name for it."""


def reserved(shape: tuple[int, ...], dtype: type | np.dtype) -> np.ndarray:
    """An array yet to be written, which `enlarged` makes longer where it lies."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size < LEAST:
        return np.empty(shape, dtype)
    flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | MAP_NORESERVE
    try:
        space = mmap.mmap(-1, max(SPACE, 2 * size), flags=flags)
    except (OSError, OverflowError):
        return np.empty(shape, dtype)
    if hasattr(mmap, "MADV_HUGEPAGE"):
        space.madvise(mmap.MADV_HUGEPAGE)  # as NumPy does for large arrays: fewer first writes
    return np.ndarray(shape, dtype, space)


def enlarged(array: np.ndarray) -> np.ndarray:
    """`array` with half as many rows again, yet to be written.

    The rows that were there lie where they lay if `array`, or the one it is the beginning of, comes
    from `reserved`; otherwise they are copied.
    """
    shape = (len(array) * 3 // 2 + 1, *array.shape[1:])
    space = _space_of(array)
    if space is not None and math.prod(shape) * array.itemsize <= len(space):
        return np.ndarray(shape, array.dtype, space)
    larger = reserved(shape, array.dtype)
    larger[: len(array)] = array
    return larger


def _space_of(array: np.ndarray) -> mmap.mmap | None:
    """The address space at whose beginning `array` lies, or None."""
    address = array.ctypes.data
    if not array.flags.c_contiguous:
        return None
    while isinstance(array.base, np.ndarray):
        array = array.base
    begins = array.ctypes.data == address
    return array.base if begins and isinstance(array.base, mmap.mmap) else None
