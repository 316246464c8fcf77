"""How far off one map lies from another: the rigid motion in the plane that most pairs agree on."""

from typing import NamedTuple

import numpy as np

MOST_PAIRS = 24
"""Pairs that make hypotheses, two by two."""

WITHIN = 9.21
"""Squared distance in standard deviations of an inlier: 99 % of chi2 with two degrees."""


class Alignment(NamedTuple):
    """A motion x -> R(yaw) x + t, and how many agree."""

    motion: np.ndarray
    """(3,): t [m] and yaw [rad]."""
    inliers: int
    pairs: int


def align(points: np.ndarray, places: np.ndarray, sigmas: np.ndarray) -> Alignment | None:
    """The motion that brings most `points` (n, 2) to their `places` (n, 2).

    Each two pairs make a hypothesis. The one with the most inliers is fitted to these.

    Parameters
    ----------
    sigmas : (n,) standard deviation of points + places in each direction [m].

    Returns
    -------
    None where less than half of the pairs agree on one, or less than three do.

    """
    chosen = np.arange(min(len(points), MOST_PAIRS)) * len(points) // min(len(points), MOST_PAIRS)
    a, b = np.triu_indices(len(chosen), 1)
    if not len(a):
        return None
    of_points = _as_complex(points[chosen])
    of_places = _as_complex(places[chosen])
    turns = (of_places[b] - of_places[a]) * np.conj(of_points[b] - of_points[a])
    turns /= np.maximum(np.abs(turns), np.finfo(float).tiny)
    shifts = 0.5 * (of_places[a] + of_places[b] - turns * (of_points[a] + of_points[b]))
    all_points, all_places = _as_complex(points), _as_complex(places)
    errors = np.abs(turns[:, None] * all_points + shifts[:, None] - all_places)
    agree = errors**2 <= WITHIN * sigmas**2
    best = int(np.argmax(agree.sum(axis=1)))
    inliers = agree[best]
    count = int(inliers.sum())
    if count < 3 or 2 * count <= len(points):
        return None
    weights = inliers / sigmas**2
    weights /= weights.sum()
    middle_point, middle_place = weights @ all_points, weights @ all_places
    turn = weights @ ((all_places - middle_place) * np.conj(all_points - middle_point))
    yaw = float(np.angle(turn))
    shift = middle_place - np.exp(1j * yaw) * middle_point
    return Alignment(np.array([shift.real, shift.imag, yaw]), count, len(points))


def _as_complex(points: np.ndarray) -> np.ndarray:
    return points[:, 0] + 1j * points[:, 1]
