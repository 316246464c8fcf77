"""Symmetric 3 x 3 matrices as six numbers, `xx xy xz yy yz zz`."""

import numpy as np

from multi_robot_slam.models.compiled import kernel


@kernel
def inverse(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float
) -> tuple[tuple[float, float, float, float, float, float], float]:
    """Inverse of a symmetric matrix and its determinant: (c_xx c_xy c_xz c_yy c_yz c_zz), det."""
    c_xx, c_xy, c_xz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    det = xx * c_xx + xy * c_xy + xz * c_xz
    scale = 1 / det
    c_yy = (xx * zz - xz * xz) * scale
    c_yz = (xy * xz - xx * yz) * scale
    c_zz = (xx * yy - xy * xy) * scale
    return (c_xx * scale, c_xy * scale, c_xz * scale, c_yy, c_yz, c_zz), det


@kernel
def inverses(matrices: np.ndarray) -> np.ndarray:
    """Inverses (n, 6) of symmetric `matrices` (n, 6) `xx xy xz yy yz zz`."""
    result = np.empty(matrices.shape)
    for i in range(len(matrices)):
        xx, xy, xz, yy, yz, zz = matrices[i]
        result[i], _ = inverse(xx, xy, xz, yy, yz, zz)
    return result


def root(matrix: np.ndarray) -> np.ndarray:
    """(3, 3) whose product with its transpose is the positive semidefinite `matrix` (3, 3)."""
    values, vectors = np.linalg.eigh(matrix)
    return vectors * np.sqrt(np.maximum(values, 0))


def unpack(covariances: np.ndarray) -> np.ndarray:
    """(..., 6) `xx xy xz yy yz zz` -> (..., 3, 3) symmetric, float64."""
    return np.asarray(covariances, float)[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(
        *np.shape(covariances)[:-1], 3, 3
    )


def pack(matrices: np.ndarray) -> np.ndarray:
    """(..., 3, 3) symmetric -> (..., 6) `xx xy xz yy yz zz`."""
    rows = matrices.reshape(*matrices.shape[:-2], 9)
    return np.ascontiguousarray(rows[..., [0, 1, 2, 4, 5, 8]])
