"""Batch smoothing: the most likely paths of all robots and landmarks, given who saw what.

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

with J = de/dx = [-1 0 q_y; 0 -1 -q_x; 0 0 0], q = l - p. A landmark that this would make too dense
stays an unknown (`hubs`): W J and Lambda become rows of H. Its part of the gradient is zero, since
it is at its best. The Cholesky factor of H (`envelope`) also draws paths from the Gaussian around
the optimum (`whole_paths`).
"""

from dataclasses import dataclass

import numpy as np

from multi_robot_slam.models.motion import wrap
from multi_robot_slam.models.parallel import one_thread
from multi_robot_slam.smoothing import kernels
from multi_robot_slam.smoothing.envelope import Envelope, Factor, factorise
from multi_robot_slam.smoothing.hubs import cheapest_envelope
from multi_robot_slam.smoothing.problem import Known, Problem

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
        less and less and in the end not at all: dynamic covariance scaling (Agarwal, Tipaldi,
        Spinello, Stachniss, Burgard 2013) of each. The threshold comes down from the largest D
        of all, so that a loop `poses` leaves open is closed before it could pass for an error.
    smallest_step : the iteration ends when the step is shorter, in standard deviations of the
        solution.

    `SmoothingError` if the information is not positive definite or not finite, or the iteration
    does not end.

    """
    with np.errstate(all="ignore"):  # what is not finite raises `SmoothingError`
        return _gauss_newton(problem, np.array(poses, float), robust_above, smallest_step)


def _gauss_newton(
    problem: Problem, poses: np.ndarray, robust_above: float, smallest_step: float
) -> Smoothed:
    envelope = cheapest_envelope(problem)
    weights = np.ones(len(problem.positions) + len(problem.sighted.seen))
    landmarks, squared = landmarks_and_distances(problem, poses, weights)
    threshold = max(robust_above, squared.max(initial=0))
    is_outdated, before = True, np.inf
    iterations = 0
    while True:
        if iterations == MAX_ITERATIONS:
            raise SmoothingError(f"smoothing {len(poses)} poses: no end after {iterations} steps")
        iterations += 1
        weights = _robust_weights(squared, _thresholds(problem, threshold))
        landmarks, squared = landmarks_and_distances(problem, poses, weights)
        gradient = _gradient(problem, poses, landmarks, weights)
        if is_outdated:
            factor, before = _factorised(problem, poses, landmarks, weights, envelope), np.inf
        step = -factor.solve_upper(factor.solve_lower(gradient))[: poses.size]
        length = np.sqrt(-gradient @ step)
        if not np.isfinite(length):
            raise SmoothingError(f"smoothing {len(poses)} poses: a step is not finite")
        poses, landmarks, squared = _line_search(
            problem, poses, step.reshape(-1, 3), weights, squared, threshold
        )
        if length < smallest_step and threshold <= robust_above:
            break
        is_outdated = threshold > robust_above or length > min(NEAR, before)
        before = length
        threshold = max(robust_above, min(threshold / SHARPENING, squared.max(initial=0)))
    else:
        raise SmoothingError(
            f"smoothing {len(poses)} poses: no optimum in {MAX_ITERATIONS} iterations"
        )
    if not is_outdated:
        factor = _factorised(problem, poses, landmarks, weights, envelope)
    cost = _cost(problem, poses, squared, robust_above)
    if not np.isfinite(cost):
        raise SmoothingError(f"smoothing {len(poses)} poses: the cost is not finite")
    return Smoothed(poses, landmarks, factor, weights, cost, iterations)


def _factorised(
    problem: Problem,
    poses: np.ndarray,
    landmarks: np.ndarray,
    weights: np.ndarray,
    envelope: Envelope,
) -> Factor:
    """The Cholesky factor of H; `SmoothingError` where H is not positive definite."""
    try:
        return factorise(envelope, _system(problem, poses, landmarks, weights, envelope))
    except np.linalg.LinAlgError as error:
        message = f"smoothing {len(poses)} poses: the information is not positive definite"
        raise SmoothingError(message) from error


@one_thread
def landmark_deviations(
    problem: Problem, smoothed: Smoothed, wanted: np.ndarray | None = None
) -> np.ndarray:
    """(A, 3, 3 U): how landmarks lean on the poses, Y_n = (dl_n/dx) L^-T; `wanted` (A,), else all.

    Y_i Y_j^T is the covariance that two landmarks share through the paths. A landmark's marginal
    covariance is Y_n Y_n^T plus the one given the poses.
    """
    wanted = np.arange(len(problem.ids)) if wanted is None else wanted
    solved = smoothed.factor.solve_lower(landmark_leans(problem, smoothed, wanted).T)
    return np.ascontiguousarray(solved.T).reshape(len(wanted), 3, smoothed.factor.size)


def landmark_leans(problem: Problem, smoothed: Smoothed, wanted: np.ndarray) -> np.ndarray:
    """(3 A, 3 P): dl/dx, how the best landmarks `wanted` (A,) follow the poses."""
    leans = np.zeros((len(wanted) * 3, smoothed.poses.size))
    kernels.add_leans(
        wanted,
        problem.starts,
        problem.seen_from,
        problem.information * smoothed.weights[: len(problem.positions), None],
        with_map(smoothed.poses),
        smoothed.landmarks,
        leans,
    )
    return leans


def marginalise(problem: Problem, smoothed: Smoothed, count: int) -> tuple[np.ndarray, Known]:
    """Fix the first `count` poses: where the others start, and what is known of landmarks.

    `problem_of` makes of these and the later records a problem whose size does not grow with the
    run. Its optimum is that of `problem`, as long as the fixed poses are at theirs.

    Parameters
    ----------
    count : no sighting may tie one of these poses to a later one: whole steps.

    Returns
    -------
    Start poses (K, 3), and the landmarks seen by those poses, each observation with its weight.

    """
    start_poses = problem.start_poses.copy()
    start_poses[problem.robots[:count]] = smoothed.poses[:count]
    old = problem.seen_from < count
    seen, counts = np.unique(problem.landmarks[old], return_counts=True)
    landmarks = np.empty((len(seen), 9))
    kernels.fit_landmarks(
        np.append(0, np.cumsum(counts)),
        problem.seen_from[old],
        problem.positions[old],
        (problem.information * smoothed.weights[: len(old), None])[old],
        with_map(smoothed.poses),
        landmarks,
    )
    information = kernels.inverses(landmarks[:, 3:])
    return start_poses, Known(problem.ids[seen], landmarks[:, :3], information)


def landmarks_and_distances(
    problem: Problem, poses: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The landmarks (N, 9) given one path (P, 3), and D (O + S,) of observations and sightings."""
    count = len(problem.positions)
    landmarks, squared = np.empty((len(problem.ids), 9)), np.empty(len(weights))
    poses, seen = with_map(poses), (problem.starts, problem.seen_from, problem.positions)
    kernels.fit_landmarks(*seen, problem.information * weights[:count, None], poses, landmarks)
    kernels.distances(*seen, problem.information, poses, landmarks, squared[:count])
    kernels.sighting_distances(*problem.sighted, poses, squared[count:])
    return landmarks, squared


def with_map(poses: np.ndarray) -> np.ndarray:
    """`poses` (P, 3) and, at the end, the one that MAP stands for."""
    return np.concatenate([poses, np.zeros((1, 3))])


def _thresholds(problem: Problem, threshold: float) -> np.ndarray:
    """(O + S,): F of each observation and sighting; what is `Known` is above suspicion."""
    thresholds = np.full(len(problem.positions) + len(problem.sighted.seen), threshold)
    thresholds[np.flatnonzero(problem.seen_from < 0)] = np.inf
    return thresholds


def _robust_weights(squared: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """(2 F / (F + D))^2 where D is above its threshold F, 1 below."""
    return np.square(np.minimum(1, 2 / (1 + squared / thresholds)))


def _robust(squared: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """The function of D whose derivative is `_robust_weights`: D, then 4 F D / (F + D) - F."""
    beyond = 4 * squared / (1 + squared / thresholds) - thresholds
    return np.where(squared > thresholds, beyond, squared)


def _cost(problem: Problem, poses: np.ndarray, squared: np.ndarray, threshold: float) -> float:
    robust = _robust(squared, _thresholds(problem, threshold))
    return 0.5 * float(np.sum(odometry_residuals(problem, poses) ** 2) + np.sum(robust))


def odometry_residuals(problem: Problem, poses: np.ndarray) -> np.ndarray:
    """(P, 3): (x_p (-) x_previous - u) / sigma."""
    before = problem.poses_before(poses)
    difference = poses - before
    cos, sin = np.cos(before[:, 2]), np.sin(before[:, 2])
    seen = np.column_stack(
        [
            cos * difference[:, 0] + sin * difference[:, 1],
            cos * difference[:, 1] - sin * difference[:, 0],
            difference[:, 2],
        ]
    )
    residuals = seen - problem.motions
    residuals[:, 2] = wrap(residuals[:, 2])
    return residuals / problem.sigmas


def _links(
    problem: Problem, poses: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What ties two poses each, odometry and sightings, whitened.

    Returns the poses (P + S, 2), -1 for a start pose, residuals (P + S, 3) and their derivatives
    (P + S, 3, 6) by the two.
    """
    count = len(poses)
    seen_from, seen, positions, information = problem.sighted
    previous = np.column_stack([problem.previous, np.arange(count)])
    ends = np.concatenate([previous, np.column_stack([seen_from, seen])])
    residuals, jacobians = np.zeros((len(ends), 3)), np.zeros((len(ends), 3, 6))
    residuals[:count] = odometry_residuals(problem, poses)
    before = problem.poses_before(poses)
    kernels.odometry_jacobians(before, problem.sigmas, poses, jacobians[:count])
    information = information * weights[len(problem.positions) :, None]
    kernels.link_sightings(
        seen_from, seen, positions, information, poses, jacobians[count:], residuals[count:]
    )
    return ends, residuals, jacobians


def _gradient(
    problem: Problem, poses: np.ndarray, landmarks: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """(3 P,) of the cost, landmarks at their best."""
    gradient = np.zeros(poses.size)
    ends, residuals, jacobians = _links(problem, poses, weights)
    kernels.link_gradient(ends, jacobians, residuals, gradient)
    information = problem.information * weights[: len(problem.positions), None]
    seen = (problem.starts, problem.seen_from, problem.positions, information)
    kernels.observation_gradient(*seen, with_map(poses), landmarks, gradient)
    return gradient


def _system(
    problem: Problem,
    poses: np.ndarray,
    landmarks: np.ndarray,
    weights: np.ndarray,
    envelope: Envelope,
) -> np.ndarray:
    """The envelope of H."""
    system = np.zeros(envelope.size)
    rows = 3 * envelope.place
    hubs = np.full(len(problem.ids), -1)
    hubs[envelope.hubs] = rows[len(poses) :]
    target = (np.append(rows[: len(poses)], -1), envelope.origins, system)
    ends, _, jacobians = _links(problem, poses, weights)
    kernels.add_links(ends, jacobians, *target)
    information = problem.information * weights[: len(problem.positions), None]
    seen = (problem.starts, problem.seen_from, information)
    kernels.add_observations(*seen, with_map(poses), landmarks, hubs, *target)
    return system


def _line_search(
    problem: Problem,
    poses: np.ndarray,
    step: np.ndarray,
    weights: np.ndarray,
    squared: np.ndarray,
    threshold: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The longest of step, step / 2, step / 4, ... that lowers the cost, else the shortest.

    Returns the poses (P, 3) it leads to, the landmarks (N, 9) and D (O + S,) there.
    """
    cost = _cost(problem, poses, squared, threshold)
    for halvings in range(MAX_HALVINGS):
        tried = poses + 0.5**halvings * step
        landmarks, squared = landmarks_and_distances(problem, tried, weights)
        if _cost(problem, tried, squared, threshold) <= cost:
            break
    return tried, landmarks, squared
