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

AT_A_TIME = 512
"""Pairs whose joint covariances are looked at together: some 10 MB."""

SOME_POSES = 16
"""Of which the least certain stands for all, with twice its variance."""


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
    correlated: float = 1.0,
    known: Aliases | None = None,
) -> tuple[Problem, Smoothed, Aliases]:
    """Smooth, join landmarks that turn out to be one, and repeat until none do.

    Parameters
    ----------
    smoothed_with : poses and solves the problem whose landmarks go by the aliases given, starting
        from the poses given (P, 3).
    poses : (P, 3) to start from.
    alike : (A, 2) ids of landmarks that look alike.
    gate, exclusive, correlated : as in the filter's settings.
    known : of landmarks that are one to begin with.

    Returns
    -------
    The last problem, its optimum, and what joined landmarks go by: the older id of each two.
    `SmoothingError` when a smoothing or a joint covariance fails.

    """
    aliases = known or Aliases()
    while True:
        problem, smoothed = smoothed_with(aliases, poses)
        pairs = _distinct(aliases.of(alike))
        pairs = pairs[np.isin(pairs, problem.ids).all(axis=1)]
        rows = np.searchsorted(problem.ids, pairs)
        limit = widened_gate(gate, len(problem.positions))
        joined = closest_pairs(problem, smoothed, rows, limit, exclusive, correlated)
        if not len(joined):
            return problem, smoothed, aliases
        poses, aliases = smoothed.of_records, aliases.joined(problem.ids[joined])


def _distinct(pairs: np.ndarray) -> np.ndarray:
    """Each pair (A, 2) of different members once, the smaller first."""
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    return pairs[pairs[:, 0] < pairs[:, 1]]


def closest_pairs(
    problem: Problem,
    smoothed: Smoothed,
    pairs: np.ndarray,
    limit: float,
    exclusive: bool,
    correlated: float = 1.0,
) -> np.ndarray:
    """The closest of `pairs` (A, 2) of landmarks with D up to `limit`, each in one at most.

    With `exclusive` no two that some frame has seen both.
    """
    if exclusive:
        pairs = pairs[~_seen_together(problem, pairs)]
    pairs = pairs[_may_be_within(problem, smoothed, pairs, limit)]
    if not len(pairs):
        return pairs
    distances = np.concatenate(
        [
            _mahalanobis_sq(problem, smoothed, pairs[start : start + AT_A_TIME], correlated)
            for start in range(0, len(pairs), AT_A_TIME)
        ]
    )
    chosen: list[np.ndarray] = []
    taken: set[int] = set()
    for row in np.argsort(distances, kind="stable"):
        pair = pairs[row]
        if not distances[row] <= limit:
            break
        if taken.isdisjoint(pair.tolist()):
            chosen.append(pair)
            taken.update(pair.tolist())
    return np.array(chosen, int).reshape(-1, 2)


def widened_gate(gate: float, observations: int) -> float:
    """The gate (18) that all of a run's observations pass together as likely as one passes `gate`.

    The filter can afford to make a landmark anew for one true match in a hundred; what it costs is
    those hundredths, and here they are to be found.
    """
    return float(chdtri(3, chdtrc(3, gate) / max(observations, 1)))


def _mahalanobis_sq(
    problem: Problem, smoothed: Smoothed, pairs: np.ndarray, correlated: float
) -> np.ndarray:
    """D between the landmarks of each pair (A,), as exact as a mean of independent errors is.

    Errors that are alike move two landmarks that are seen together alike.
    """
    wanted = np.unique(pairs)
    rows = np.searchsorted(wanted, pairs)
    deviations = landmark_deviations(problem, smoothed, wanted)
    apart = smoothed.landmarks[pairs[:, 0], :3] - smoothed.landmarks[pairs[:, 1], :3]
    covariances = unpack(smoothed.landmarks[pairs, 3:].sum(axis=1)) / correlated
    shared = deviations[rows[:, 0]] - deviations[rows[:, 1]]
    covariances += shared @ shared.transpose(0, 2, 1)
    try:
        solved = np.linalg.solve(covariances, apart[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError as error:
        raise SmoothingError("the joint covariance of two landmarks is singular") from error
    return np.einsum("ai,ai->a", apart, solved)


def _may_be_within(
    problem: Problem, smoothed: Smoothed, pairs: np.ndarray, limit: float
) -> np.ndarray:
    """(A,) bool: D of the pair may be within `limit`; found without their joint covariance.

    D is no less than the squared distance over the trace of the covariance. A landmark's own is at
    most that given poses and centres, and what the least certain pose moves it, at its range.
    """
    if not len(pairs):
        return np.empty(0, bool)
    place, yaw = _least_certain(problem, smoothed)
    range_sq = np.full(len(problem.ids), np.inf)
    np.minimum.at(range_sq, problem.landmarks, np.sum(problem.positions[:, :2] ** 2, axis=1))
    own = smoothed.landmarks[:, [3, 6, 8]].sum(axis=1) + 2 * (place + range_sq * yaw)
    apart = smoothed.landmarks[pairs[:, 0], :3] - smoothed.landmarks[pairs[:, 1], :3]
    squared = np.einsum("ai,ai->a", apart, apart)
    return np.less_equal(squared, 2 * limit * own[pairs].sum(axis=1))


def _least_certain(problem: Problem, smoothed: Smoothed) -> tuple[float, float]:
    """Largest variance of a pose's place [m^2] and of its yaw [rad^2], of some along the paths."""
    some = np.unique(np.linspace(0, problem.poses - 1, SOME_POSES).astype(int))
    rows = 3 * some[:, None] + np.arange(3)
    unit = np.zeros((smoothed.factor.size, rows.size))
    unit[rows.ravel(), np.arange(rows.size)] = 1
    variances = np.sum(smoothed.factor.solve_lower(unit) ** 2, axis=0).reshape(-1, 3)
    return float(variances[:, :2].sum(axis=1).max()), float(variances[:, 2].max())


def _seen_together(problem: Problem, pairs: np.ndarray) -> np.ndarray:
    """(A,) bool: some frame has observations of both: they are two.

    Frames that have left do not testify.
    """
    wanted, places = np.unique(pairs, return_inverse=True)
    places = places.reshape(-1, 2)
    row_of = np.full(len(problem.ids), -1)
    row_of[wanted] = np.arange(len(wanted))
    rows = row_of[problem.landmarks]
    known = (rows >= 0) & (problem.seen_from < problem.poses)
    seen = np.zeros((len(wanted), problem.poses), bool)
    seen[rows[known], problem.seen_from[known]] = True
    packed = np.packbits(seen, axis=1)
    return np.logical_or.reduce(packed[places[:, 0]] & packed[places[:, 1]], axis=1)
