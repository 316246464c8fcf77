"""Variance components: against full matrices, and against worlds whose noise is known."""

import drives
import numpy as np
import pytest

from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.smoothing import noise_factors, solve
from multi_robot_slam.smoothing.cost import odometry_residuals


def dense(problem, smoothed):
    """Groups (n,) of all whitened residuals, -1 those of the prior, and P (n, n), by full matrices.

    Numeric derivatives by all poses, centres and landmarks.
    """
    poses, centres = smoothed.poses, smoothed.centres[:, :2]
    sizes = np.cumsum([poses.size, centres.size])
    roots = np.linalg.cholesky(
        unpack(problem.information * smoothed.weights[: len(problem.information), None])
    )

    def residuals(unknowns):
        own, of_centres, landmarks = np.split(unknowns, sizes)
        own, landmarks = own.reshape(-1, 3), landmarks.reshape(-1, 3)
        views = np.concatenate([own, np.pad(of_centres.reshape(-1, 2), ((0, 0), (0, 1)))])
        seen = views[problem.seen_from]
        cos, sin = np.cos(seen[:, 2]), np.sin(seen[:, 2])
        apart = landmarks[problem.landmarks] - np.pad(seen[:, :2], ((0, 0), (0, 1)))
        forward = cos * apart[:, 0] + sin * apart[:, 1]
        left = cos * apart[:, 1] - sin * apart[:, 0]
        body = np.stack([forward, left, apart[:, 2]], axis=1)
        errors = np.einsum("oji,oj->oi", roots, body - problem.positions)
        known = np.append(
            own[: len(problem.anchors)] - problem.prior.poses,
            of_centres.reshape(-1, 2) - problem.prior.centres[:, :2],
        )
        return np.concatenate(
            [
                odometry_residuals(problem, own).ravel(),
                errors.ravel(),
                problem.prior.whitener @ known,
            ]
        )

    at = np.concatenate([poses.ravel(), centres.ravel(), smoothed.landmarks[:, :3].ravel()])
    step = 1e-6
    jacobian = np.stack(
        [
            (residuals(at + step * unit) - residuals(at - step * unit)) / (2 * step)
            for unit in np.eye(len(at))
        ],
        axis=1,
    )
    robots = problem.robots[len(problem.anchors) :]
    seers = np.append(problem.robots, np.full(len(centres), -1))[problem.seen_from]
    groups = np.concatenate(
        [
            np.repeat(2 * robots, 3),
            np.repeat(np.where(seers < 0, -1, 2 * seers + 1), 3),
            np.full(len(problem.prior.whitener), -1),
        ]
    )
    return groups, jacobian @ np.linalg.inv(jacobian.T @ jacobian) @ jacobian.T


def dense_matrix(problem, smoothed):
    """S, with the prior's share on the diagonal, and the redundancy of every residual."""
    groups, projector = dense(problem, smoothed)
    rest = np.eye(len(projector)) - projector
    count = 2 * (problem.robots.max() + 1)
    matrix = np.array(
        [
            [np.sum(rest[np.ix_(groups == g, groups == h)] ** 2) for h in range(count)]
            for g in range(count)
        ]
    )
    matrix[np.diag_indices(count)] += [
        np.sum(rest[np.ix_(groups == g, groups == -1)] ** 2) for g in range(count)
    ]
    return matrix, np.diag(rest)


@pytest.mark.parametrize("with_prior", [False, True])
def test_shares_are_those_of_full_matrices(with_prior):
    if with_prior:
        problem, poses = drives.later(steps=12, count=18)
    else:
        state, settings = drives.filtered(steps=6)
        problem, poses = drives.posed(state, settings)
    smoothed = solve.smooth(problem, poses, smallest_step=1e-6)
    matrix, redundancies = dense_matrix(problem, smoothed)
    draws = 4000
    shares = noise_factors.shares_of(problem, smoothed, draws)
    np.testing.assert_allclose(shares.matrix.sum(axis=1), matrix.sum(axis=1), rtol=0.01)
    np.testing.assert_allclose(shares.matrix, matrix, atol=0.03, rtol=0.015)
    count = 3 * len(problem.previous)
    np.testing.assert_allclose(shares.redundancies[0].ravel(), redundancies[:count], atol=0.12)
    own = redundancies[count : count + 3 * len(problem.positions)].reshape(-1, 3).mean(axis=1)
    np.testing.assert_allclose(shares.redundancies[1], own, atol=0.12)
