"""Smoothing: the most likely paths of all robots and landmarks, given who saw what.

Unknown are P poses x_p = (x, y, yaw) and N landmarks l_n. Three kinds of residuals tie them
together:

    odometry     r = x_p (-) x_previous(p) - u_p,       N(0, diag(sigma_p^2)), as in (7)
    observation  e = l_n - p - Rz v,                    N(0, Rz R Rz^T), as in (8) turned into `map`
    sighting     e = p_q - p_p - Rz s,                  the same in the plane: robot p sees robot q

An observation is linear in the landmark, so for given poses the best landmarks and their
covariances are sums:

    W = Rz R^-1 Rz^T,   Lambda = sum W,   Lambda l = sum W (p + Rz v)

which is what the filter's EKFs along this path would hold. Gauss-Newton runs over the poses alone;
with the landmarks at their best the Schur complement of the full system is

    H = H_odometry + H_sightings
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
from multi_robot_slam.smoothing.problem import Problem

MAX_ITERATIONS = 100
MAX_HALVINGS = 12

SHARPENING = 4.0
"""By how much the robust threshold comes down in each iteration."""

SMALLEST_STEP = 1e-3
"""Far below anything that could be measured."""

NEAR = 1.0
"""After a step shorter than this the same H serves for the next ones; they cost a fifth."""


class SmoothingError(ValueError):
    """There is no optimum, or it was not found: says why."""


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The optimum, and the Gaussian around it."""

    poses: np.ndarray
    """(P, 3) float64: x, y [m], yaw [rad] in `map`."""
    landmarks: np.ndarray
    """(N, 9) float64: mean [m] and covariance [m^2] given the poses, `xx xy xz yy yz zz`."""
    factor: Factor
    """Cholesky factor of the information of the poses and hubs, other landmarks out."""
    weights: np.ndarray
    """(O + S,) float64: robust weight of each observation and sighting, 0 to 1."""
    cost: float
    """Half the sum of squared, robust, whitened residuals."""
    iterations: int


@one_thread
def smooth(
    problem: Problem,
    poses: np.ndarray,
    robust_above: float = np.inf,
    smallest_step: float = SMALLEST_STEP,
) -> Smoothed:
    """Gauss-Newton from `poses` (P, 3) to the most likely paths and landmarks.

    Parameters
    ----------
    robust_above : D (18) up to which an observation or sighting counts in full. Beyond it counts
        less and less and in the end not at all (`cost`). The threshold comes down from the largest
        D, so that a loop that `poses` leave open is closed before it could be taken for an error.
    smallest_step : the iteration ends when the step is shorter, in standard deviations of the
        solution.

    Raises
    ------
    SmoothingError
        The information is not positive definite, something is not finite, or the iteration does
        not end.

    """
    with np.errstate(all="ignore"):  # what is not finite raises `SmoothingError`
        return _gauss_newton(problem, np.array(poses, float), robust_above, smallest_step)


def _gauss_newton(
    problem: Problem, poses: np.ndarray, robust_above: float, smallest_step: float
) -> Smoothed:
    """`smooth`; the factor of an earlier iteration serves again until it `is_outdated`."""
    envelope = cheapest_envelope(problem)
    weights = np.ones(len(problem.positions) + len(problem.sighted.seen))
    landmarks, mahalanobis_sq = landmarks_and_distances(problem, poses, weights)
    threshold = max(robust_above, mahalanobis_sq.max(initial=0))
    is_outdated, iterations = True, 0
    while True:
        if iterations == MAX_ITERATIONS:
            raise SmoothingError(f"smoothing {len(poses)} poses: no end after {iterations} steps")
        iterations += 1
        weights = robust_weights(mahalanobis_sq, thresholds_of(problem, threshold))
        landmarks, mahalanobis_sq = landmarks_and_distances(problem, poses, weights)
        gradient = gradient_of(problem, poses, landmarks, weights)
        if is_outdated:
            factor, before = _factorised(problem, poses, landmarks, weights, envelope), np.inf
        step = -factor.solve_upper(factor.solve_lower(gradient))[: poses.size]
        decrease = -gradient @ step
        if not np.isfinite(decrease):
            raise SmoothingError(f"smoothing {len(poses)} poses: a step is not finite")
        length = np.sqrt(max(decrease, 0.0))
        poses, landmarks, mahalanobis_sq = _line_search(
            problem, poses, step.reshape(-1, 3), weights, mahalanobis_sq, threshold
        )
        if length < smallest_step and threshold <= robust_above:
            break
        is_outdated = threshold > robust_above or length > min(NEAR, before)
        before = length
        threshold = max(robust_above, min(threshold / SHARPENING, mahalanobis_sq.max(initial=0)))
    if not is_outdated:
        factor = _factorised(problem, poses, landmarks, weights, envelope)
    final = cost(problem, poses, mahalanobis_sq, robust_above)
    if not np.isfinite(final):
        raise SmoothingError(f"smoothing {len(poses)} poses: the cost is not finite")
    return Smoothed(poses, landmarks, factor, weights, final, iterations)


def _factorised(
    problem: Problem,
    poses: np.ndarray,
    landmarks: np.ndarray,
    weights: np.ndarray,
    envelope: Envelope,
) -> Factor:
    """The Cholesky factor of H; `SmoothingError` where H is not positive definite."""
    try:
        return factorise(envelope, information_of(problem, poses, landmarks, weights, envelope))
    except np.linalg.LinAlgError as error:
        message = f"smoothing {len(poses)} poses: the information is not positive definite"
        raise SmoothingError(message) from error


def _line_search(
    problem: Problem,
    poses: np.ndarray,
    step: np.ndarray,
    weights: np.ndarray,
    mahalanobis_sq: np.ndarray,
    threshold: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The longest of step, step / 2, step / 4, ... that lowers the cost, else the shortest.

    Returns the poses (P, 3) it leads to, the landmarks (N, 9) and D (O + S,) there.
    """
    before = cost(problem, poses, mahalanobis_sq, threshold)
    for halvings in range(MAX_HALVINGS):
        tried = poses + 0.5**halvings * step
        landmarks, mahalanobis_sq = landmarks_and_distances(problem, tried, weights)
        if cost(problem, tried, mahalanobis_sq, threshold) <= before:
            break
    return tried, landmarks, mahalanobis_sq
