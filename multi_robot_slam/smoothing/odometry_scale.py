"""How far each robot goes for a metre, and turns for a radian, that its odometry tells.

Factors s = (s_v, s_w) of each robot, at first N(1, sigma^2), are estimated along the paths: with
them the odometry's residual is r = x (-) x_previous - s u. At the optimum of the paths for given
factors, with whitened residuals and N(m, L^-1) what was known of the factors before,

    g = dr/ds^T r + L (s - m),   S = dr/ds^T dr/ds - B^T H^-1 B,   B = dr/dx^T dr/ds

are the gradient of the cost with the paths at their best, and what the paths add to its curvature:
s - (L + S)^-1 g is one Newton step to the most likely factors. What the paths say, the parabola of
S and of g without the L (s - m), is added to L and m by the share of the poses that are fixed.
"""

from typing import NamedTuple

import numpy as np

from multi_robot_slam.smoothing.blocks import with_block_again
from multi_robot_slam.smoothing.cost import odometry_residuals
from multi_robot_slam.smoothing.kernels.links import odometry_jacobians
from multi_robot_slam.smoothing.problem import Problem
from multi_robot_slam.smoothing.solve import Smoothed, SmoothingError

VAGUE = 0.3
"""Standard deviation of factors of which nothing is known: no odometry is off by twice."""


class Scales(NamedTuple):
    """The factors of K robots, and what fixed poses say of them."""

    factors: np.ndarray
    """(K, 2) float64: of distances, of turns."""
    mean: np.ndarray
    """(2 K,) float64: m."""
    information: np.ndarray
    """(2 K, 2 K) float64: L."""
    sigmas: np.ndarray
    """(K, 2) float64: standard deviations of the factors, with the noise that is used."""

    @classmethod
    def unknown(cls, robots: int, sigma: float) -> "Scales":
        """Nothing was seen yet; `sigma` 0: the factors are 1."""
        information = np.eye(2 * robots) / sigma**2 if sigma > 0 else np.zeros((0, 0))
        sigmas = np.full((robots, 2), sigma)
        return cls(np.ones((robots, 2)), np.ones(2 * robots), information, sigmas)

    def with_another(self, robot: int) -> "Scales":
        """With another robot after the others, of which as much is known as of `robot`."""
        own = 2 * robot + np.arange(2)
        is_used = len(self.information) > 0
        return Scales(
            np.vstack([self.factors, self.factors[robot]]),
            np.append(self.mean, self.mean[own]),
            with_block_again(self.information, own) if is_used else self.information,
            np.vstack([self.sigmas, self.sigmas[robot]]),
        )


def learn(
    scales: Scales, problem: Problem, smoothed: Smoothed, motions: np.ndarray, fixed: float
) -> Scales:
    """One Newton step from `scales`, for which `smoothed` is the optimum.

    Parameters
    ----------
    motions : (P, 3) as odometry tells them; those of `problem` are the factors times these.
    fixed : share of the poses that are fixed now.

    `SmoothingError` if the factors have no optimum.

    """
    if not len(scales.information):
        return scales
    gradient, curvature = _profile(problem, smoothed, motions, len(scales.mean))
    old = scales.factors.ravel()
    pull = gradient + scales.information @ (old - scales.mean)
    information = scales.information + fixed * curvature
    known = scales.information @ scales.mean + fixed * (curvature @ old - gradient)
    try:
        covariance = np.linalg.inv(scales.information + curvature)
        new = old - np.linalg.solve(scales.information + curvature, pull)
        mean = np.linalg.solve(information, known)
    except np.linalg.LinAlgError as error:
        raise SmoothingError("the odometry's factors have no optimum") from error
    sigmas = np.sqrt(np.diag(covariance))
    return Scales(new.reshape(-1, 2), mean, information, sigmas.reshape(-1, 2))


def _profile(
    problem: Problem, smoothed: Smoothed, motions: np.ndarray, unknown: int
) -> tuple[np.ndarray, np.ndarray]:
    """dr/ds^T r (2 K,) and S (2 K, 2 K) at the optimum of the paths; 2 K are `unknown`."""
    count, poses = len(motions), smoothed.poses
    jacobians = np.empty((count, 3, 6))
    before = poses[problem.previous]
    odometry_jacobians(before, problem.sigmas, smoothed.of_records, jacobians)
    by_scale = np.zeros((count, 3, unknown))
    rows, told = np.arange(count), -motions / problem.sigmas
    robots = problem.robots[len(problem.anchors) :]
    by_scale[rows, 0, 2 * robots] = told[:, 0]
    by_scale[rows, 1, 2 * robots] = told[:, 1]
    by_scale[rows, 2, 2 * robots + 1] = told[:, 2]
    gradient = np.einsum("prs,pr->s", by_scale, odometry_residuals(problem, poses))
    mixed = np.einsum("pri,prs->pis", jacobians, by_scale)
    by_pose = np.zeros((len(poses), 3, unknown))
    by_pose[len(problem.anchors) :] = mixed[:, 3:]
    np.add.at(by_pose, problem.previous, mixed[:, :3])
    solved = smoothed.factor.solve_lower(by_pose.reshape(3 * len(poses), unknown))
    curvature = np.einsum("prs,prt->st", by_scale, by_scale) - solved.T @ solved
    return _of_what_is_known(gradient, curvature)


def _of_what_is_known(gradient: np.ndarray, curvature: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both along the eigenvectors of the curvature (n, n) whose eigenvalue is positive.

    H was linearised one iteration before B. Where a residual is as stiff as a standing robot's,
    the difference of the two may be below zero: there the paths say nothing of the factors.
    """
    values, vectors = np.linalg.eigh(curvature)
    known = vectors[:, values > 0]
    return known @ (known.T @ gradient), (known * values[values > 0]) @ known.T


def doubted(
    scales: Scales, problem: Problem, motions: np.ndarray, redundancies: np.ndarray
) -> Scales:
    """With larger deviations, where it is not known whether what was told errs or what was done.

    (7) has the noise in what the robot does. Of an odometry that measures with it, the told u are
    larger than they should be by its share, and the factors too small by

        sum rho / sum rho (u / sigma)^2

    over a robot's distances or turns: the mean of noise times residual over its weight.

    Parameters
    ----------
    motions : (P, 3) as odometry tells them.
    redundancies : (P, 3) rho of the odometry's residuals (`noise_factors.Shares`).

    """
    robots = problem.robots[len(problem.anchors) :]
    noise, told = np.zeros((2, *scales.factors.shape))
    weighted = redundancies.clip(min=0) * np.square(motions / problem.sigmas)
    for kind, axes in enumerate((slice(0, 2), slice(2, 3))):
        np.add.at(noise[:, kind], robots, redundancies[:, axes].clip(min=0).sum(axis=1))
        np.add.at(told[:, kind], robots, weighted[:, axes].sum(axis=1))
    sigmas = np.hypot(scales.sigmas, noise / np.maximum(told, 1.0))
    return scales._replace(sigmas=sigmas)


def scaled(motion: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Motions (..., 3) with their robots' factors (..., 2) applied."""
    return motion * factors[..., [0, 0, 1]]
