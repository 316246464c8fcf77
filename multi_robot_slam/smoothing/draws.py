"""Whole paths drawn from the Gaussian around the smoothing's optimum, and what each implies.

Given a path the landmarks are independent Gaussians (Rao-Blackwell): sums of information, the same
that the filter's EKFs along this path would hold. One pass over the observations gives them and,
landmarks integrated out, the density of the path up to a constant:

    log p(x) = -1/2 (sum r^2 + sum D(sightings) + sum_n [D_n + log det Lambda_n])

    D_n = sum_o e_o^T W_o e_o - h_n^T Lambda_n^-1 h_n,   h_n = sum_o W_o e_o

where e_o is where the observation places the landmark, less some centre. It may be any; here it is
where the most certain observation puts the landmark, so that e_o is small, whatever the path, and
float32 is enough. Compared with the density of the Gaussian it gives each path's weight.
"""

import numpy as np
from numba import njit

from multi_robot_slam.models import parallel, stereo
from multi_robot_slam.models.parallel import BLOCK, one_thread
from multi_robot_slam.smoothing.kernels import inverse, inverses
from multi_robot_slam.smoothing.problem import Problem
from multi_robot_slam.smoothing.solve import Smoothed, landmark_leans

COS, SIN, X, Y = range(4)
"""Rows of a block of poses."""

TILT, CROSS, LEAN_X, LEAN_Y, H_X, H_Y, H_Z, SQUARED, AT_X, AT_Y = range(10)
"""Rows of a block of sums: of W (xx - yy) / 2, xy, xz, yz, of h, of e^T W e; and the centre.

The rest of Lambda does not depend on the path.
"""

LOGARITHM_EVERY = 16
"""Landmarks whose determinants are multiplied before a logarithm is taken."""


@one_thread
def draw(
    problem: Problem, smoothed: Smoothed, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Whole paths (P, 3, M) from the Gaussian around the optimum, and their log densities (M,).

    With H = L L^T the rows of L^-T times standard normal numbers n have the covariance H^-1, and
    the logarithm of the density of poses x and hubs together is -1/2 n^T n. That of the hubs given
    the poses is taken off it:

        log q(x) = -1/2 (n^T n - sum_h r_h^T Lambda_h r_h),   r_h = l_h - (l_h at the optimum
                                                                        + dl_h/dx (x - x_hat))

    Parameters
    ----------
    normals : (`smoothed.factor.size`, M) standard normal numbers. Those of float32 take half the
        time and move a path by a ten thousandth of its deviation.

    Returns
    -------
    The paths, and log q float64, up to a constant.

    """
    deviations = smoothed.factor.solve_upper(normals)
    of_poses, of_hubs = np.split(deviations, [smoothed.poses.size])
    hubs = smoothed.factor.envelope.hubs
    leans = landmark_leans(problem, smoothed, hubs).astype(normals.dtype, copy=False)
    apart = (of_hubs - leans @ of_poses).reshape(len(hubs), 3, normals.shape[1])
    information = stereo.unpack(inverses(smoothed.landmarks[hubs, 3:]))
    squared = np.square(normals, dtype=float).sum(axis=0)
    squared -= np.sum(apart * (information @ apart), axis=(0, 1))
    paths = smoothed.poses[:, :, None] + of_poses.reshape(-1, 3, normals.shape[1])
    return paths, -0.5 * squared


def landmarks_given_paths(
    problem: Problem, paths: np.ndarray, weights: np.ndarray | None = None
) -> np.ndarray:
    """What the filter's EKFs hold at the end of M `paths` (P, 3, M): exact sums of information.

    Returns (N, 9, M) float64: mean [m], covariance [m^2], laid out like the planes of the filter.
    """
    return landmarks_and_log_density(problem, paths, weights)[0]


def landmarks_and_log_density(
    problem: Problem,
    paths: np.ndarray,
    weights: np.ndarray | None = None,
    dtype: type = np.float64,
    threads: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks given M `paths` (P, 3, M), and the logarithms of the paths' exact densities.

    Parameters
    ----------
    weights : (O + S,) scale the information of observations and sightings (`Smoothed.weights`).
    dtype : of the landmarks and their arithmetic; float32 errs by a hundredth in log density.
    threads : no effect on the result.

    Returns
    -------
    (N, 9, M) `dtype`, mean [m] and covariance [m^2], laid out like the planes of the filter; (M,)
    float64, up to a constant.

    """
    particles, count = paths.shape[2], len(problem.positions)
    weights = np.ones(count + len(problem.sighted.seen)) if weights is None else weights
    planes = np.empty((len(problem.ids), 9, particles), dtype)
    squared = np.zeros(particles)
    seen_from, seen, positions, information = problem.sighted
    parallel.over_particles(
        _weigh,
        particles,
        threads,
        paths,
        _blocks(paths, dtype),
        (problem.start_poses[problem.robots], problem.previous, problem.motions, problem.sigmas),
        (seen_from, seen, positions, information * weights[count:, None]),
        (
            problem.starts,
            problem.seen_from,
            problem.positions.astype(dtype),
            (problem.information * weights[:count, None]).astype(dtype),
        ),
        planes,
        squared,
    )
    return planes, -0.5 * squared


def _blocks(paths: np.ndarray, dtype: type) -> np.ndarray:
    """(blocks of particles, P + 1, 4, BLOCK) cos yaw, sin yaw, x, y; the last pose is MAP's."""
    particles = paths.shape[2]
    blocks = np.zeros((-(-particles // BLOCK), len(paths) + 1, 4, BLOCK), dtype)
    blocks[:, -1, COS] = 1
    # Wrapped in double precision: of many turns float32 would keep too few digits.
    yaw = (paths[:, 2] - 2 * np.pi * np.rint(paths[:, 2] / (2 * np.pi))).astype(dtype)
    cos, sin = np.cos(yaw), np.sin(yaw)
    for i, block in enumerate(blocks):
        own = slice(i * BLOCK, min((i + 1) * BLOCK, particles))
        count = own.stop - own.start
        block[:-1, COS, :count], block[:-1, SIN, :count] = cos[:, own], sin[:, own]
        block[:-1, X:, :count] = paths[:, :2, own]
    return blocks


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(first, last, paths, blocks, odometry, sightings, observations, planes, squared):
    """Landmarks (N, 9, M) and -2 log p (M,) of particles first .. last - 1, whole blocks."""
    for low in range(first, last, BLOCK):
        high = min(low + BLOCK, last)
        _add_odometry(*odometry, paths, blocks[low // BLOCK], low, squared[low:high])
        _add_sightings(*sightings, paths, blocks[low // BLOCK], low, squared[low:high])
        _add_landmarks(*observations, blocks[low // BLOCK], low, planes, squared[low:high])


@njit(cache=True, nogil=True, error_model="numpy")
def _add_odometry(starts, previous, motions, sigmas, paths, block, low, squared):
    """Add the squared residuals of the odometry."""
    for p in range(len(paths)):
        q, (u_x, u_y, u_yaw), (s_x, s_y, s_yaw) = previous[p], motions[p], 1 / sigmas[p]
        x, y, yaw = starts[p]
        cos, sin = np.cos(yaw), np.sin(yaw)
        for m in range(len(squared)):
            if q >= 0:
                x, y, yaw = paths[q, 0, low + m], paths[q, 1, low + m], paths[q, 2, low + m]
                cos, sin = np.float64(block[q, COS, m]), np.float64(block[q, SIN, m])
            d_x, d_y = paths[p, 0, low + m] - x, paths[p, 1, low + m] - y
            turn = paths[p, 2, low + m] - yaw - u_yaw
            turn -= 2 * np.pi * np.rint(turn / (2 * np.pi))
            e_x = (cos * d_x + sin * d_y - u_x) * s_x
            e_y = (cos * d_y - sin * d_x - u_y) * s_y
            squared[m] += e_x * e_x + e_y * e_y + (turn * s_yaw) * (turn * s_yaw)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_sightings(seen_from, seen, positions, information, paths, block, low, squared):
    """Add D of the sightings."""
    for o in range(len(seen)):
        p, q, (v_x, v_y), (xx, xy, yy) = seen_from[o], seen[o], positions[o], information[o]
        for m in range(len(squared)):
            cos, sin = np.float64(block[p, COS, m]), np.float64(block[p, SIN, m])
            d_x = paths[q, 0, low + m] - paths[p, 0, low + m]
            d_y = paths[q, 1, low + m] - paths[p, 1, low + m]
            e_x, e_y = cos * d_x + sin * d_y - v_x, cos * d_y - sin * d_x - v_y
            squared[m] += xx * e_x * e_x + 2 * xy * e_x * e_y + yy * e_y * e_y


@njit(cache=True, nogil=True, error_model="numpy")
def _add_landmarks(starts, seen_from, positions, information, block, low, planes, squared):
    """Landmarks of one block of particles; add D_n + log det Lambda_n of each."""
    local = np.empty((10, BLOCK), planes.dtype)
    determinants = np.ones(len(squared))
    for n in range(len(planes)):
        centre = _most_certain(information, starts[n], starts[n + 1])
        height = positions[centre, 2]
        local[:AT_X] = 0
        _place(block[seen_from[centre]], positions[centre], local)
        level, upright = local.dtype.type(0), local.dtype.type(0)
        for o in range(starts[n], starts[n + 1]):
            v, own = positions[o], information[o]
            half_sum = (own[0] + own[3]) * local.dtype.type(0.5)
            _add(block[seen_from[o]], v[0], v[1], v[2] - height, own, half_sum, local)
            level += half_sum
            upright += own[5]
        _finish(local, level, upright, height, low, planes[n], squared, determinants)
        if n % LOGARITHM_EVERY == 0 or n == len(planes) - 1:
            squared += np.log(determinants)
            determinants[:] = 1


@njit(cache=True, nogil=True, error_model="numpy")
def _most_certain(information, first, last):
    """The observation whose information has the largest determinant, off its diagonal aside."""
    best, largest = first, -1.0
    for o in range(first, last):
        size = float(information[o, 0]) * float(information[o, 3]) * float(information[o, 5])
        if size > largest:
            best, largest = o, size
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def _place(pose, v, local):
    """Where each particle sees v: the centre."""
    for m in range(BLOCK):
        local[AT_X, m] = pose[X, m] + (pose[COS, m] * v[0] - pose[SIN, m] * v[1])
        local[AT_Y, m] = pose[Y, m] + (pose[SIN, m] * v[0] + pose[COS, m] * v[1])


@njit(cache=True, nogil=True, error_model="numpy")
def _add(pose, v_x, v_y, e_z, own, half_sum, local):
    """Add one observation to the sums; its information turned by trigonometry of the double angle.

    xx, yy = half_sum +- tilt, which saves a third of the multiplications.
    """
    half_difference = (own[0] - own[3]) * local.dtype.type(0.5)
    for m in range(BLOCK):
        c, s = pose[COS, m], pose[SIN, m]
        e_x = pose[X, m] + (c * v_x - s * v_y) - local[AT_X, m]
        e_y = pose[Y, m] + (s * v_x + c * v_y) - local[AT_Y, m]
        cos_twice, sin_twice = c * c - s * s, c * s + c * s
        tilt = half_difference * cos_twice - own[1] * sin_twice
        xy = half_difference * sin_twice + own[1] * cos_twice
        xz, yz = c * own[2] - s * own[4], s * own[2] + c * own[4]
        h_x = (half_sum + tilt) * e_x + xy * e_y + xz * e_z
        h_y = xy * e_x + (half_sum - tilt) * e_y + yz * e_z
        h_z = xz * e_x + yz * e_y + own[5] * e_z
        local[TILT, m] += tilt
        local[CROSS, m] += xy
        local[LEAN_X, m] += xz
        local[LEAN_Y, m] += yz
        local[H_X, m] += h_x
        local[H_Y, m] += h_y
        local[H_Z, m] += h_z
        local[SQUARED, m] += h_x * e_x + h_y * e_y + h_z * e_z


@njit(cache=True, nogil=True, error_model="numpy")
def _finish(local, level, upright, height, low, plane, squared, determinants):
    """Sums -> mean and covariance `plane` (9, M), D_n, det Lambda_n over a power of its trace."""
    scale = 1 / (float(level) * float(level) * float(upright))
    for m in range(len(squared)):
        covariance, determinant = inverse(
            level + local[TILT, m],
            local[CROSS, m],
            local[LEAN_X, m],
            level - local[TILT, m],
            local[LEAN_Y, m],
            upright,
        )
        xx, xy, xz, yy, yz, zz = covariance
        h_x, h_y, h_z = local[H_X, m], local[H_Y, m], local[H_Z, m]
        x, y = xx * h_x + xy * h_y + xz * h_z, xy * h_x + yy * h_y + yz * h_z
        z = xz * h_x + yz * h_y + zz * h_z
        plane[0, low + m] = local[AT_X, m] + x
        plane[1, low + m] = local[AT_Y, m] + y
        plane[2, low + m] = height + z
        plane[3, low + m], plane[4, low + m], plane[5, low + m] = xx, xy, xz
        plane[6, low + m], plane[7, low + m], plane[8, low + m] = yy, yz, zz
        squared[m] += local[SQUARED, m] - (h_x * x + h_y * y + h_z * z)
        determinants[m] *= determinant * scale
