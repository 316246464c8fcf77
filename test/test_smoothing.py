"""Batch smoothing against exact answers, against other solvers, and against the filter itself."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
import worlds
from hypothesis import given
from hypothesis import strategies as st
from threadpoolctl import threadpool_limits

from multi_robot_slam.filter import rbpf, smoothing
from multi_robot_slam.filter.motion import wrap
from multi_robot_slam.filter.smoothing import Problem, smooth

GATE = 11.345


def filtered(seed=0, steps=12, robots=3, particles=8, **changes):
    """The filter's state after a drive, with double precision."""
    settings = worlds.settings(particles=particles, **changes)
    state = rbpf.init(worlds.START[:robots], settings, np.float64)
    rng = np.random.default_rng(seed)
    for frames in worlds.drive(seed, steps, robots):
        rbpf.step(state, frames, settings, worlds.MOUNT, rng)
    return state, settings


def posed(state, settings, particle=0):
    """The problem of a particle's history, and the particle's path (P, 3)."""
    lineage = list(state.history.lineage(particle))[::-1]
    records = [record for record, _ in lineage]
    identities = [record.matches[:, row] for record, row in lineage]
    start = worlds.START[: state.poses.shape[0]]
    problem = smoothing.problem_of(records, identities, start, settings.motion, worlds.MOUNT)
    return problem, np.array([record.poses[:, row] for record, row in lineage])


@pytest.fixture(scope="module")
def drive():
    return posed(*filtered())


def straight(seed=0, poses=6, landmarks=4):
    """A linear world: one robot whose heading is known, and its true landmarks (N, 3)."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(2, 8, (landmarks, 3))
    path = np.cumsum(np.array([1.0, 0.2]) + rng.normal(0, 0.1, (poses, 2)), axis=0)
    seen_from = np.tile(np.arange(poses), landmarks)
    truth = np.repeat(places, poses, axis=0) - np.pad(path, ((0, 0), (0, 1)))[seen_from]
    roots = rng.normal(0, 0.1, (len(truth), 3, 3)) + 0.1 * np.eye(3)
    R = roots @ roots.transpose(0, 2, 1) + 1e-3 * np.eye(3)
    noise = (np.linalg.cholesky(R) @ rng.standard_normal((len(truth), 3, 1)))[:, :, 0]
    return Problem(
        start_poses=np.zeros((1, 3)),
        robots=np.zeros(poses, int),
        previous=np.arange(poses) - 1,
        motions=np.tile([1.0, 0.2, 0.0], (poses, 1)),
        sigmas=np.tile([0.1, 0.2, 1e-9], (poses, 1)),
        seen_from=seen_from,
        starts=poses * np.arange(landmarks + 1),
        positions=truth + noise,
        information=smoothing.stereo.pack(np.linalg.inv(R)),
        ids=np.arange(landmarks),
    )


def dense(problem):
    """Mean and covariance of all x, y and landmarks of a straight world by least squares."""
    poses, landmarks = len(problem.robots), len(problem.ids)
    rows, values = [], []
    for p in range(poses):
        A = np.zeros((2, 2 * poses + 3 * landmarks))
        A[:, 2 * p : 2 * p + 2] = np.eye(2)
        if p:
            A[:, 2 * p - 2 : 2 * p] = -np.eye(2)
        rows.append(A / problem.sigmas[p, :2, None])
        values.append(problem.motions[p, :2] / problem.sigmas[p, :2])
    W = smoothing.stereo.unpack(problem.information)
    for o, landmark in enumerate(problem.landmarks):
        A = np.zeros((3, 2 * poses + 3 * landmarks))
        A[:2, 2 * problem.seen_from[o] : 2 * problem.seen_from[o] + 2] = -np.eye(2)
        A[:, 2 * poses + 3 * landmark : 2 * poses + 3 * landmark + 3] = np.eye(3)
        root = np.linalg.cholesky(W[o]).T
        rows.append(root @ A)
        values.append(root @ problem.positions[o])
    A, b = np.concatenate(rows), np.concatenate(values)
    covariance = np.linalg.inv(A.T @ A)
    return covariance @ A.T @ b, covariance


def test_linear_world_is_solved_exactly():
    problem = straight()
    mean, covariance = dense(problem)
    found = smooth(problem, np.zeros((6, 3)))
    assert found.converged
    np.testing.assert_allclose(found.poses[:, :2].ravel(), mean[:12], atol=1e-9)
    np.testing.assert_allclose(found.landmarks[:, :3].ravel(), mean[12:], atol=1e-9)
    H = found.factor @ found.factor.T
    xy = np.arange(18).reshape(6, 3)[:, :2].ravel()
    np.testing.assert_allclose(np.linalg.inv(H)[np.ix_(xy, xy)], covariance[:12, :12], atol=1e-9)
    Y = smoothing.landmark_deviations(problem, found).reshape(12, -1)
    marginal = Y @ Y.T
    for n, given_poses in enumerate(smoothing.stereo.unpack(found.landmarks[:, 3:])):
        marginal[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] += given_poses
    np.testing.assert_allclose(marginal, covariance[12:, 12:], atol=1e-9)


def cost(problem, poses):
    ones = np.ones(len(problem.positions))
    _, squared = smoothing._landmarks_and_distances(problem, poses, ones)
    return smoothing._cost(problem, poses, squared, np.inf)


def test_gradient_is_the_finite_difference(drive):
    problem, poses = drive
    poses = poses + np.random.default_rng(0).normal(0, 0.01, poses.shape)
    ones = np.ones(len(problem.positions))
    landmarks, _ = smoothing._landmarks_and_distances(problem, poses, ones)
    _, gradient = smoothing._factorise(problem, poses, landmarks, ones)
    for index in range(9, poses.size, 7):
        step = np.zeros(poses.size)
        step[index] = 1e-6
        step = step.reshape(-1, 3)
        numeric = (cost(problem, poses + step) - cost(problem, poses - step)) / 2e-6
        assert gradient[index] == pytest.approx(numeric, rel=1e-4, abs=1e-2)


def gtsam_twin(problem, poses, landmarks):
    """The same optimum found by gtsam from its own geometry, with numeric Jacobians."""
    L = gtsam.symbol_shorthand.L
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for p, pose in enumerate(poses):
        values.insert(p, gtsam.Pose2(*pose))
    for n, place in enumerate(landmarks[:, :3]):
        values.insert(L(n), place)

    def add(noise, keys, residual):
        """A factor whose residual is a function of its poses, and of a landmark at the end."""

        def error(_, values, jacobians):
            got = [values.atPoint3(k) if k >= L(0) else values.atPose2(k) for k in keys]
            if jacobians is not None:
                for i, variable in enumerate(got):
                    jacobians[i] = numeric(residual, got, i, variable)
            return residual(*got)

        graph.add(gtsam.CustomFactor(noise, keys, error))

    for p, u in enumerate(problem.motions):
        noise = gtsam.noiseModel.Diagonal.Sigmas(problem.sigmas[p])
        if problem.previous[p] < 0:
            start = gtsam.Pose2(*problem.start_poses[problem.robots[p]])
            add(noise, [p], lambda b, u=u, a=start: moved(a, b, u))
        else:
            add(noise, [problem.previous[p], p], lambda a, b, u=u: moved(a, b, u))
    R = np.linalg.inv(smoothing.stereo.unpack(problem.information))
    for o, n in enumerate(problem.landmarks):
        noise = gtsam.noiseModel.Gaussian.Covariance(R[o])
        add(noise, [problem.seen_from[o], L(n)], lambda x, m, v=problem.positions[o]: seen(x, m, v))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    at = [found.atPose2(p) for p in range(len(poses))]
    places = [found.atPoint3(L(n)) for n in range(len(landmarks))]
    return np.array([[x.x(), x.y(), x.theta()] for x in at]), np.array(places), graph.error(found)


def moved(a, b, u):
    between = a.between(b)
    return np.array([between.x() - u[0], between.y() - u[1], wrap(between.theta() - u[2])])


def seen(pose, place, v):
    return np.append(pose.transformTo(place[:2]), place[2]) - v


def numeric(residual, arguments, index, variable):
    def at(step):
        shifted = variable.retract(step) if isinstance(variable, gtsam.Pose2) else variable + step
        return residual(*arguments[:index], shifted, *arguments[index + 1 :])

    steps = 1e-6 * np.eye(3)
    return np.asfortranarray(np.column_stack([(at(s) - at(-s)) / 2e-6 for s in steps]))


def test_optimum_is_that_of_gtsam(drive):
    problem, poses = drive
    found = smooth(problem, poses)
    twin, places, error = gtsam_twin(problem, poses, found.landmarks)
    assert found.cost == pytest.approx(error, abs=1e-5)
    assert cost(problem, poses) > error + 1
    difference = found.poses - twin
    np.testing.assert_allclose(difference[:, :2], 0, atol=1e-4)
    np.testing.assert_allclose(wrap(difference[:, 2]), 0, atol=1e-4)
    np.testing.assert_allclose(found.landmarks[:, :3], places, atol=1e-4)


@pytest.mark.parametrize("robust_above", [np.inf, GATE])
def test_the_start_of_the_search_does_not_matter(drive, robust_above):
    problem, poses = drive
    found = smooth(problem, poses, robust_above)
    far = poses + np.random.default_rng(1).normal(0, 0.1, poses.shape)
    again = smooth(problem, far, robust_above)
    assert found.converged
    assert again.converged
    assert again.cost == pytest.approx(found.cost, rel=1e-6)
    np.testing.assert_allclose(again.poses, found.poses, atol=1e-4)


def test_drawn_paths_have_the_covariance_of_the_optimum(drive):
    problem, poses = drive
    found = smooth(problem, poses)
    normals = np.random.default_rng(2).standard_normal((found.poses.size, 4000))
    deviations = (smoothing.draw(found, normals) - found.poses[:, :, None]).reshape(normals.shape)
    covariance = np.linalg.inv(found.factor @ found.factor.T)
    sigma = np.sqrt(np.diag(covariance))
    sample = np.cov(deviations) / np.outer(sigma, sigma)
    expected = covariance / np.outer(sigma, sigma)
    # The standard error of a correlation is at most sqrt(2 / 4000); the largest of 5,000 is 4.5.
    np.testing.assert_allclose(sample, expected, atol=4.5 * np.sqrt(2 / 4000))


@pytest.mark.parametrize("proposal", ["motion", "informed"])
def test_landmarks_given_its_path_are_the_particle_s(proposal):
    """Every particle's EKFs, one observation after the other, hold what the sums hold."""
    state, settings = filtered(seed=3, proposal=proposal, particles=5)
    for m in range(5):
        problem, path = posed(state, settings, m)
        planes = smoothing.landmarks_given_paths(problem, path[:, :, None])
        columns, values = state.landmarks.of_particle(m)
        assert problem.ids.tolist() == state.landmarks.ids[columns].tolist()
        np.testing.assert_allclose(planes[:, :, 0], values, rtol=1e-7, atol=1e-10)


def test_several_paths_are_rebuilt_as_each_alone(drive):
    problem, path = drive
    paths = path[:, :, None] + np.random.default_rng(4).normal(0, 0.1, (*path.shape, 7))
    together = smoothing.landmarks_given_paths(problem, paths)
    for m in range(7):
        alone = smoothing.landmarks_given_paths(problem, paths[:, :, m : m + 1])
        np.testing.assert_allclose(together[:, :, m], alone[:, :, 0], rtol=1e-12)


def test_wrong_associations_are_resisted():
    problem = straight(seed=5, poses=20, landmarks=8)
    right = smooth(problem, np.zeros((20, 3)))
    wrong = problem.positions.copy()
    planted = [3, 50, 51, 120]
    wrong[planted] += [2.0, -1.5, 0.5]
    fooled = replace(problem, positions=wrong)
    plain, robust = smooth(fooled, right.poses), smooth(fooled, right.poses, GATE)
    spread = np.sqrt(np.linalg.inv(right.factor @ right.factor.T)[0, 0])
    assert robust.weights[planted].max() < np.delete(robust.weights, planted).min()
    assert np.abs(robust.poses - right.poses).max() < spread
    assert np.abs(plain.poses - right.poses).max() > spread


@given(st.floats(0, 1e4), st.floats(0.1, 100))
def test_robust_weight_is_the_derivative_of_the_robust_distance(squared, threshold):
    step = 1e-5 * max(1, squared)
    above, below = (smoothing._robust(np.array([squared + s]), threshold)[0] for s in (step, -step))
    weight = smoothing._robust_weights(np.array([squared]), threshold)[0]
    assert (above - below) / (2 * step) == pytest.approx(weight, abs=1e-3)


def test_standing_still_and_seeing_nothing_is_a_known_pose():
    state, settings = filtered(steps=1, robots=1)
    problem, poses = posed(state, settings)
    blind = replace(
        problem,
        seen_from=problem.seen_from[:0],
        starts=problem.starts[:1],
        positions=problem.positions[:0],
        information=problem.information[:0],
        ids=problem.ids[:0],
    )
    for each in (problem, blind):
        found = smooth(each, poses + 0.1)
        np.testing.assert_allclose(found.poses, worlds.START[:1], atol=1e-6)
        assert smoothing.landmark_deviations(each, found).shape == (len(each.ids), 3, 3)


def test_threads_of_the_linear_algebra_change_no_byte():
    problem, poses = posed(*filtered(steps=60))
    results = []
    for threads in (1, 2):
        with threadpool_limits(threads):
            found = smooth(problem, poses, GATE)
            results.append((found.poses.tobytes(), found.factor.tobytes()))
    assert results[0] == results[1]
