"""Landmarks that are one: what the filter had split is found with the smoothed paths.

A particle that misses a loop creates landmarks anew, and smoothing alone cannot know. Two landmarks
are joined when they look alike (E <= E_0) and lie together: D, with the joint covariance that the
smoothing gives them, inside `widened_gate`.
"""

from collections.abc import Callable

import numpy as np
from scipy.special import chdtrc, chdtri

from multi_robot_slam.models.descriptors import squared_distances
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.smoothing.aliases import Aliases
from multi_robot_slam.smoothing.marginals import landmark_deviations
from multi_robot_slam.smoothing.problem import Problem
from multi_robot_slam.smoothing.solve import Smoothed, SmoothingError


def alike(descriptors: np.ndarray, threshold: float) -> np.ndarray:
    """(A, 2) rows of descriptors with E <= `threshold`, the smaller row first."""
    distances = squared_distances(descriptors, descriptors)
    return np.argwhere(np.triu(distances <= threshold, k=1))


def smooth_and_join(
    smoothed_with: Callable[[Aliases, np.ndarray], tuple[Problem, Smoothed]],
    poses: np.ndarray,
    alike: np.ndarray,
    gate: float,
    exclusive: bool,
) -> tuple[Problem, Smoothed, Aliases]:
    """Smooth, join landmarks that turn out to be one, and repeat until none do.

    Parameters
    ----------
    smoothed_with : poses and solves the problem whose landmarks go by the aliases given, starting
        from the poses given (P, 3).
    poses : (P, 3) to start from.
    alike : (A, 2) ids of landmarks that look alike.
    gate, exclusive : as in the filter's settings.

    Returns
    -------
    The last problem, its optimum, and what joined landmarks go by: the older id of each two.
    `SmoothingError` when a smoothing or a joint covariance fails.

    """
    aliases = Aliases()
    while True:
        problem, smoothed = smoothed_with(aliases, poses)
        pairs = _distinct(aliases.of(alike))
        pairs = pairs[np.isin(pairs, problem.ids).all(axis=1)]
        rows = np.searchsorted(problem.ids, pairs)
        joined = closest_pairs(problem, smoothed, rows, gate, exclusive)
        if not len(joined):
            return problem, smoothed, aliases
        poses, aliases = smoothed.of_records, aliases.joined(problem.ids[joined])


def _distinct(pairs: np.ndarray) -> np.ndarray:
    """Each pair (A, 2) of different members once, the smaller first."""
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    return pairs[pairs[:, 0] < pairs[:, 1]]


def closest_pairs(
    problem: Problem, smoothed: Smoothed, pairs: np.ndarray, gate: float, exclusive: bool
) -> np.ndarray:
    """The closest of `pairs` (A, 2) of landmarks within the gate, each landmark in one at most.

    With `exclusive` no two that some frame has seen both.
    """
    if not len(pairs):
        return pairs
    distances = _mahalanobis_sq(problem, smoothed, pairs)
    limit = widened_gate(gate, len(problem.positions))
    chosen: list[np.ndarray] = []
    taken: set[int] = set()
    for row in np.argsort(distances, kind="stable"):
        pair = pairs[row]
        if not distances[row] <= limit:
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


def _mahalanobis_sq(problem: Problem, smoothed: Smoothed, pairs: np.ndarray) -> np.ndarray:
    """D between the landmarks of each pair (A,)."""
    wanted = np.unique(pairs)
    rows = np.searchsorted(wanted, pairs)
    deviations = landmark_deviations(problem, smoothed, wanted)
    apart = smoothed.landmarks[pairs[:, 0], :3] - smoothed.landmarks[pairs[:, 1], :3]
    covariances = unpack(smoothed.landmarks[pairs, 3:].sum(axis=1))
    shared = deviations[rows[:, 0]] - deviations[rows[:, 1]]
    covariances += shared @ shared.transpose(0, 2, 1)
    try:
        solved = np.linalg.solve(covariances, apart[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError as error:
        raise SmoothingError("the joint covariance of two landmarks is singular") from error
    return np.einsum("ai,ai->a", apart, solved)


def _seen_together(problem: Problem, one: int, other: int) -> bool:
    """Some frame has observations of both: they are two. Frames that have left do not testify."""
    first, second = (problem.seen_from[slice(*problem.starts[n : n + 2])] for n in (one, other))
    return bool(len(np.intersect1d(first, second)))
