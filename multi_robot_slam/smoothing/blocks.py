"""Matrices of as many equal blocks as there are robots."""

import numpy as np


def with_block_again(matrix: np.ndarray, own: np.ndarray) -> np.ndarray:
    """(n + k, n + k): `matrix` (n, n), and its block at rows and columns `own` (k,) once more.

    Nothing ties the new rows to the others.
    """
    count = len(matrix)
    result = np.pad(matrix, (0, len(own)))
    result[count:, count:] = matrix[np.ix_(own, own)]
    return result
