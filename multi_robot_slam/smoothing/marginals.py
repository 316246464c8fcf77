"""What the optimum says of landmarks: marginal distributions."""

import numpy as np

from multi_robot_slam.models.parallel import one_thread
from multi_robot_slam.smoothing.kernels import landmarks as kernels
from multi_robot_slam.smoothing.problem import Problem
from multi_robot_slam.smoothing.solve import Smoothed


@one_thread
def landmark_deviations(
    problem: Problem, smoothed: Smoothed, wanted: np.ndarray | None = None
) -> np.ndarray:
    """(A, 3, rows): Y_n = (dl_n/dx) L^-T of the landmarks `wanted` (A,), by default of all.

    Y_i Y_j^T is the covariance that two landmarks share through poses and centres. A landmark's
    marginal covariance is Y_n Y_n^T plus the one given those.
    """
    wanted = np.arange(len(problem.ids)) if wanted is None else wanted
    solved = smoothed.factor.solve_lower(landmark_jacobians(problem, smoothed, wanted).T)
    return np.ascontiguousarray(solved.T).reshape(len(wanted), 3, smoothed.factor.size)


def landmark_jacobians(problem: Problem, smoothed: Smoothed, wanted: np.ndarray) -> np.ndarray:
    """(3 A, 3 (A + P) + 2 a): how the best landmarks `wanted` (A,) move with poses and centres."""
    columns = problem.columns
    jacobians = np.zeros((len(wanted) * 3, columns[-1]))
    kernels.add_landmark_jacobians(
        wanted,
        problem.observations(smoothed.weights),
        smoothed.views,
        columns,
        smoothed.landmarks,
        jacobians,
    )
    return jacobians
