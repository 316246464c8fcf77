"""Which landmarks an observation may be: candidates by descriptor (19), gated by position (18).

Algorithm 1 takes, among the landmarks inside the gate D <= D_0, the one of smallest E, and accepts
it if E <= E_0. E does not depend on the particle, so the same landmark is found as the first one
inside the gate in ascending E among those with E <= E_0: one short list serves all particles.
"""

from typing import NamedTuple

import numpy as np


class Candidates(NamedTuple):
    """For each of B observations the landmark columns it may be, in ascending E."""

    starts: np.ndarray
    """(B + 1,) int32: observation b has entries starts[b] .. starts[b + 1] - 1 of the others."""
    columns: np.ndarray
    """(C,) int32: column, or -1 - b for the landmark that observation b of this frame creates."""
    distances: np.ndarray
    """(C,) float32: E (19)."""


def find_candidates(observed: np.ndarray, known: np.ndarray, threshold: float) -> Candidates:
    """All pairs with E <= `threshold` (E_0).

    Parameters
    ----------
    observed : (B, 128) descriptors of one robot's observations. Each may also match the landmark
        that an earlier one creates.
    known : (N, 128) descriptor of each landmark column.

    """
    count = len(observed)
    distance = np.concatenate(
        [squared_distances(observed, known), squared_distances(observed, observed)], axis=1
    )
    distance[:, len(known) :][np.triu_indices(count)] = np.inf
    rows, columns = np.nonzero(distance <= threshold)
    order = np.lexsort((distance[rows, columns], rows))
    rows, columns = rows[order], columns[order]
    starts = np.searchsorted(rows, np.arange(count + 1)).astype(np.int32)
    signed = np.where(columns < len(known), columns, len(known) - 1 - columns)
    return Candidates(starts, signed.astype(np.int32), distance[rows, columns])


def squared_distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """E (19) between the rows of `a` (B, 128) and of `b` (N, 128): (B, N)."""
    products = a @ b.T
    products *= -2
    products += np.einsum("ij,ij->i", b, b)
    products += np.einsum("ij,ij->i", a, a)[:, None]
    return products
