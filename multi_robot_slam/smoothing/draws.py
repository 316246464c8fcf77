"""Whole paths drawn from the Gaussian around the smoothing's optimum, and what each implies.

Given a path the landmarks are independent Gaussians (Rao-Blackwell): sums of information, the same
that the filter's EKFs along this path would hold. One pass over the observations gives them and,
landmarks integrated out, the density of the path up to a constant:

    log p(x) = -1/2 (sum r^2 + sum D(sightings) + sum_n [D_n + log det Lambda_n])

    D_n = sum_o e_o^T W_o e_o - h_n^T Lambda_n^-1 h_n,   h_n = sum_o W_o e_o

where r are the residuals of the prior and the odometry, x the poses and the prior's centres, and
e_o is where the observation places the landmark, less some centre. It may be any; here it is
where the most certain observation puts the landmark, so that e_o is small, whatever the path, and
float32 is enough. Compared with the density of the Gaussian it gives each path's weight.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from multi_robot_slam.models import parallel
from multi_robot_slam.models.motion import wrap
from multi_robot_slam.models.parallel import BLOCK, one_thread
from multi_robot_slam.models.symmetric import inverses, unpack
from multi_robot_slam.smoothing.kernels.paths import COS, SIN, X, weigh
from multi_robot_slam.smoothing.marginals import landmark_jacobians
from multi_robot_slam.smoothing.problem import Problem
from multi_robot_slam.smoothing.solve import Smoothed


class Odometry(NamedTuple):
    """What ties each of P poses to the one before; the arrays of `Problem`."""

    previous: np.ndarray
    motions: np.ndarray
    sigmas: np.ndarray


@one_thread
def draw(
    problem: Problem, smoothed: Smoothed, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whole paths and centres from the Gaussian around the optimum, and their log densities.

    With H = L L^T the rows of L^-T times standard normal numbers n have the covariance H^-1, and
    the logarithm of the density of poses, centres and hubs together is -1/2 n^T n. That of the hubs
    given the others is taken off it:

        log q(x) = -1/2 (n^T n - sum_h r_h^T Lambda_h r_h),   r_h = l_h - (l_h at the optimum
                                                                        + dl_h/dx (x - x_hat))

    Parameters
    ----------
    normals : (`smoothed.factor.size`, M) standard normal numbers. Those of float32 take half the
        time and move a path by a ten thousandth of its deviation.

    Returns
    -------
    The paths (A + P, 3, M), the centres' x and y (a, 2, M), and log q (M,) float64, up to a
    constant.

    """
    particles = normals.shape[1]
    deviations = smoothed.factor.solve_upper(normals)
    views, of_hubs = np.split(deviations, [problem.columns[-1]])
    hubs = smoothed.factor.envelope.hubs
    jacobians = landmark_jacobians(problem, smoothed, hubs).astype(normals.dtype, copy=False)
    apart = (of_hubs - jacobians @ views).reshape(len(hubs), 3, particles)
    information = unpack(inverses(smoothed.landmarks[hubs, 3:]))
    neg2_log_density = np.square(normals, dtype=float).sum(axis=0)
    neg2_log_density -= np.sum(apart * (information @ apart), axis=(0, 1))
    of_poses, of_centres = np.split(views, [smoothed.poses.size])
    paths = smoothed.poses[:, :, None] + of_poses.reshape(-1, 3, particles)
    centres = smoothed.centres[:, :2, None] + of_centres.reshape(-1, 2, particles)
    return paths, centres, -0.5 * neg2_log_density


def landmarks_given_paths(
    problem: Problem, paths: np.ndarray, centres: np.ndarray, weights: np.ndarray | None = None
) -> np.ndarray:
    """What the filter's EKFs hold at the end of M `paths`: exact sums of information.

    Returns (N, 9, M) float64: mean [m], covariance [m^2], laid out like the planes of the filter.
    """
    return landmarks_and_log_density(problem, paths, centres, weights)[0]


def landmarks_and_log_density(
    problem: Problem,
    paths: np.ndarray,
    centres: np.ndarray,
    weights: np.ndarray | None = None,
    dtype: DTypeLike = np.float64,
    threads: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks given M `paths` (A + P, 3, M) and `centres` (a, 2, M), and their log densities.

    Parameters
    ----------
    weights : (O + S,) scale the information of observations and sightings (`Smoothed.weights`).
    dtype : of the landmarks and their arithmetic; float32 errs by a hundredth in log density.
    threads : no effect on the result.

    Returns
    -------
    (N, 9, M) `dtype`, mean [m] and covariance [m^2], laid out like the planes of the filter; (M,)
    float64, up to a constant: the logarithms of the exact densities of paths and centres.

    """
    particles = paths.shape[2]
    planes: np.ndarray = np.empty((len(problem.ids), 9, particles), dtype)
    neg2_log_density = _neg2_log_prior(problem, paths, centres, dtype)
    observations, sightings = problem.observations(weights), problem.sightings(weights)
    parallel.over_particles(
        weigh,
        particles,
        threads,
        paths,
        _blocks(paths, centres, dtype),
        Odometry(problem.previous, problem.motions, problem.sigmas),
        sightings,
        observations._replace(
            positions=observations.positions.astype(dtype),
            information=observations.information.astype(dtype),
        ),
        planes,
        neg2_log_density,
    )
    return planes, -0.5 * neg2_log_density


@one_thread
def _neg2_log_prior(
    problem: Problem, paths: np.ndarray, centres: np.ndarray, dtype: DTypeLike
) -> np.ndarray:
    """(M,) float64: the squared distance of anchors and centres from the prior."""
    known = problem.prior
    anchors = paths[: len(known.robots)] - known.poses[:, :, None]
    anchors[:, 2] = wrap(anchors[:, 2])
    apart = np.concatenate([anchors, centres - known.centres[:, :2, None]], axis=None)
    whitened = known.whitener.astype(dtype) @ apart.astype(dtype).reshape(-1, paths.shape[2])
    return np.einsum("im,im->m", whitened, whitened, dtype=float)


def _blocks(paths: np.ndarray, centres: np.ndarray, dtype: DTypeLike) -> np.ndarray:
    """(blocks of particles, V, 4, BLOCK) cos yaw, sin yaw, x, y; centres have no yaw."""
    particles, poses = paths.shape[2], len(paths)
    shape = (-(-particles // BLOCK), poses + len(centres), 4, BLOCK)
    blocks: np.ndarray = np.zeros(shape, dtype)
    blocks[:, poses:, COS] = 1
    # Wrapped in double precision: of many turns float32 would keep too few digits.
    yaw: np.ndarray = (paths[:, 2] - 2 * np.pi * np.rint(paths[:, 2] / (2 * np.pi))).astype(dtype)
    cos, sin = np.cos(yaw), np.sin(yaw)
    for i, block in enumerate(blocks):
        own = slice(i * BLOCK, min((i + 1) * BLOCK, particles))
        count = own.stop - own.start
        block[:poses, COS, :count], block[:poses, SIN, :count] = cos[:, own], sin[:, own]
        block[:poses, X:, :count] = paths[:, :2, own]
        block[poses:, X:, :count] = centres[:, :, own]
    return blocks
