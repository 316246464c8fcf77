"""Which landmarks an observation may be: candidates by descriptor (19), gated by position (18).

Algorithm 1 takes, among the landmarks inside the gate D <= D_0, the one of smallest E, and accepts
it if E <= E_0. E does not depend on the particle, so the same landmark is found as the first one
inside the gate in ascending E among those with E <= E_0: one short list serves all particles.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from multi_robot_slam.models.descriptors import squared_distances


class Candidates(NamedTuple):
    """For each of B observations the landmark columns it may be, in ascending E."""

    starts: np.ndarray
    """(B + 1,) int32: observation b has entries starts[b] .. starts[b + 1] - 1 of the others."""
    columns: np.ndarray
    """(C,) int32: column, or -1 - b for the landmark that observation b of this frame creates."""
    distances: np.ndarray
    """(C,) float32: E (19)."""


def field_of_search(
    poses: np.ndarray, v: np.ndarray, noise: np.ndarray, gate: float, pose_margin: np.ndarray
) -> np.ndarray:
    """Box (x low, x high, y low, y high) outside of which no landmark can lie inside the gate.

    Parameters
    ----------
    poses : (3, M) of the robot; v, noise : (B, 3), (B, 6) in `base_link`.
    pose_margin : (2,) how far a pose may still move [m] and turn [rad].
    """
    yaw = poses[2].mean()
    turn = np.abs(poses[2] - yaw).max() + pose_margin[1]
    distance = np.hypot(v[:, 0], v[:, 1])
    margin = np.sqrt(gate * (noise[:, 0] + noise[:, 3])) + distance * turn + pose_margin[0]
    cos, sin = np.cos(yaw), np.sin(yaw)
    seen_x, seen_y = cos * v[:, 0] - sin * v[:, 1], sin * v[:, 0] + cos * v[:, 1]
    return np.array(
        [
            poses[0].min() + (seen_x - margin).min(),
            poses[0].max() + (seen_x + margin).max(),
            poses[1].min() + (seen_y - margin).min(),
            poses[1].max() + (seen_y + margin).max(),
        ]
    )


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
    count = len(observed)
    distance = np.concatenate(
        [squared_distances(observed, known), squared_distances(observed, observed)], axis=1
    )
    distance[:, len(known) :][_not_earlier(count)] = np.inf
    rows, columns = np.nonzero(distance <= threshold)
    order = np.lexsort((distance[rows, columns], rows))
    rows, columns = rows[order], columns[order]
    starts = np.searchsorted(rows, np.arange(count + 1)).astype(np.int32)
    signed = np.concatenate([known_columns, -1 - np.arange(count)]).astype(np.int32)
    return Candidates(starts, signed[columns], distance[rows, columns])


@lru_cache(maxsize=8)
def _not_earlier(count: int) -> np.ndarray:
    """(B, B) bool: the second observation is not made before the first."""
    mask = np.triu(np.ones((count, count), bool))
    mask.setflags(write=False)
    return mask
