"""The compiled Cholesky factorisation and solutions, tile by tile, each product by BLAS.

The rows of a tile are kept transposed, (columns, rows): parts of both are contiguous. In the place
of each tile on the diagonal of L its inverse is kept, transposed too. `layout` is
`envelope.Layout`.
"""

import numpy as np

from multi_robot_slam.models.compiled import kernel

SMALL = 24
"""Rows of a block that is handled without BLAS."""


@kernel
def tile(elements, layout, i):
    """The rows of tile i, transposed: (columns kept, rows)."""
    edges, first_tiles, offsets = layout
    height, width = edges[i + 1] - edges[i], edges[i + 1] - edges[first_tiles[i]]
    return elements[offsets[i] : offsets[i] + width * height].reshape(width, height)


@kernel
def factorise(elements, layout):
    """From the lower triangle of H to L, in place; False if H is not positive definite."""
    edges, first_tiles, _ = layout
    for i in range(len(first_tiles)):
        own, begin = tile(elements, layout, i), edges[first_tiles[i]]
        for k in range(first_tiles[i], i):
            other, other_begin = tile(elements, layout, k), edges[first_tiles[k]]
            common, first, last = max(begin, other_begin), edges[k], edges[k + 1]
            block = own[first - begin : last - begin]
            if common < first:
                block -= np.dot(
                    other[common - other_begin : first - other_begin].T,
                    own[common - begin : first - begin],
                )
            block[:] = np.dot(other[first - other_begin :].T, block)
        left, diagonal = own[: edges[i] - begin], own[edges[i] - begin :]
        if begin < edges[i]:
            diagonal -= np.dot(left.T, left)
        if not invert_root(diagonal):
            return False
    return True


@kernel
def invert_root(block):
    """From a matrix A = L L^T, whose upper triangle `block` holds, to L^-T, in place.

    False if A is not positive definite. By halves, as long as they are worth a call of BLAS.
    """
    if len(block) <= SMALL:
        return invert_small_root(block)
    half = len(block) // 2
    first, mixed = block[:half, :half].copy(), block[:half, half:].copy()
    if not invert_root(first):
        return False
    mixed = np.dot(first.T, mixed)
    second = block[half:, half:] - np.dot(mixed.T, mixed)
    if not invert_root(second):
        return False
    block[:half, :half], block[half:, half:], block[half:, :half] = first, second, 0
    block[:half, half:] = -np.dot(first, np.dot(mixed, second))
    return True


@kernel
def invert_small_root(block):
    """`invert_root`, row by row."""
    size = len(block)
    for i in range(size):
        for k in range(i):
            block[i, i:] -= block[k, i] * block[k, i:]
        if block[i, i] <= 0:  # what is not a number goes on and is found in the step
            return False
        block[i, i:] /= np.sqrt(block[i, i])
    inverse = np.zeros((size, size))
    for i in range(size - 1, -1, -1):
        inverse[i, i] = 1
        for k in range(i + 1, size):
            inverse[i] -= block[i, k] * inverse[k]
        inverse[i] /= block[i, i]
    block[:] = inverse
    return True


@kernel
def solve_lower(elements, layout, right):
    """L^-1 of `right` (rows, M), in place."""
    edges, first_tiles, _ = layout
    for i in range(len(first_tiles)):
        own, begin = tile(elements, layout, i), edges[first_tiles[i]]
        rows = right[edges[i] : edges[i + 1]]
        if begin < edges[i]:
            rows -= np.dot(own[: edges[i] - begin].T, right[begin : edges[i]])
        rows[:] = np.dot(own[edges[i] - begin :].T, rows)


@kernel
def solve_upper(elements, layout, right):
    """L^-T of `right` (rows, M), in place."""
    edges, first_tiles, _ = layout
    for i in range(len(first_tiles) - 1, -1, -1):
        own, begin = tile(elements, layout, i), edges[first_tiles[i]]
        rows = right[edges[i] : edges[i + 1]]
        rows[:] = np.dot(own[edges[i] - begin :], rows)
        if begin < edges[i]:
            right[begin : edges[i]] -= np.dot(own[: edges[i] - begin], rows)
