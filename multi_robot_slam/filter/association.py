"""Which landmarks an observation may be: candidates by descriptor (19), gated by position (18).

Algorithm 1 takes, among the landmarks inside the gate D <= D_0, the one of smallest E, and accepts
it if E <= E_0. E does not depend on the particle, so the same landmark is found as the first one
inside the gate in ascending E among those with E <= E_0: one short list serves all particles.
"""

from typing import NamedTuple

import numpy as np

from multi_robot_slam.filter.kernels import extremes
from multi_robot_slam.models.compiled import kernel


class Candidates(NamedTuple):
    """For each of B observations the landmark columns it may be, in ascending E."""

    starts: np.ndarray
    """(B + 1,) int32: observation b has entries starts[b] .. starts[b + 1] - 1 of the others."""
    columns: np.ndarray
    """(C,) int32: column, or -1 - b for the landmark that observation b of this frame creates."""
    distances: np.ndarray
    """(C,) float32: E (19)."""


@kernel
def field_of_search(
    poses: np.ndarray, v: np.ndarray, noise: np.ndarray, gate: float, pose_margin: np.ndarray
) -> np.ndarray:
    """Box (x low, x high, y low, y high) outside of which no landmark can lie inside the gate.

    Parameters
    ----------
    poses : (3, M) of the robot; v, noise : (B, 3), (B, 6) in `base_link`, B at least 1.
    pose_margin : (2,) how far a pose may still move [m] and turn [rad].
    """
    least, most = extremes(poses[2])
    yaw, turn = 0.5 * (least + most), 0.5 * (most - least) + pose_margin[1]
    cos, sin = np.cos(yaw), np.sin(yaw)
    x_low = y_low = np.inf
    x_high = y_high = -np.inf
    for b in range(len(v)):
        distance = np.hypot(v[b, 0], v[b, 1])
        margin = np.sqrt(gate * (noise[b, 0] + noise[b, 3])) + distance * turn + pose_margin[0]
        x, y = cos * v[b, 0] - sin * v[b, 1], sin * v[b, 0] + cos * v[b, 1]
        x_low, x_high = min(x_low, x - margin), max(x_high, x + margin)
        y_low, y_high = min(y_low, y - margin), max(y_high, y + margin)
    left, right = extremes(poses[0])
    lowest, highest = extremes(poses[1])
    return np.array([left + x_low, right + x_high, lowest + y_low, highest + y_high])


def find_candidates(
    observed: np.ndarray, known: np.ndarray, known_columns: np.ndarray, threshold: float
) -> Candidates:
    """All pairs with E <= `threshold` (E_0).

    Parameters
    ----------
    observed : (B, 128) descriptors of one robot's observations. Each may also match the landmark
        that an earlier one creates.
    known : (N, 128) descriptors of the landmarks in `known_columns` (N,), ascending.

    """
    return Candidates(
        *_list(
            observed @ known.T,
            observed @ observed.T,
            np.einsum("ij,ij->i", observed, observed),
            np.einsum("ij,ij->i", known, known),
            known_columns,
            observed.dtype.type(threshold),
        )
    )


@kernel
def _list(
    products: np.ndarray,
    own_products: np.ndarray,
    own_squares: np.ndarray,
    squares: np.ndarray,
    columns: np.ndarray,
    threshold: np.floating,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The fields of `Candidates`, from the products and squares of descriptors.

    E is computed in the order of `descriptors.squared_distances`, to the same bits. Equal ones stay
    in the order of the columns, and after those in that of the observations.
    """
    count, known = products.shape
    starts = np.zeros(count + 1, np.int32)
    found = np.empty(count * (known + count), np.int32)
    distances = np.empty(count * (known + count), products.dtype)
    size = 0
    minus_two = products.dtype.type(-2)
    for b in range(count):
        first = size
        for n in range(known + b):
            if n < known:
                column = columns[n]
                distance = minus_two * products[b, n] + squares[n]
            else:
                column = known - n - 1
                distance = minus_two * own_products[b, n - known] + own_squares[n - known]
            distance += own_squares[b]
            if distance <= threshold:
                place = size
                while place > first and distances[place - 1] > distance:
                    distances[place], found[place] = distances[place - 1], found[place - 1]
                    place -= 1
                distances[place], found[place] = distance, column
                size += 1
        starts[b + 1] = size
    return starts, found[:size].copy(), distances[:size].copy()


@kernel
def landmarks_among(columns: np.ndarray) -> np.ndarray:
    """The distinct `columns` of `Candidates` that are landmarks' (n,) int64, ascending."""
    ascending = np.sort(columns)
    distinct = np.empty(ascending.size, np.int64)
    count, last = 0, -1
    for column in ascending:
        if column > last:
            distinct[count] = column
            count, last = count + 1, column
    return distinct[:count].copy()
