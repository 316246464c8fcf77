"""Whole paths: their landmarks, their densities, and what they are worth."""

import numpy as np
import pytest
from drives import GATE, covariance_of_views, filtered, later, posed, straight, with_hubs

from multi_robot_slam.models import stereo
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.smoothing import draws
from multi_robot_slam.smoothing.cost import (
    landmarks_and_distances,
    odometry_residuals,
    prior_residuals,
)
from multi_robot_slam.smoothing.problem import views_of
from multi_robot_slam.smoothing.solve import smooth


@pytest.fixture(scope="module", params=[False, True], ids=["whole", "later"])
def smoothed(request):
    problem, poses = later(12, 9, True) if request.param else posed(*filtered(), sighted=True)
    return problem, smooth(problem, poses, GATE)


def drawn(problem, found, count):
    """Paths (A + P, 3, M), centres (a, 2, M), and the logarithms of their densities (M,)."""
    normals = np.random.default_rng(0).standard_normal((found.factor.size, count))
    return draws.draw(problem, found, normals)


NO_CENTRES = np.empty((0, 2, 1))


def with_anchors(problem, path):
    """(A + P, 3, 1)"""
    return np.concatenate([problem.prior.poses, path])[:, :, None]


def stacked(paths, centres):
    """(3 (A + P) + 2 a, M)"""
    return np.concatenate([paths, centres], axis=None).reshape(-1, paths.shape[2])


@pytest.mark.parametrize("share", [0, 0.5, 1])
def test_drawn_paths_have_the_covariance_and_the_density_of_the_optimum(
    monkeypatch, smoothed, share
):
    """That of the Gaussian as it is without hubs."""
    problem, without = smoothed
    covariance = covariance_of_views(without)
    with_hubs(monkeypatch, share)
    found = smooth(problem, without.of_records, GATE, start=without)
    paths, centres, logs = drawn(problem, found, 4000)
    apart = stacked(paths - found.poses[:, :, None], centres - found.centres[:, :2, None])
    squared = np.sum(apart * np.linalg.solve(covariance, apart), axis=0)
    np.testing.assert_allclose(logs, -0.5 * squared, rtol=2e-3)
    sigma = np.sqrt(np.diag(covariance))
    sample = np.cov(apart) / np.outer(sigma, sigma)
    expected = covariance / np.outer(sigma, sigma)
    # The standard error of a correlation is at most sqrt(2 / 4000); the largest of 8,000 is 4.6.
    np.testing.assert_allclose(sample, expected, atol=4.6 * np.sqrt(2 / 4000))


@pytest.mark.parametrize("proposal", ["motion", "informed"])
def test_landmarks_given_its_path_are_the_particle_s(proposal):
    """Every particle's EKFs, one observation after the other, hold what the sums hold."""
    state, settings = filtered(seed=3, proposal=proposal, particles=5)
    for m in range(5):
        problem, path = posed(state, settings, m)
        planes = draws.landmarks_given_paths(problem, with_anchors(problem, path), NO_CENTRES)
        columns, values = state.landmarks.of_particle(m)
        assert problem.ids.tolist() == state.landmarks.ids[columns].tolist()
        np.testing.assert_allclose(planes[:, :, 0], values, rtol=1e-7, atol=1e-10)


def test_landmarks_at_the_optimum_are_the_smoothing_s(smoothed):
    problem, found = smoothed
    planes = draws.landmarks_given_paths(
        problem, found.poses[:, :, None], found.centres[:, :2, None], found.weights
    )
    np.testing.assert_allclose(planes[:, :, 0], found.landmarks, rtol=1e-8, atol=1e-11)


def log_density(problem, views, weights):
    """Term by term, for one path and its centres."""
    landmarks, squared = landmarks_and_distances(problem, views, weights)
    odometry = np.sum(odometry_residuals(problem, views) ** 2)
    known = prior_residuals(problem, views)
    determinants = np.linalg.det(unpack(landmarks[:, 3:]))
    of_prior = known @ problem.prior.information @ known
    return -0.5 * (of_prior + odometry + squared @ weights - np.sum(np.log(determinants)))


def test_density_is_the_sum_of_its_terms(smoothed):
    problem, found = smoothed
    rng = np.random.default_rng(1)
    paths = found.poses[:, :, None] + rng.normal(0, 0.03, (*found.poses.shape, 300))
    centres = found.centres[:, :2, None] + rng.normal(0, 0.03, (len(found.centres), 2, 300))
    paths[: len(found.anchors)] = found.poses[: len(found.anchors), :, None]
    _, found_logs = draws.landmarks_and_log_density(problem, paths, centres, found.weights)
    logs = [
        log_density(problem, views_of(paths[:, :, m], centres[:, :, m]), found.weights)
        for m in range(300)
    ]
    np.testing.assert_allclose(found_logs - found_logs[0], np.array(logs) - logs[0], rtol=1e-8)


def test_density_with_landmarks_out_is_the_integral():
    """One landmark, two poses: the determinant's share, by quadrature over its place."""
    problem = straight(poses=2, landmarks=1)
    poses = np.zeros((3, 3, 2))
    poses[1:, :, 0] = [[1.0, 0.2, 0.0], [2.0, 0.4, 0.0]]
    poses[1:, :, 1] = [[1.02, 0.15, 0.0], [1.9, 0.45, 1e-9]]
    ones, no_centres = np.ones(2), np.empty((0, 2, 2))
    planes, logs = draws.landmarks_and_log_density(problem, poses, no_centres, ones)
    W = unpack(problem.information)
    by_quadrature = []
    for m in range(2):
        root = np.linalg.cholesky(unpack(planes[0, 3:, m]))
        axis = np.linspace(-6, 6, 41)
        grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3) @ root.T
        e = (
            grid
            + planes[0, :3, m]
            - np.array(
                [stereo.to_map(poses[1 + o, :, m], problem.positions[[o]])[0] for o in range(2)]
            )[:, None]
        )
        squared = np.einsum("ogi,oij,ogj->g", e, W, e)
        volume = np.linalg.det(root)
        odometry = np.sum(odometry_residuals(problem, poses[:, :, m]) ** 2)
        by_quadrature.append(np.log(np.sum(np.exp(-0.5 * squared)) * volume) - 0.5 * odometry)
    assert logs[1] - logs[0] == pytest.approx(by_quadrature[1] - by_quadrature[0], abs=1e-6)


def test_paths_of_a_linear_world_weigh_the_same():
    """Headings known: the posterior is the Gaussian."""
    problem = straight(poses=30, landmarks=12)
    found = smooth(problem, np.zeros((30, 3)))
    paths, centres, drawn_logs = drawn(problem, found, 200)
    _, logs = draws.landmarks_and_log_density(problem, paths, centres, found.weights)
    np.testing.assert_allclose(np.ptp(logs - drawn_logs), 0, atol=1e-4)


def test_single_precision_and_threads(smoothed):
    """Threads change no byte; float32 little, however often the robots have turned around."""
    problem, found = smoothed
    paths, centres, _ = drawn(problem, found, 600)
    paths[:, 2] += 100 * np.pi
    planes, logs = draws.landmarks_and_log_density(problem, paths, centres, found.weights)
    results = [
        draws.landmarks_and_log_density(problem, paths, centres, found.weights, np.float32, threads)
        for threads in (1, 2, 3)
    ]
    assert len({(p.tobytes(), log.tobytes()) for p, log in results}) == 1
    single, single_logs = results[0]
    assert single.dtype == np.float32
    assert np.std(single_logs - logs) < 0.01
    errors = np.abs(single - planes)[:, :3] / np.sqrt(planes[:, [3, 6, 8]])
    assert errors.max() < 1e-2


def test_several_paths_weigh_as_each_alone(smoothed):
    problem, found = smoothed
    paths, centres, _ = drawn(problem, found, 5)
    together, logs = draws.landmarks_and_log_density(problem, paths, centres, found.weights)
    for m in range(5):
        one = paths[:, :, m : m + 1], centres[:, :, m : m + 1]
        alone, log = draws.landmarks_and_log_density(problem, *one, found.weights)
        np.testing.assert_array_equal(together[:, :, [m]], alone)
        assert log[0] == pytest.approx(logs[m], rel=1e-12)
