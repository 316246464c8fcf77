"""Batch smoothing against exact answers, against other solvers, and against the filter itself."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
import worlds
from drives import GATE, covariance_of, filtered, later, posed, remembered, straight, with_hubs
from hypothesis import given
from hypothesis import strategies as st
from threadpoolctl import threadpool_limits

from multi_robot_slam.models.motion import wrap
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.smoothing import cost, linearised, marginals, solve
from multi_robot_slam.smoothing.cost import landmarks_and_distances
from multi_robot_slam.smoothing.envelope import envelope_of, factorise
from multi_robot_slam.smoothing.prior import SMALLEST_SIGMA, Prior
from multi_robot_slam.smoothing.problem import problem_of, views_of
from multi_robot_slam.smoothing.solve import SmoothingError, smooth


@pytest.fixture(scope="module", params=[False, True], ids=["alone", "sighted"])
def drive(request):
    return posed(*filtered(steps=18), sighted=request.param)


def matrix(envelope, elements):
    """The symmetric matrix (3 P, 3 P), in the order of elimination, that `elements` are of."""
    size = envelope.edges[-1]
    lower = np.zeros((size, size))
    for t, begin in enumerate(envelope.begins):
        start, stop = envelope.edges[t : t + 2]
        tile = elements[slice(*envelope.layout.offsets[t : t + 2])]
        lower[start:stop, begin:stop] = tile.reshape(stop - begin, stop - start).T
    return np.tril(lower) + np.tril(lower, -1).T


def weights_of_one(problem):
    return np.ones(len(problem.positions) + len(problem.sighted.seen))


def dense(problem):
    """Mean and covariance of all x, y and landmarks of a straight world by least squares."""
    poses, landmarks = len(problem.motions), len(problem.ids)
    rows, values = [], []
    for p in range(poses):
        A = np.zeros((2, 2 * poses + 3 * landmarks))
        A[:, 2 * p : 2 * p + 2] = np.eye(2)
        if p:
            A[:, 2 * p - 2 : 2 * p] = -np.eye(2)
        rows.append(A / problem.sigmas[p, :2, None])
        values.append(problem.motions[p, :2] / problem.sigmas[p, :2])
    W = unpack(problem.information)
    for o, landmark in enumerate(problem.landmarks):
        A = np.zeros((3, 2 * poses + 3 * landmarks))
        first = 2 * (problem.seen_from[o] - 1)
        A[:2, first : first + 2] = -np.eye(2)
        A[:, 2 * poses + 3 * landmark : 2 * poses + 3 * landmark + 3] = np.eye(3)
        root = np.linalg.cholesky(W[o]).T
        rows.append(root @ A)
        values.append(root @ problem.positions[o])
    A, b = np.concatenate(rows), np.concatenate(values)
    covariance = np.linalg.inv(A.T @ A)
    return covariance @ A.T @ b, covariance


@pytest.mark.parametrize("share", [0, 0.5, 1])
def test_linear_world_is_solved_exactly(monkeypatch, share):
    with_hubs(monkeypatch, share)
    problem = straight()
    mean, covariance = dense(problem)
    found = smooth(problem, np.zeros((6, 3)))
    np.testing.assert_allclose(found.of_records[:, :2].ravel(), mean[:12], atol=1e-9)
    np.testing.assert_allclose(found.landmarks[:, :3].ravel(), mean[12:], atol=1e-9)
    xy = np.arange(18).reshape(6, 3)[:, :2].ravel()
    of_poses = covariance_of(found)[np.ix_(xy, xy)]
    np.testing.assert_allclose(of_poses, covariance[:12, :12], atol=1e-9)
    Y = marginals.landmark_deviations(problem, found).reshape(12, -1)
    chosen = marginals.landmark_deviations(problem, found, np.array([2, 0]))
    np.testing.assert_allclose(chosen, Y.reshape(4, 3, -1)[[2, 0]], rtol=1e-12, atol=1e-15)
    marginal = Y @ Y.T
    for n, given_poses in enumerate(unpack(found.landmarks[:, 3:])):
        marginal[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] += given_poses
    np.testing.assert_allclose(marginal, covariance[12:, 12:], atol=1e-9)


def plain_cost(problem, views):
    _, squared = landmarks_and_distances(problem, views, weights_of_one(problem))
    return cost.cost(problem, views, squared, np.inf)


def at(problem, poses):
    """The views of records' poses, with anchors and centres as they were known before."""
    poses = np.concatenate([problem.prior.poses, poses])
    return views_of(poses, problem.prior.centres)


def nearby(problem, poses, seed):
    """Views around `poses`, anchors and centres within their uncertainty."""
    views = at(problem, poses)
    rng = np.random.default_rng(seed)
    step = rng.normal(0, 0.01, problem.columns[-1])
    known = np.linalg.cholesky(np.linalg.inv(problem.prior.information))
    step[problem.prior_columns] = 0.1 * known @ rng.standard_normal(len(known))
    return views + by_view(problem, step)


def by_view(problem, step):
    poses, centres = np.split(step, [3 * problem.poses])
    return views_of(poses.reshape(-1, 3), centres.reshape(-1, 2))


@pytest.mark.parametrize("with_centres", [False, True])
def test_gradient_is_the_finite_difference(drive, with_centres):
    problem, poses = later() if with_centres else drive
    views, ones = nearby(problem, poses, 0), weights_of_one(problem)
    landmarks, _ = landmarks_and_distances(problem, views, ones)
    gradient = linearised.gradient_of(problem, views, landmarks, ones)
    for index in range(9, len(gradient), 7):
        step = np.zeros(len(gradient))
        step[index] = 1e-6
        step = by_view(problem, step)
        numeric = (plain_cost(problem, views + step) - plain_cost(problem, views - step)) / 2e-6
        assert gradient[index] == pytest.approx(numeric, rel=1e-4, abs=1e-2)


@pytest.mark.parametrize("hubs", [[], [3, 8, 30]], ids=["none", "three"])
def test_information_is_the_difference_of_the_gradient_at_the_optimum(hubs):
    """Of Gauss-Newton's where residuals vanish: those of a problem that fits its optimum."""
    problem, poses = later()
    ones, views = weights_of_one(problem), smooth(problem, poses).views
    problem = fitted(problem, views)
    envelope = envelope_of(problem, np.array(hubs, int))
    landmarks, squared = landmarks_and_distances(problem, views, ones)
    assert squared.max() < 1e-12
    elements = linearised.information_of(problem, views, landmarks, ones, envelope)
    H = matrix(envelope, elements)[np.ix_(envelope.places, envelope.places)]
    known, out = np.split(np.arange(len(H)), [problem.columns[-1]])
    H = H[np.ix_(known, known)] - H[np.ix_(known, out)] @ np.linalg.solve(
        H[np.ix_(out, out)], H[np.ix_(out, known)]
    )
    scale = np.sqrt(np.diag(H))
    for index in range(0, len(H), 5):
        step = np.zeros(len(H))
        step[index] = 1e-3 / scale[index]
        numeric = []
        for sign in (1, -1):
            moved = views + by_view(problem, sign * step)
            landmarks, _ = landmarks_and_distances(problem, moved, ones)
            numeric.append(linearised.gradient_of(problem, moved, landmarks, ones))
        difference = (numeric[0] - numeric[1]) / (2 * step[index])
        np.testing.assert_allclose(
            difference / scale / scale[index], H[index] / scale / scale[index], atol=1e-5
        )


def fitted(problem, views):
    """The problem had all measurements been what `views` and the landmarks there imply."""
    landmarks, _ = landmarks_and_distances(problem, views, weights_of_one(problem))
    seen_by, own = views[problem.seen_from], landmarks[problem.landmarks, :3]
    apart = own - np.pad(seen_by[:, :2], ((0, 0), (0, 1)))
    cos, sin = np.cos(seen_by[:, 2]), np.sin(seen_by[:, 2])
    x, y, z = apart.T
    positions = np.column_stack([cos * x + sin * y, cos * y - sin * x, z])
    of_centre = problem.seen_from >= problem.poses
    centres = problem.prior.centres.copy()
    centres[problem.seen_from[of_centre] - problem.poses] = own[of_centre]
    positions[of_centre, :2] = 0
    views[problem.poses :, :2] = centres[:, :2]
    motions = problem.motions + problem.sigmas * cost.odometry_residuals(problem, views)
    known = problem.prior._replace(poses=views[: len(problem.anchors)].copy(), centres=centres)
    return replace(problem, prior=known, motions=motions, positions=positions)


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

    for p, start in enumerate(problem.prior.poses):
        noise = gtsam.noiseModel.Isotropic.Sigma(3, SMALLEST_SIGMA)
        anchor = gtsam.Pose2(*start)
        add(noise, [p], lambda b, a=anchor: moved(a, b, np.zeros(3)))
    for p, u in enumerate(problem.motions):
        noise = gtsam.noiseModel.Diagonal.Sigmas(problem.sigmas[p])
        ends = [problem.previous[p], len(problem.anchors) + p]
        add(noise, ends, lambda a, b, u=u: moved(a, b, u))
    R = np.linalg.inv(unpack(problem.information))
    for o, n in enumerate(problem.landmarks):
        noise = gtsam.noiseModel.Gaussian.Covariance(R[o])
        add(noise, [problem.seen_from[o], L(n)], lambda x, m, v=problem.positions[o]: seen(x, m, v))
    R = np.linalg.inv(problem.sighted.information[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
    for p, q, s, covariance in zip(*problem.sighted[:3], R, strict=True):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        add(noise, [p, q], lambda a, b, s=s: a.transformTo(b.translation()) - s)
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
    twin, places, error = gtsam_twin(problem, at(problem, poses), found.landmarks)
    assert found.cost == pytest.approx(error, abs=1e-5)
    assert plain_cost(problem, at(problem, poses)) > error + 1
    difference = found.poses - twin
    np.testing.assert_allclose(difference[:, :2], 0, atol=1e-4)
    np.testing.assert_allclose(wrap(difference[:, 2]), 0, atol=1e-4)
    np.testing.assert_allclose(found.landmarks[:, :3], places, atol=1e-4)


@pytest.mark.parametrize("hubs", [[], [3, 8, 30]], ids=["none", "three"])
def test_factor_inside_the_envelope_is_that_of_the_whole_matrix(drive, hubs):
    problem, poses = drive
    ones, envelope = weights_of_one(problem), envelope_of(problem, np.array(hubs, int))
    views = at(problem, poses)
    landmarks, _ = landmarks_and_distances(problem, views, ones)
    elements = linearised.information_of(problem, views, landmarks, ones, envelope)
    H = matrix(envelope, elements)
    factor = factorise(envelope, elements)
    assert len(envelope.begins) == 3
    right = np.random.default_rng(0).standard_normal((len(H), 4))
    rows, known = np.argsort(envelope.places), 3 * problem.poses
    of_poses = np.where(np.arange(len(H))[:, None] < known, right, 0)
    lower = np.linalg.solve(np.linalg.cholesky(H), of_poses[rows])
    upper = np.linalg.solve(np.linalg.cholesky(H).T, right)
    np.testing.assert_allclose(factor.solve_lower(right[:known]), lower, atol=1e-9)
    np.testing.assert_allclose(factor.solve_upper(right)[rows], upper, atol=1e-9)


def test_envelope_follows_a_long_corridor():
    """Landmarks seen by neighbours only: a band, whatever the order of the poses."""
    poses, landmarks = 300, 299
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(poses)
    seen_from = np.sort(np.stack([shuffled[:-1], shuffled[1:]], axis=1), axis=1).ravel()
    corridor = replace(
        straight(poses=2, landmarks=landmarks),
        robots=np.zeros(1 + poses, int),
        previous=np.append(0, 1 + shuffled[:-1])[np.argsort(shuffled)],
        seen_from=1 + seen_from,
    )
    # Tiles of 96 rows reach back one tile: 10 (96^2 + 96^2) of 900^2 / 2 elements at most.
    assert envelope_of(corridor, np.empty(0, int)).size < 0.45 * (3 * poses) ** 2 / 2


@pytest.mark.parametrize("robust_above", [np.inf, GATE])
@pytest.mark.parametrize("share", [0.3, 1])
def test_hubs_change_nothing(drive, robust_above, share, monkeypatch):
    problem, poses = drive
    expected = smooth(problem, poses, robust_above, smallest_step=1e-6)
    Y = marginals.landmark_deviations(problem, expected).reshape(3 * len(problem.ids), -1)
    with_hubs(monkeypatch, share)
    found = smooth(problem, poses, robust_above, smallest_step=1e-6)
    assert len(found.factor.envelope.hubs) == round(share * len(problem.ids))
    assert found.iterations == expected.iterations
    assert found.cost == pytest.approx(expected.cost, rel=1e-8)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-8)
    np.testing.assert_allclose(found.landmarks, expected.landmarks, atol=1e-8)
    np.testing.assert_allclose(covariance_of(found), covariance_of(expected), atol=1e-10)
    some = marginals.landmark_deviations(problem, found).reshape(3 * len(problem.ids), -1)
    np.testing.assert_allclose(some @ some.T, Y @ Y.T, atol=1e-10)


@pytest.mark.parametrize("robust_above", [np.inf, GATE])
def test_the_start_of_the_search_does_not_matter(drive, robust_above):
    problem, poses = drive
    found = smooth(problem, poses, robust_above)
    far = poses + np.random.default_rng(1).normal(0, 0.1, poses.shape)
    again = smooth(problem, far, robust_above)
    assert again.cost == pytest.approx(found.cost, rel=1e-6)
    np.testing.assert_allclose(again.poses, found.poses, atol=1e-4)


def test_a_start_at_the_optimum_stays_there(drive):
    problem, poses = drive
    found = smooth(problem, poses, GATE, smallest_step=1e-4)
    again = smooth(problem, found.of_records, GATE, smallest_step=1e-4, start=found)
    assert again.iterations < found.iterations
    assert again.cost == pytest.approx(found.cost, rel=1e-8)
    np.testing.assert_allclose(again.views, found.views, atol=1e-6)


def test_a_start_nearby_closes_a_loop_that_one_pose_leaves_open():
    """What it saw is not taken for errors, though all of it is far off."""
    problem = straight(seed=5, poses=20, landmarks=8)
    expected = smooth(problem, np.zeros((20, 3)), GATE)
    far = replace(problem, motions=problem.motions.copy(), sigmas=problem.sigmas.copy())
    far.motions[19] += [3.0, 2.0, 0.0]
    far.sigmas[19, :2] = 0.3
    expected = smooth(far, expected.of_records, GATE)
    begin = expected.of_records.copy()
    begin[19, :2] += [3.0, 2.0]
    found = smooth(far, begin, GATE, start=expected)
    np.testing.assert_allclose(found.poses, expected.poses, atol=1e-3)
    assert found.weights.min() == pytest.approx(expected.weights.min(), abs=0.01)


def test_wrong_associations_are_resisted():
    problem = straight(seed=5, poses=20, landmarks=8)
    right = smooth(problem, np.zeros((20, 3)))
    wrong = problem.positions.copy()
    planted = [3, 50, 51, 120]
    wrong[planted] += [2.0, -1.5, 0.5]
    fooled = replace(problem, positions=wrong)
    plain, robust = smooth(fooled, right.of_records), smooth(fooled, right.of_records, GATE)
    spread = np.sqrt(covariance_of(right)[0, 0])
    assert robust.weights[planted].max() < np.delete(robust.weights, planted).min()
    assert np.abs(robust.poses - right.poses).max() < spread
    assert np.abs(plain.poses - right.poses).max() > spread


@given(st.floats(0, 1e4), st.floats(0.1, 100))
def test_robust_weight_is_the_derivative_of_the_robust_distance(squared, threshold):
    step = 1e-5 * max(1, squared)
    above, below = (cost.robust(squared + s, threshold) for s in (step, -step))
    weight = cost.robust_weights(squared, threshold)
    assert (above - below) / (2 * step) == pytest.approx(weight, abs=1e-3)


def blind(problem):
    """The problem without any observation."""
    return replace(
        problem,
        seen_from=problem.seen_from[:0],
        starts=problem.starts[:1],
        positions=problem.positions[:0],
        information=problem.information[:0],
        ids=problem.ids[:0],
    )


@pytest.mark.parametrize(
    ("name", "value"), [("positions", np.nan), ("positions", 1e200), ("information", -1e6)]
)
def test_problem_that_is_not_finite_says_so(name, value):
    problem = straight(poses=4)
    spoiled = getattr(problem, name).copy()
    spoiled[2] = value
    with pytest.raises(SmoothingError, match="smoothing 4 poses: a step is not finite"):
        smooth(replace(problem, **{name: spoiled}), np.zeros((4, 3)))


def test_problem_that_leaves_a_pose_free_says_so():
    problem = blind(straight(poses=4))
    free = replace(problem, sigmas=np.full((4, 3), np.inf))
    with pytest.raises(SmoothingError, match="the information is not positive definite"):
        smooth(free, np.zeros((4, 3)))


def test_iteration_that_does_not_end_says_so(monkeypatch, drive):
    monkeypatch.setattr(solve, "MAX_ITERATIONS", 2)
    with pytest.raises(SmoothingError, match="no end after 2 steps"):
        smooth(*drive)


def test_standing_still_and_seeing_nothing_is_a_known_pose():
    state, settings = filtered(steps=1, robots=1)
    problem, poses = posed(state, settings)
    for each in (problem, blind(problem)):
        found = smooth(each, poses + 0.1)
        np.testing.assert_allclose(found.of_records, worlds.START[:1], atol=1e-6)
        deviations = marginals.landmark_deviations(each, found)
        assert deviations.shape == (len(each.ids), 3, found.factor.size)
        np.testing.assert_allclose(covariance_of(found), 0, atol=1e-9)


def test_threads_of_the_linear_algebra_change_no_byte():
    problem, poses = posed(*filtered(steps=60))
    results = []
    for threads in (1, 2):
        with threadpool_limits(threads):
            found = smooth(problem, poses, GATE)
            results.append((found.poses.tobytes(), found.factor.elements.tobytes()))
    assert results[0] == results[1]


def test_gross_errors_are_left_out():
    """An identity below zero: as if the observation had never been made."""
    state, settings = filtered(steps=6)
    records, identities, _ = remembered(state)
    discarded = [np.where(np.arange(len(rows)) == 1, -1, rows) for rows in identities]
    without = [
        replace(
            r, positions=np.delete(r.positions, 1, 0), covariances=np.delete(r.covariances, 1, 0)
        )
        for r in records
    ]
    kept = [np.delete(rows, 1) for rows in identities]
    common = (Prior.exact(worlds.START), settings.motion)
    found, expected = problem_of(records, discarded, *common), problem_of(without, kept, *common)
    for name in ("seen_from", "starts", "positions", "information", "ids"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
