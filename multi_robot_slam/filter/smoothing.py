"""Batch smoothing: the most likely paths of all robots and landmarks, given who saw what.

Unknown are P poses x_p = (x, y, yaw) and N landmarks l_n. Two kinds of residuals tie them together:

    odometry     r = x_p (-) x_previous(p) - u_p,       N(0, diag(sigma_p^2)), as in (7)
    observation  e = l_n - p - Rz v,                    N(0, Rz R Rz^T), as in (8) turned into `map`

e is linear in the landmark, so for given poses the best landmarks and their covariances are sums:

    W = Rz R^-1 Rz^T,   Lambda = sum W,   Lambda l = sum W (p + Rz v)

which is what the filter's EKFs along this path would hold. Gauss-Newton runs over the poses alone;
with the landmarks at their best the Schur complement of the full system is

    H = H_odometry + sum_o J^T W J - sum_n (sum_i J_i^T W_i) Lambda^-1 (sum_j W_j J_j)

with J = de/dx = [-1 0 q_y; 0 -1 -q_x; 0 0 0], q = l - p. H is dense after a few closed loops: one
LAPACK Cholesky factorisation, whose time grows with P^3, and which also draws paths from the
Gaussian around the optimum.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.linalg import cho_solve, cholesky, solve_triangular
from threadpoolctl import ThreadpoolController

from msg_defs.types import CameraMount
from multi_robot_slam.filter import stereo
from multi_robot_slam.filter.history import Record
from multi_robot_slam.filter.motion import MotionSettings, standard_deviations, wrap

SMALLEST_SIGMA = 1e-5
"""Floor of odometry's standard deviations [m, rad].

A robot that stood still has exact odometry; the information must stay finite all the same. A
hundredth of a millimetre is nothing beside what any camera sees.
"""

one_thread = ThreadpoolController().wrap(limits=1, user_api="blas")
"""LAPACK with one thread: the same bytes on any number of cores, and no waiting for a busy one."""

MAX_ITERATIONS = 100
MAX_HALVINGS = 12

SHARPENING = 4.0
"""By how much the robust threshold comes down in each iteration."""

SMALLEST_STEP = 1e-3
"""The iteration ends when the step is shorter than this, in standard deviations of the solution."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What was measured: P poses of K robots, O observations of N landmarks, ordered by landmark.

    Every pose follows another one of the same robot, or the robot's known start pose.
    """

    start_poses: np.ndarray
    """(K, 3) float64: x, y [m], yaw [rad] in `map`, known exactly."""
    robots: np.ndarray
    """(P,) int64: index of the robot."""
    previous: np.ndarray
    """(P,) int64: the pose before, -1 for the start pose; always smaller than the own index."""
    motions: np.ndarray
    """(P, 3) float64: u since the pose before, in its body frame [m, m, rad]."""
    sigmas: np.ndarray
    """(P, 3) float64: standard deviations of `motions`, above zero."""
    seen_from: np.ndarray
    """(O,) int64: pose of each observation; ascending within a landmark."""
    starts: np.ndarray
    """(N + 1,) int64: landmark n has the observations starts[n] .. starts[n + 1] - 1."""
    positions: np.ndarray
    """(O, 3) float64: v in `base_link` [m]."""
    information: np.ndarray
    """(O, 6) float64: R^-1 in `base_link` [1/m^2]."""
    ids: np.ndarray
    """(N,) int64: identity of each landmark, ascending."""

    @property
    def landmarks(self) -> np.ndarray:
        """(O,) int64: index of the landmark of each observation."""
        return np.repeat(np.arange(len(self.ids)), np.diff(self.starts))


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The optimum, and the Gaussian around it."""

    poses: np.ndarray
    """(P, 3) float64: x, y [m], yaw [rad] in `map`."""
    landmarks: np.ndarray
    """(N, 9) float64: mean [m] and covariance [m^2] given the poses, `xx xy xz yy yz zz`."""
    factor: np.ndarray
    """(3 P, 3 P) float64: lower Cholesky factor of the information of the poses, landmarks out."""
    weights: np.ndarray
    """(O,) float64: robust weight of each observation, 0 to 1."""
    cost: float
    """Half the sum of squared, robust, whitened residuals."""
    iterations: int
    converged: bool


def problem_of(
    records: Sequence[Record],
    identities: Sequence[np.ndarray],
    start_poses: np.ndarray,
    noise: MotionSettings,
    mount: CameraMount,
) -> Problem:
    """The problem that a history poses.

    Parameters
    ----------
    records : P frames of all robots, oldest first.
    identities : for each record (B,), which landmark each observation is of.
    start_poses : (K, 3).

    """
    robots = np.array([record.robot for record in records], np.int64)
    motions = np.array([record.motion for record in records], float).reshape(-1, 3)
    sigmas = np.array([standard_deviations(r.motion, r.seconds, noise) for r in records]).reshape(
        -1, 3
    )
    counts = [len(record.positions) for record in records]
    seen_from = np.repeat(np.arange(len(records)), counts)
    seen = np.concatenate([np.empty(0, np.int64), *identities]).astype(np.int64)
    order = np.argsort(seen, kind="stable")
    ids, first = np.unique(seen[order], return_index=True)
    positions, covariances = stereo.to_body(
        np.concatenate([np.empty((0, 3)), *(record.positions for record in records)]),
        np.concatenate([np.empty((0, 6)), *(record.covariances for record in records)]),
        mount,
    )
    return Problem(
        start_poses=np.asarray(start_poses, float),
        robots=robots,
        previous=_previous(robots),
        motions=motions,
        sigmas=np.maximum(sigmas, SMALLEST_SIGMA),
        seen_from=seen_from[order],
        starts=np.append(first, len(seen)),
        positions=positions[order],
        information=stereo.pack(np.linalg.inv(stereo.unpack(covariances[order]))),
        ids=ids,
    )


def _previous(robots: np.ndarray) -> np.ndarray:
    """(P,) the pose before of the same robot, -1 where there is none."""
    previous = np.full(len(robots), -1)
    for robot in np.unique(robots):
        own = np.flatnonzero(robots == robot)
        previous[own[1:]] = own[:-1]
    return previous


@one_thread
def smooth(problem: Problem, poses: np.ndarray, robust_above: float = np.inf) -> Smoothed:
    """Gauss-Newton from `poses` (P, 3) to the most likely paths and landmarks.

    Parameters
    ----------
    robust_above : D (18) up to which an observation counts in full. Beyond it counts less and less
        and in the end not at all: dynamic covariance scaling (Agarwal, Tipaldi, Spinello,
        Stachniss, Burgard 2013) of each observation. The threshold comes down from the largest D
        of all, so that a loop `poses` leaves open is closed before it could pass for an error.

    """
    poses = np.array(poses, float)
    landmarks, squared = _landmarks_and_distances(problem, poses, np.ones(len(problem.positions)))
    threshold = max(robust_above, squared.max(initial=0))
    iterations, converged = 0, False
    while not converged and iterations < MAX_ITERATIONS:
        iterations += 1
        weights = _robust_weights(squared, threshold)
        landmarks, squared = _landmarks_and_distances(problem, poses, weights)
        factor, gradient = _factorise(problem, poses, landmarks, weights)
        step = -cho_solve((factor, True), gradient, check_finite=False)
        length = np.sqrt(-gradient @ step)
        converged = bool(length < SMALLEST_STEP and threshold <= robust_above)
        poses, landmarks, squared = _line_search(
            problem, poses, step.reshape(-1, 3), weights, squared, threshold
        )
        threshold = max(robust_above, threshold / SHARPENING)
    cost = _cost(problem, poses, squared, robust_above)
    return Smoothed(poses, landmarks, factor, weights, cost, iterations, converged)


@one_thread
def draw(smoothed: Smoothed, normals: np.ndarray) -> np.ndarray:
    """Whole paths (P, 3, M) from the Gaussian around the optimum; `normals` (3 P, M) standard.

    With H = L L^T the rows of L^-T times standard normal numbers have the covariance H^-1.
    """
    deviations = solve_triangular(
        smoothed.factor, normals, lower=True, trans="T", check_finite=False
    )
    return smoothed.poses[:, :, None] + deviations.reshape(-1, 3, normals.shape[1])


def landmarks_given_paths(
    problem: Problem, paths: np.ndarray, weights: np.ndarray | None = None
) -> np.ndarray:
    """What the filter's EKFs hold at the end of M `paths` (P, 3, M): exact sums of information.

    Returns (N, 9, M) float64: mean [m], covariance [m^2], laid out like the planes of the filter.
    `weights` (O,) scale the information of each observation.
    """
    information = problem.information
    if weights is not None:
        information = information * weights[:, None]
    planes = np.empty((len(problem.ids), 9, paths.shape[2]))
    _rebuild(
        problem.starts,
        problem.seen_from,
        problem.positions,
        information,
        np.cos(paths[:, 2]),
        np.sin(paths[:, 2]),
        np.ascontiguousarray(paths[:, 0]),
        np.ascontiguousarray(paths[:, 1]),
        planes,
    )
    return planes


@one_thread
def landmark_deviations(problem: Problem, smoothed: Smoothed) -> np.ndarray:
    """(N, 3, 3 P): how the landmarks lean on the poses, Y_n = (dl_n/dx) L^-T.

    Y_i Y_j^T is the covariance that two landmarks share through the paths. A landmark's marginal
    covariance is Y_n Y_n^T plus the one given the poses.
    """
    rows = np.zeros((len(problem.ids) * 3, len(smoothed.factor)))
    _add_leans(
        problem.starts,
        problem.seen_from,
        problem.information * smoothed.weights[:, None],
        smoothed.poses,
        smoothed.landmarks,
        rows,
    )
    solved = solve_triangular(
        smoothed.factor, rows.T, lower=True, overwrite_b=True, check_finite=False
    )
    return np.ascontiguousarray(solved.T).reshape(len(problem.ids), 3, rows.shape[1])


def _landmarks_and_distances(
    problem: Problem, poses: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The landmarks (N, 9) given one path (P, 3), and D (O,) of each observation to its own."""
    landmarks = landmarks_given_paths(problem, poses[:, :, None], weights)[:, :, 0]
    squared = np.empty(len(problem.positions))
    _distances(
        problem.starts,
        problem.seen_from,
        problem.positions,
        problem.information,
        poses,
        landmarks,
        squared,
    )
    return landmarks, squared


def _robust_weights(squared: np.ndarray, threshold: float) -> np.ndarray:
    """(2 F / (F + D))^2 above F = `threshold`, 1 below."""
    return np.square(np.minimum(1, 2 / (1 + squared / threshold)))


def _robust(squared: np.ndarray, threshold: float) -> np.ndarray:
    """The function of D whose derivative is `_robust_weights`: D, then 4 F D / (F + D) - F."""
    if np.isinf(threshold):
        return squared
    beyond = 4 * threshold * squared / (threshold + squared) - threshold
    return np.where(squared > threshold, beyond, squared)


def _cost(problem: Problem, poses: np.ndarray, squared: np.ndarray, threshold: float) -> float:
    residuals = odometry_residuals(problem, poses)
    return 0.5 * float(np.sum(residuals**2) + np.sum(_robust(squared, threshold)))


def odometry_residuals(problem: Problem, poses: np.ndarray) -> np.ndarray:
    """(P, 3): (x_p (-) x_previous - u) / sigma."""
    before = _poses_before(problem, poses)
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


def _poses_before(problem: Problem, poses: np.ndarray) -> np.ndarray:
    """(P, 3): the pose that each follows."""
    starts = problem.start_poses[problem.robots]
    return np.where(problem.previous[:, None] < 0, starts, poses[problem.previous])


def _factorise(
    problem: Problem, poses: np.ndarray, landmarks: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Lower Cholesky factor (3 P, 3 P) of H, and the gradient (3 P,), at `poses`."""
    size = 3 * len(poses)
    system, gradient = np.zeros((size, size), order="F"), np.zeros(size)
    _add_odometry(
        problem.previous,
        _poses_before(problem, poses),
        odometry_residuals(problem, poses),
        problem.sigmas,
        poses,
        system,
        gradient,
    )
    _add_observations(
        problem.starts,
        problem.seen_from,
        problem.positions,
        problem.information * weights[:, None],
        poses,
        landmarks,
        system,
        gradient,
    )
    return cholesky(system, lower=True, overwrite_a=True, check_finite=False), gradient


def _line_search(
    problem: Problem,
    poses: np.ndarray,
    step: np.ndarray,
    weights: np.ndarray,
    squared: np.ndarray,
    threshold: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The longest of step, step / 2, step / 4, ... that lowers the cost, else the shortest.

    Returns the poses (P, 3) it leads to, the landmarks (N, 9) and D (O,) there.
    """
    cost = _cost(problem, poses, squared, threshold)
    for halvings in range(MAX_HALVINGS):
        tried = poses + 0.5**halvings * step
        landmarks, squared = _landmarks_and_distances(problem, tried, weights)
        if _cost(problem, tried, squared, threshold) <= cost:
            break
    return tried, landmarks, squared


@njit(cache=True, nogil=True, error_model="numpy")
def turned(information, c, s):
    """Rz R^-1 Rz^T: (5,) xx xy xz yy yz; zz stays."""
    xx, xy, xz = information[0], information[1], information[2]
    yy, yz = information[3], information[4]
    cc, ss, cs = c * c, s * s, c * s
    return (
        cc * xx - 2 * cs * xy + ss * yy,
        cs * (xx - yy) + (cc - ss) * xy,
        c * xz - s * yz,
        ss * xx + 2 * cs * xy + cc * yy,
        s * xz + c * yz,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _rebuild(starts, seen_from, positions, information, cos, sin, x, y, planes):
    """Sum information and information times place of each landmark, then invert (N, 9, M)."""
    count = planes.shape[2]
    total = np.empty((9, count))
    for n in range(len(planes)):
        total[:] = 0
        for o in range(starts[n], starts[n + 1]):
            p, own = seen_from[o], information[o]
            v_x, v_y, v_z, zz = positions[o, 0], positions[o, 1], positions[o, 2], own[5]
            for m in range(count):
                c, s = cos[p, m], sin[p, m]
                xx, xy, xz, yy, yz = turned(own, c, s)
                at_x, at_y = x[p, m] + c * v_x - s * v_y, y[p, m] + s * v_x + c * v_y
                total[0, m] += xx * at_x + xy * at_y + xz * v_z
                total[1, m] += xy * at_x + yy * at_y + yz * v_z
                total[2, m] += xz * at_x + yz * at_y + zz * v_z
                total[3, m] += xx
                total[4, m] += xy
                total[5, m] += xz
                total[6, m] += yy
                total[7, m] += yz
                total[8, m] += zz
        invert(total, planes[n])


@njit(cache=True, nogil=True, error_model="numpy")
def invert(total, plane):
    """Information times mean, information (9, M) -> mean, covariance (9, M)."""
    for m in range(total.shape[1]):
        xx, xy, xz = total[3, m], total[4, m], total[5, m]
        yy, yz, zz = total[6, m], total[7, m], total[8, m]
        c_xx, c_xy, c_xz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        scale = 1 / (xx * c_xx + xy * c_xy + xz * c_xz)
        c_xx, c_xy, c_xz = c_xx * scale, c_xy * scale, c_xz * scale
        c_yy = (xx * zz - xz * xz) * scale
        c_yz = (xy * xz - xx * yz) * scale
        c_zz = (xx * yy - xy * xy) * scale
        h_x, h_y, h_z = total[0, m], total[1, m], total[2, m]
        plane[0, m] = c_xx * h_x + c_xy * h_y + c_xz * h_z
        plane[1, m] = c_xy * h_x + c_yy * h_y + c_yz * h_z
        plane[2, m] = c_xz * h_x + c_yz * h_y + c_zz * h_z
        plane[3, m], plane[4, m], plane[5, m] = c_xx, c_xy, c_xz
        plane[6, m], plane[7, m], plane[8, m] = c_yy, c_yz, c_zz


@njit(cache=True, nogil=True, error_model="numpy")
def difference(pose, landmark, v):
    """Landmark minus pose and e = l - p - Rz v: (q_x, q_y, e_x, e_y, e_z)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    q_x, q_y = landmark[0] - pose[0], landmark[1] - pose[1]
    return q_x, q_y, q_x - c * v[0] + s * v[1], q_y - s * v[0] - c * v[1], landmark[2] - v[2]


@njit(cache=True, nogil=True, error_model="numpy")
def _distances(starts, seen_from, positions, information, poses, landmarks, squared):
    """D (O,) of each observation: e^T W e."""
    for n in range(len(landmarks)):
        for o in range(starts[n], starts[n + 1]):
            pose = poses[seen_from[o]]
            _, _, x, y, z = difference(pose, landmarks[n], positions[o])
            xx, xy, xz, yy, yz = turned(information[o], np.cos(pose[2]), np.sin(pose[2]))
            squared[o] = xx * x * x + yy * y * y + information[o, 5] * z * z
            squared[o] += 2 * (xy * x * y + xz * x * z + yz * y * z)


@njit(cache=True, nogil=True, error_model="numpy")
def lean(information, pose, q_x, q_y, result):
    """J^T W (3, 3) of one observation."""
    xx, xy, xz, yy, yz = turned(information, np.cos(pose[2]), np.sin(pose[2]))
    result[0, 0], result[0, 1], result[0, 2] = -xx, -xy, -xz
    result[1, 0], result[1, 1], result[1, 2] = -xy, -yy, -yz
    result[2, 0] = q_y * xx - q_x * xy
    result[2, 1] = q_y * xy - q_x * yy
    result[2, 2] = q_y * xz - q_x * yz


@njit(cache=True, nogil=True, error_model="numpy")
def _add_odometry(previous, before, residuals, sigmas, poses, system, gradient):
    """Add the odometry's part of H (lower triangle) and of the gradient."""
    for p in range(len(poses)):
        c, s = np.cos(before[p, 2]), np.sin(before[p, 2])
        d_x, d_y = poses[p, 0] - before[p, 0], poses[p, 1] - before[p, 1]
        jacobian = np.array(
            [
                [-c, -s, c * d_y - s * d_x, c, s, 0.0],
                [s, -c, -c * d_x - s * d_y, -s, c, 0.0],
                [0.0, 0.0, -1.0, 0.0, 0.0, 1.0],
            ]
        )
        for i in range(3):
            jacobian[i] /= sigmas[p, i]
        for i in range(3 if previous[p] < 0 else 0, 6):
            row = 3 * previous[p] + i if i < 3 else 3 * p + i - 3
            gradient[row] += np.sum(jacobian[:, i] * residuals[p])
            for j in range(3 if previous[p] < 0 else 0, i + 1):
                column = 3 * previous[p] + j if j < 3 else 3 * p + j - 3
                system[row, column] += np.sum(jacobian[:, i] * jacobian[:, j])


@njit(cache=True, nogil=True, error_model="numpy")
def _add_observations(
    starts, seen_from, positions, information, poses, landmarks, system, gradient
):
    """Add the observations' part of H (lower triangle) and of the gradient, landmarks out."""
    roots = np.empty((len(positions), 3, 3))
    own = np.empty((3, 3))
    for n in range(len(landmarks)):
        root = covariance_root(landmarks[n])
        for o in range(starts[n], starts[n + 1]):
            pose, row = poses[seen_from[o]], 3 * seen_from[o]
            q_x, q_y, e_x, e_y, e_z = difference(pose, landmarks[n], positions[o])
            lean(information[o], pose, q_x, q_y, own)
            for i in range(3):
                gradient[row + i] += own[i, 0] * e_x + own[i, 1] * e_y + own[i, 2] * e_z
                system[row + i, row] -= own[i, 0]
                system[row + i, row + 1] -= own[i, 1]
                system[row + i, row + 2] += own[i, 0] * q_y - own[i, 1] * q_x
                for j in range(3):
                    roots[o, i, j] = 0
                    for k in range(j, 3):
                        roots[o, i, j] += own[i, k] * root[k, j]
        for o in range(starts[n], starts[n + 1]):
            for other in range(starts[n], o + 1):
                row, column = 3 * seen_from[o], 3 * seen_from[other]
                subtract_product(roots[o], roots[other], row, column, system)
                if row == column and other < o:
                    subtract_product(roots[other], roots[o], row, row, system)


@njit(cache=True, nogil=True, error_model="numpy")
def subtract_product(a, b, row, column, system):
    """Subtract a b^T (3, 3) from the block of `system` at `row`, `column`."""
    for j in range(3):
        for i in range(3):
            system[row + i, column + j] -= a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def covariance_root(landmark):
    """Lower Cholesky factor (3, 3) of the covariance in `landmark` (9,)."""
    root = np.zeros((3, 3))
    root[0, 0] = np.sqrt(landmark[3])
    root[1, 0], root[2, 0] = landmark[4] / root[0, 0], landmark[5] / root[0, 0]
    root[1, 1] = np.sqrt(landmark[6] - root[1, 0] ** 2)
    root[2, 1] = (landmark[7] - root[2, 0] * root[1, 0]) / root[1, 1]
    root[2, 2] = np.sqrt(landmark[8] - root[2, 0] ** 2 - root[2, 1] ** 2)
    return root


@njit(cache=True, nogil=True, error_model="numpy")
def _add_leans(starts, seen_from, information, poses, landmarks, rows):
    """Add dl/dx = -Lambda^-1 sum W J to `rows` (3 N, 3 P)."""
    own = np.empty((3, 3))
    covariance = np.empty((3, 3))
    for n in range(len(landmarks)):
        root = covariance_root(landmarks[n])
        covariance[:] = root @ root.T
        for o in range(starts[n], starts[n + 1]):
            pose, first = poses[seen_from[o]], 3 * seen_from[o]
            q_x, q_y = landmarks[n, 0] - pose[0], landmarks[n, 1] - pose[1]
            lean(information[o], pose, q_x, q_y, own)
            rows[3 * n : 3 * n + 3, first : first + 3] -= covariance @ own.T
