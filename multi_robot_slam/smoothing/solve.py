"""Smoothing: the most likely paths of all robots and landmarks, given who saw what.

Unknown are poses x_p = (x, y, yaw), N landmarks l_n, and the centres k_c = (x, y) that an older
past has left of some of the landmarks (`prior`). Four kinds of residuals tie them together:

    prior        r = (anchors, centres) - m,            N(0, P)
    odometry     r = x_p (-) x_previous(p) - u_p,       N(0, diag(sigma_p^2)), as in (7)
    observation  e = l_n - p - Rz v,                    N(0, Rz R Rz^T), as in (8) turned into `map`
    sighting     e = p_q - p_p - Rz s,                  the same in the plane: robot p sees robot q

An observation is linear in the landmark, so for given poses the best landmarks and their
covariances are sums:

    W = Rz R^-1 Rz^T,   Lambda = sum W,   Lambda l = sum W (p + Rz v)

which is what the filter's EKFs along this path would hold. A centre counts as a pose p = k without
yaw whose landmark was seen at (0, 0, k_z). Gauss-Newton runs over poses and centres; with the
landmarks at their best the Schur complement of the full system is

    H = H_prior + H_odometry + H_sightings
        + sum_o J^T W J - sum_n (sum_i J_i^T W_i) Lambda^-1 (sum_j W_j J_j)

with J = de/dx = [-1 0 q_y; 0 -1 -q_x; 0 0 0], q = l - p. A landmark that would make it too dense
stays an unknown (`hubs`): W J and Lambda become rows of H. Its part of the gradient is zero, since
it is at its best. The Cholesky factor of H (`envelope`) also draws paths from the Gaussian around
the optimum (`draws`).
"""

from dataclasses import dataclass

import numpy as np

from multi_robot_slam.models.parallel import one_thread
from multi_robot_slam.smoothing.cost import (
    cost,
    landmarks_and_distances,
    robust_weights,
    thresholds_of,
)
from multi_robot_slam.smoothing.envelope import Envelope, Factor, factorise
from multi_robot_slam.smoothing.hubs import cheapest_envelope
from multi_robot_slam.smoothing.linearised import gradient_of, information_of
from multi_robot_slam.smoothing.problem import Problem, views_of

MAX_ITERATIONS = 100
MAX_HALVINGS = 12

SHARPENING = 4.0
"""By how much the robust threshold comes down in each iteration."""

SMALLEST_STEP = 1e-3
"""Far below anything that could be measured."""

NEAR = 1.0
"""After a step shorter than this the same H serves for the next ones; they cost a fifth."""

REWEIGHTED = 0.1
"""Change of any robust weight up to which it does."""

GOOD_ENOUGH = 10.0
"""It serves to the end if all later steps together are so many times the smallest one."""


class SmoothingError(ValueError):
    """There is no optimum, or it was not found: says why."""


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The optimum, and the Gaussian around it."""

    anchors: np.ndarray
    """(A,) int64: robots whose anchors are the first poses."""
    ids: np.ndarray
    """(a,) int64: landmark of each centre."""
    poses: np.ndarray
    """(A + P, 3) float64: anchors, then the records' poses: x, y [m], yaw [rad] in `map`."""
    centres: np.ndarray
    """(a, 3) float64: x, y, and the z that is known [m]."""
    landmarks: np.ndarray
    """(N, 9) float64: mean [m], covariance [m^2] given poses and centres, `xx xy xz yy yz zz`."""
    factor: Factor
    """Cholesky factor of the information of poses, centres and hubs, other landmarks out."""
    weights: np.ndarray
    """(O + S,) float64: robust weight of each observation and sighting, 0 to 1."""
    cost: float
    """Half the sum of squared, robust, whitened residuals."""
    iterations: int

    @property
    def of_records(self) -> np.ndarray:
        """(P, 3): the poses without the anchors."""
        return self.poses[len(self.anchors) :]

    @property
    def views(self) -> np.ndarray:
        """(V, 3): the poses, then the centres with yaw 0."""
        return views_of(self.poses, self.centres)


@one_thread
def smooth(
    problem: Problem,
    poses: np.ndarray,
    robust_above: float = np.inf,
    smallest_step: float = SMALLEST_STEP,
    start: Smoothed | None = None,
) -> Smoothed:
    """Gauss-Newton from `poses` (P, 3) of the records to the most likely paths and landmarks.

    Parameters
    ----------
    robust_above : D (18) up to which an observation or sighting counts in full. Beyond it counts
        less and less and in the end not at all (`cost`). The threshold comes down from the largest
        D, so that a loop that `poses` leave open is closed before it could be taken for an error.
    smallest_step : the iteration ends when the step is shorter, in standard deviations of the
        solution.
    start : an optimum nearby. Anchors of the same robots and centres of the same landmarks begin
        where it has them; others begin at the prior's means. The threshold need not come down if
        every pose agrees with half of what it saw.

    Raises
    ------
    SmoothingError
        The information is not positive definite, something is not finite, or the iteration does
        not end.

    """
    with np.errstate(all="ignore"):  # what is not finite raises `SmoothingError`
        views = _first_views(problem, np.array(poses, float), start)
        return _gauss_newton(problem, views, robust_above, smallest_step, start is not None)


def _first_views(problem: Problem, poses: np.ndarray, start: Smoothed | None) -> np.ndarray:
    """(V, 3) where the search begins."""
    anchors, centres = problem.prior.poses.copy(), problem.prior.centres.copy()
    if start is not None:
        _, own, others = np.intersect1d(problem.anchors, start.anchors, return_indices=True)
        anchors[own] = start.poses[others]
        ids, first = np.unique(start.ids, return_index=True)
        known = np.isin(problem.prior.ids, ids)
        centres[known] = start.centres[first[np.searchsorted(ids, problem.prior.ids[known])]]
    return views_of(np.concatenate([anchors, poses]), centres)


def _gauss_newton(
    problem: Problem,
    views: np.ndarray,
    robust_above: float,
    smallest_step: float,
    is_near: bool,
) -> Smoothed:
    """`smooth`; the factor of an earlier iteration serves again until it `is_outdated`."""
    envelope, records = cheapest_envelope(problem), len(problem.previous)
    weights = np.ones(len(problem.positions) + len(problem.sighted.seen))
    landmarks, mahalanobis_sq = landmarks_and_distances(problem, views, weights)
    doubtful = np.isfinite(thresholds_of(problem, 1.0))
    threshold = robust_above
    if not is_near or _is_a_pose_at_odds(problem, mahalanobis_sq, robust_above):
        threshold = max(threshold, mahalanobis_sq[doubtful].max(initial=0))
    is_outdated, iterations, moved, of_factor = True, 0, 0.0, weights
    while True:
        if iterations == MAX_ITERATIONS:
            raise SmoothingError(f"smoothing {records} poses: no end after {iterations} steps")
        iterations += 1
        weights = robust_weights(mahalanobis_sq, thresholds_of(problem, threshold))
        landmarks, mahalanobis_sq = landmarks_and_distances(problem, views, weights)
        gradient = gradient_of(problem, views, landmarks, weights)
        if is_outdated or np.abs(weights - of_factor).max(initial=0) > REWEIGHTED:
            factor = factorised(problem, views, landmarks, weights, envelope)
            of_factor, moved, before = weights, 0.0, np.inf
        step = -factor.solve_upper(factor.solve_lower(gradient))[: len(gradient)]
        decrease = -gradient @ step
        if not np.isfinite(decrease):
            raise SmoothingError(f"smoothing {records} poses: a step is not finite")
        length = np.sqrt(max(decrease, 0.0))
        moved += length
        if length < smallest_step and threshold <= robust_above:
            views = views + _by_view(problem, step)
            landmarks, mahalanobis_sq = landmarks_and_distances(problem, views, weights)
            break
        views, landmarks, mahalanobis_sq = _line_search(
            problem, views, _by_view(problem, step), weights, mahalanobis_sq, threshold
        )
        is_outdated, before = length > min(NEAR, before), length
        largest = mahalanobis_sq[doubtful].max(initial=0)
        threshold = max(robust_above, min(threshold / SHARPENING, largest))
    reweighted = np.abs(weights - of_factor).max(initial=0)
    if moved > GOOD_ENOUGH * smallest_step or reweighted > smallest_step:
        factor = factorised(problem, views, landmarks, weights, envelope)
    final = cost(problem, views, mahalanobis_sq, robust_above)
    if not np.isfinite(final):
        raise SmoothingError(f"smoothing {records} poses: the cost is not finite")
    poses, centres = np.split(views, [problem.poses])
    centres[:, 2] = problem.prior.centres[:, 2]
    ids = problem.prior.ids
    return Smoothed(
        problem.anchors, ids, poses, centres, landmarks, factor, weights, final, iterations
    )


def _is_a_pose_at_odds(problem: Problem, mahalanobis_sq: np.ndarray, threshold: float) -> bool:
    """Some pose has most of its observations above the threshold: a loop may be open there."""
    views, count = len(problem.columns) - 1, len(problem.positions)
    everything = np.bincount(problem.seen_from, minlength=views)
    above = problem.seen_from[mahalanobis_sq[:count] > threshold]
    at_odds = 2 * np.bincount(above, minlength=views) > everything
    sightings_at_odds = mahalanobis_sq[count:] > threshold
    return bool(at_odds[: problem.poses].any() or sightings_at_odds.any())


def _by_view(problem: Problem, step: np.ndarray) -> np.ndarray:
    """(V, 3): a step (3 (A + P) + 2 a,) of poses and centres."""
    poses, centres = np.split(step, [3 * problem.poses])
    return views_of(poses.reshape(-1, 3), centres.reshape(-1, 2))


def factorised(
    problem: Problem,
    views: np.ndarray,
    landmarks: np.ndarray,
    weights: np.ndarray,
    envelope: Envelope,
) -> Factor:
    """The Cholesky factor of H; `SmoothingError` where H is not positive definite."""
    try:
        return factorise(envelope, information_of(problem, views, landmarks, weights, envelope))
    except np.linalg.LinAlgError as error:
        message = (
            f"smoothing {len(problem.previous)} poses: the information is not positive definite"
        )
        raise SmoothingError(message) from error


def _line_search(
    problem: Problem,
    views: np.ndarray,
    step: np.ndarray,
    weights: np.ndarray,
    mahalanobis_sq: np.ndarray,
    threshold: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The longest of step, step / 2, step / 4, ... that lowers the cost, else the shortest.

    Returns the views (V, 3) it leads to, the landmarks (N, 9) and D (O + S,) there.
    """
    before = cost(problem, views, mahalanobis_sq, threshold)
    for halvings in range(MAX_HALVINGS):
        tried = views + 0.5**halvings * step
        landmarks, mahalanobis_sq = landmarks_and_distances(problem, tried, weights)
        if cost(problem, tried, mahalanobis_sq, threshold) <= before:
            break
    return tried, landmarks, mahalanobis_sq
