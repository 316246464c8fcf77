"""LAPACK's routines for one dense triangle, called without the interpreter's lock.

SciPy's own wrappers hold the lock, and a filter beside them would wait for as long as they take.
"""

import ctypes
from collections.abc import Callable
from functools import cache

import numpy as np
from numba.extending import get_cython_function_address

from multi_robot_slam.models.parallel import one_thread


@one_thread
def whitener(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """W (n, n), lower triangle, with W C W^T = I, and W^T W = C^-1 (n, n).

    `LinAlgError` if the covariance C is not positive definite.
    """
    root = np.array(covariance, order="F")
    if _call("dpotrf", b"L", root):
        raise np.linalg.LinAlgError("the covariance is not positive definite")
    _call("dtrtri", b"LN", root)
    root = np.tril(root)
    information = np.array(root, order="F")
    _call("dlauum", b"L", information)
    upper = np.triu(information.T, 1)
    information += upper
    return np.ascontiguousarray(root), information.T


def _call(name: str, options: bytes, matrix: np.ndarray) -> int:
    """Call a routine of one-letter options and one square matrix, in place; its `info`."""
    size, rows, info = (ctypes.c_int(value) for value in (len(matrix), max(1, len(matrix)), 0))
    _routine(name, len(options))(
        *(options[i : i + 1] for i in range(len(options))),
        ctypes.byref(size),
        matrix.ctypes.data,
        ctypes.byref(rows),
        ctypes.byref(info),
    )
    return info.value


@cache
def _routine(name: str, options: int) -> Callable[..., None]:
    """The routine of SciPy's library; `ctypes` lets go of the lock for as long as it runs."""
    pointers = [ctypes.c_char_p] * options + [ctypes.c_void_p] * 4
    address = get_cython_function_address("scipy.linalg.cython_lapack", name)
    return ctypes.CFUNCTYPE(None, *pointers)(address)
