"""What the optimum says of landmarks, and of the poses that come next: marginal distributions."""

import numpy as np

from multi_robot_slam.models.parallel import one_thread
from multi_robot_slam.models.symmetric import inverses
from multi_robot_slam.smoothing.kernels import landmarks as kernels
from multi_robot_slam.smoothing.problem import Known, Observations, Problem, with_map
from multi_robot_slam.smoothing.solve import Smoothed


@one_thread
def landmark_deviations(
    problem: Problem, smoothed: Smoothed, wanted: np.ndarray | None = None
) -> np.ndarray:
    """(A, 3, 3 U): Y_n = (dl_n/dx) L^-T of the landmarks `wanted` (A,), by default of all.

    Y_i Y_j^T is the covariance that two landmarks share through the paths. A landmark's marginal
    covariance is Y_n Y_n^T plus the one given the poses.
    """
    wanted = np.arange(len(problem.ids)) if wanted is None else wanted
    solved = smoothed.factor.solve_lower(landmark_jacobians(problem, smoothed, wanted).T)
    return np.ascontiguousarray(solved.T).reshape(len(wanted), 3, smoothed.factor.size)


def landmark_jacobians(problem: Problem, smoothed: Smoothed, wanted: np.ndarray) -> np.ndarray:
    """(3 A, 3 P): dl/dx, how the best landmarks `wanted` (A,) move with the poses."""
    jacobians = np.zeros((len(wanted) * 3, smoothed.poses.size))
    observations = problem.observations(smoothed.weights)
    kernels.add_landmark_jacobians(
        wanted, observations, with_map(smoothed.poses), smoothed.landmarks, jacobians
    )
    return jacobians


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
    observations, old = problem.observations(smoothed.weights), problem.seen_from < count
    seen, counts = np.unique(problem.landmarks[old], return_counts=True)
    landmarks = np.empty((len(seen), 9))
    of_old = Observations(
        np.append(0, np.cumsum(counts)),
        observations.seen_from[old],
        observations.positions[old],
        observations.information[old],
    )
    kernels.fit_landmarks(of_old, with_map(smoothed.poses), landmarks)
    information = inverses(landmarks[:, 3:])
    return start_poses, Known(problem.ids[seen], landmarks[:, :3], information)
