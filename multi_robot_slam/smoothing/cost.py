"""The cost that smoothing minimises: residuals of one path and its centres, and how far they count.

An observation or sighting counts in full up to a threshold F of D. Beyond it counts less and less:
dynamic covariance scaling (Agarwal, Tipaldi, Spinello, Stachniss, Burgard 2013).
"""

import numpy as np

from multi_robot_slam.models.motion import wrap
from multi_robot_slam.smoothing.kernels import landmarks as kernels
from multi_robot_slam.smoothing.problem import Problem


def landmarks_and_distances(
    problem: Problem, views: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The landmarks (N, 9) given `views` (V, 3), and D (O + S,) of observations and sightings."""
    count = len(problem.positions)
    landmarks, distances = np.empty((len(problem.ids), 9)), np.empty(len(weights))
    kernels.fit_landmarks(problem.observations(weights), views, landmarks)
    kernels.mahalanobis_sq(problem.observations(), views, landmarks, distances[:count])
    kernels.sighting_mahalanobis_sq(problem.sighted, views, distances[count:])
    return landmarks, distances


def odometry_residuals(problem: Problem, views: np.ndarray) -> np.ndarray:
    """(P, 3): (x_p (-) x_previous - u) / sigma."""
    before = views[problem.previous]
    difference = views[len(problem.anchors) : problem.poses] - before
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


def prior_residuals(problem: Problem, views: np.ndarray) -> np.ndarray:
    """(3 A + 2 a,): anchors and centres less their prior means."""
    anchors = views[: len(problem.anchors)] - problem.prior.poses
    anchors[:, 2] = wrap(anchors[:, 2])
    return np.append(anchors, views[problem.poses :, :2] - problem.prior.centres[:, :2])


def thresholds_of(problem: Problem, threshold: float) -> np.ndarray:
    """(O + S,): F of each observation and sighting; those from centres count in full at any D."""
    thresholds = np.full(len(problem.positions) + len(problem.sighted.seen), threshold)
    thresholds[np.flatnonzero(problem.seen_from >= problem.poses)] = np.inf
    return thresholds


def robust_weights(mahalanobis_sq: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """(2 F / (F + D))^2 where D is above its threshold F, 1 below."""
    return np.square(np.minimum(1, 2 / (1 + mahalanobis_sq / thresholds)))


def robust(mahalanobis_sq: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """The function of D whose derivative is `robust_weights`: D, then 4 F D / (F + D) - F."""
    beyond = 4 * mahalanobis_sq / (1 + mahalanobis_sq / thresholds) - thresholds
    return np.where(mahalanobis_sq > thresholds, beyond, mahalanobis_sq)


def cost(
    problem: Problem, views: np.ndarray, mahalanobis_sq: np.ndarray, threshold: float
) -> float:
    """Half the sum of squared, robust, whitened residuals."""
    distances = robust(mahalanobis_sq, thresholds_of(problem, threshold))
    odometry, known = odometry_residuals(problem, views), prior_residuals(problem, views)
    of_prior = np.sum((problem.prior.whitener @ known) ** 2)
    return 0.5 * float(np.sum(odometry**2) + np.sum(distances) + of_prior)
