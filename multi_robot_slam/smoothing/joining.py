"""Landmarks that are one: what the filter had split is found with the smoothed paths.

A particle that misses a loop creates landmarks anew, and smoothing alone cannot know. Two landmarks
are joined when they look alike (E <= E_0) and lie together: D, with the joint covariance that the
smoothing gives them, inside `widened_gate`.
"""

import numpy as np
from scipy.special import chdtrc, chdtri

from multi_robot_slam.models import stereo
from multi_robot_slam.models.descriptors import squared_distances
from multi_robot_slam.smoothing import solve
from multi_robot_slam.smoothing.problem import Problem
from multi_robot_slam.smoothing.solve import Smoothed


def alike(descriptors: np.ndarray, threshold: float) -> np.ndarray:
    """(A, 2) rows of descriptors with E <= `threshold`, the smaller row first."""
    distances = squared_distances(descriptors, descriptors)
    return np.argwhere(np.triu(distances <= threshold, k=1))


def joined(
    problem: Problem, smoothed: Smoothed, pairs: np.ndarray, gate: float, exclusive: bool
) -> np.ndarray:
    """The closest of `pairs` (A, 2) of landmarks within the gate, each landmark in one at most.

    With `exclusive` no two that some frame has seen both.
    """
    if not len(pairs):
        return pairs
    squared = _distances(problem, smoothed, pairs)
    limit = widened_gate(gate, len(problem.positions))
    chosen, taken = [], set()
    for row in np.argsort(squared, kind="stable"):
        pair = pairs[row]
        if squared[row] > limit:
            break
        if taken.isdisjoint(pair.tolist()) and not (exclusive and _seen_together(problem, *pair)):
            chosen.append(pair)
            taken.update(pair.tolist())
    return np.array(chosen, int).reshape(-1, 2)


def widened_gate(gate: float, observations: int) -> float:
    """The gate (18) that all of a run's observations pass together as likely as one passes `gate`.

    The filter can afford to make a landmark anew for one true match in a hundred; what it costs is
    those hundredths, and here they are to be found.
    """
    return float(chdtri(3, chdtrc(3, gate) / max(observations, 1)))


def _distances(problem: Problem, smoothed: Smoothed, pairs: np.ndarray) -> np.ndarray:
    """D between the landmarks of each pair (A,)."""
    wanted = np.unique(pairs)
    rows = np.searchsorted(wanted, pairs)
    deviations = solve.landmark_deviations(problem, smoothed, wanted)
    apart = smoothed.landmarks[pairs[:, 0], :3] - smoothed.landmarks[pairs[:, 1], :3]
    covariances = stereo.unpack(smoothed.landmarks[pairs, 3:].sum(axis=1))
    shared = deviations[rows[:, 0]] - deviations[rows[:, 1]]
    covariances += shared @ shared.transpose(0, 2, 1)
    solved = np.linalg.solve(covariances, apart[:, :, None])[:, :, 0]
    return np.einsum("ai,ai->a", apart, solved)


def _seen_together(problem: Problem, one: int, other: int) -> bool:
    """Some frame has observations of both: they are two."""
    frames = [problem.seen_from[slice(*problem.starts[n : n + 2])] for n in (one, other)]
    return bool(len(np.intersect1d(*frames)))
