"""Variance components: against full matrices, and against worlds whose noise is known."""

from dataclasses import replace

import drives
import numpy as np
import pytest
import worlds
from scipy.optimize import minimize

from multi_robot_slam.filter import rejuvenation
from multi_robot_slam.filter.running import ParticleFilter
from multi_robot_slam.filter.settings import RejuvenationSettings
from multi_robot_slam.models.ranging import at_landmarks
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.smoothing import noise_factors, odometry_scale, solve
from multi_robot_slam.smoothing.cost import odometry_residuals
from multi_robot_slam.smoothing.noise_factors import LEAST_USED, NoiseFactors
from multi_robot_slam.smoothing.odometry_scale import Scales


def dense(problem, smoothed):
    """Of n whitened residuals the groups (n,), -1 of the prior, values (n,) and Jacobian (n, U).

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
    return groups, residuals(at), jacobian


def dense_matrix(problem, smoothed):
    """S, with the prior's share on the diagonal, and the redundancy of every residual."""
    groups, _, jacobian = dense(problem, smoothed)
    rest = np.eye(len(jacobian)) - jacobian @ np.linalg.pinv(jacobian)
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


def linear(seed, poses=8, factors=(1.0, 1.0)):
    """A `drives.straight` world whose noise is `factors` times as large as it is told."""
    problem = drives.straight(seed, poses)
    problem = replace(problem, sigmas=np.tile([0.1, 0.1, 1e-4], (poses, 1)))
    return with_noise(problem, 1 / np.array([factors]))


def with_noise(problem, used):
    """The problem with `used` (1, 2) times the standard deviations of odometry, observations."""
    information = problem.information / used[0, 1] ** 2
    return replace(problem, sigmas=problem.sigmas * used[0, 0], information=information)


def iterated(problem, limit=np.inf, draws=64, rounds=8):
    """The factors when each round's problem goes by what the round before found."""
    noise = NoiseFactors.as_told(1)
    for _ in range(rounds):
        used = with_noise(problem, noise.used)
        smoothed = solve.smooth(used, np.zeros((len(problem.previous), 3)))
        shares = noise_factors.shares_of(used, smoothed, draws)
        noise = noise_factors.learn(noise, used, smoothed, shares, 0, limit, is_used=False)
        noise = noise._replace(used=noise.factors.clip(noise.used / 2, noise.used * 2))
    return noise


def whole_residuals(monkeypatch):
    """Nothing is known before, and all residuals count."""
    monkeypatch.setattr(noise_factors, "TOLD", 1e-9)
    monkeypatch.setattr(noise_factors, "INSIDE", 1 - 1e-12)


def restricted_likelihood(problem):
    """Factors (2,) of largest restricted likelihood, by full matrices."""
    smoothed = solve.smooth(problem, np.zeros((len(problem.previous), 3)))
    groups, residuals, jacobian = dense(problem, smoothed)

    def neg2_log_likelihood(log_variances):
        variances = np.append(np.exp(log_variances), 1.0)[groups]
        information = jacobian.T @ (jacobian / variances[:, None])
        score = jacobian.T @ (residuals / variances)
        quadratic = residuals**2 @ (1 / variances) - score @ np.linalg.solve(information, score)
        return np.log(variances).sum() + np.linalg.slogdet(information)[1] + quadratic

    best = minimize(neg2_log_likelihood, np.zeros(2), method="Nelder-Mead", tol=1e-8)
    return np.exp(best.x / 2)


@pytest.mark.parametrize("factors", [(1.0, 1.0), (2.5, 0.5), (0.5, 2.0)])
def test_factors_are_those_of_restricted_likelihood(monkeypatch, factors):
    whole_residuals(monkeypatch)
    problem = linear(seed=3, factors=factors)
    found = iterated(problem, draws=3000)
    np.testing.assert_allclose(found.factors[0], restricted_likelihood(problem), rtol=0.01)


@pytest.mark.parametrize("factors", [(1.0, 1.0), (2.5, 0.5)])
def test_variances_are_right_on_average_and_as_certain_as_they_say(factors):
    relative, redundancies = [], []
    for seed in range(40):
        noise = iterated(linear(seed, poses=20, factors=factors), rounds=5)
        relative.append((noise.factors[0] / factors) ** 2)
        redundancies.append(noise.redundancies[0])
    # What was told pulls, as TOLD degrees of freedom.
    r = np.mean(redundancies, axis=0)
    pull = noise_factors.TOLD / (r + noise_factors.TOLD) * (1 / np.square(factors) - 1)
    error = np.std(relative, axis=0) / np.sqrt(len(relative))
    np.testing.assert_array_less(abs(np.mean(relative, axis=0) - 1 - pull), 3.5 * error)
    np.testing.assert_allclose(np.std(relative, axis=0), np.sqrt(2 / r), rtol=0.4)


def test_one_round_says_the_same_whatever_was_told(monkeypatch):
    """Helmert's equations hold for any weights: so what is not used can be told all the same."""
    whole_residuals(monkeypatch)
    found = [iterated(linear(seed, 20, (2.0, 0.7)), rounds=1).factors[0] ** 2 for seed in range(60)]
    error = np.std(found, axis=0) / np.sqrt(len(found))
    np.testing.assert_array_less(abs(np.mean(found, axis=0) - [4.0, 0.49]), 3.5 * error)


@pytest.mark.parametrize("variance", [0.3, 1.0, 4.0])
def test_what_is_cut_off_is_allowed_for(variance):
    rng, found = np.random.default_rng(0), []
    for _ in range(50):
        squares = variance * rng.chisquare(3, 1000)
        squares = squares[squares < 11.345]
        redundancies = rng.uniform(0.2, 1, len(squares))
        squares = squares * redundancies
        found.append(noise_factors.truncated_variance(squares, redundancies, 3, 11.345))
    found, inside = np.array(found).T
    np.testing.assert_allclose(found.mean(), variance, rtol=0.05)
    freedom = 3 * 0.6 * 1000 * {0.3: 1.0, 1.0: 0.99, 4.0: 0.585}[variance] / 0.6
    np.testing.assert_allclose(
        found.std() / variance, np.sqrt(2 / (inside * freedom)).mean(), rtol=0.3
    )


def test_slips_and_gross_errors_are_no_noise():
    rng = np.random.default_rng(0)
    squares = rng.chisquare(1, 600)
    squares[::50] = 400.0
    variance, inside = noise_factors.truncated_variance(squares, np.ones(600), 1, np.inf)
    np.testing.assert_allclose(variance, 1, atol=0.25)  # without: 9
    assert inside == 1


def test_what_leaves_counts_once():
    problem = linear(seed=1, poses=20)
    smoothed = solve.smooth(problem, np.zeros((20, 3)))
    shares = noise_factors.shares_of(problem, smoothed)
    told = NoiseFactors.as_told(1)
    parts = [
        noise_factors.learn(told, problem, smoothed, shares, leaving, np.inf, is_used=False)
        for leaving in (0, 5, 20)
    ]
    assert (parts[0].equations == 0).all()
    assert (parts[0].sums == 0).all()
    np.testing.assert_allclose(parts[1].equations, parts[2].equations / 4)
    # All that has left, and nothing in the window: the same factors.
    total = parts[2].equations + noise_factors.TOLD * np.eye(2)
    variances = np.linalg.solve(total, parts[2].sums + noise_factors.TOLD)
    np.testing.assert_allclose(np.sqrt(variances), parts[0].factors[0])
    assert (parts[0].used == 1).all()


ALL = RejuvenationSettings(ancestors_below=0.5, delay_s=0)


def run_of(steps, seed=0, rejuvenation=ALL, **changes):
    settings = worlds.settings(
        particles=50, proposal="informed", resample_below=0.5, rejuvenation=rejuvenation, **changes
    )
    particles = ParticleFilter(worlds.START, settings, np.random.default_rng(seed))
    for frames in steps:
        particles.step(frames)
    return particles.state


def told_too_little(steps, robot, factor):
    """The frames with covariances of one robot that are too small by `factor` squared."""
    return [
        [replace(f, covariances=f.covariances / factor**2) if f.robot == robot else f for f in step]
        for step in steps
    ]


def test_each_robot_has_its_own_noise_and_the_gate_opens():
    steps = told_too_little(worlds.drive(0, steps=50), robot=1, factor=2.5)
    noise = run_of(steps, learn_noise=True).noise
    np.testing.assert_allclose(noise.factors[:, 1], [1, 2.5, 1], rtol=0.1)
    assert (noise.factors[:, 0] < 0.8).all()  # `drive` has less noise than `worlds.settings` say
    np.testing.assert_array_equal(noise.used, noise.factors.clip(min=LEAST_USED))
    assert (noise.used[:, 0] == 1).all()


def test_settled_frames_are_not_forgotten_and_not_counted_twice():
    steps = worlds.drive(1, steps=80)
    whole = run_of(steps, learn_noise=True).noise
    settling = replace(ALL, unknowns=180)
    state = run_of(steps, rejuvenation=settling, learn_noise=True)
    assert len(state.history.settled) > 100
    np.testing.assert_allclose(state.noise.factors, whole.factors, rtol=0.15)
    np.testing.assert_allclose(state.noise.redundancies, whole.redundancies, rtol=0.25)


def contents(state):
    return [state.poses, state.log_weight_sum, state.prior.covariance, state.noise.used]


@pytest.mark.parametrize("learns", [False, True])
def test_what_is_only_told_changes_nothing_and_neither_do_factors_of_one(monkeypatch, learns):
    steps = worlds.drive(2, steps=40)
    plain = run_of(steps, learn_noise=False)
    assert (plain.noise.used == 1).all()
    assert (plain.noise.factors != 1).all()
    monkeypatch.setattr(
        rejuvenation.noise_factors, "learn", lambda noise, *_: NoiseFactors.as_told(3)
    )
    for own, other in zip(
        contents(plain), contents(run_of(steps, learn_noise=learns)), strict=True
    ):
        np.testing.assert_array_equal(own, other)


def test_same_seed_same_bytes():
    steps = worlds.drive(2, steps=40)
    states = [run_of(steps, learn_noise=True) for _ in range(2)]
    for own, other in zip(*map(contents, states), strict=True):
        np.testing.assert_array_equal(own, other)
    assert (states[0].noise.used != 1).any()


def test_odometry_that_is_not_corrected_is_told():
    steps = [
        [replace(f, motion=f.motion / [0.9, 0.9, 0.95]) for f in step]
        for step in worlds.drive(0, steps=60)
    ]
    state = run_of(steps, rejuvenation=replace(ALL, unknowns=180))
    assert (state.scales.factors == 1).all()
    apart = (state.bias.factors - [0.9, 0.95]) / state.bias.sigmas
    assert np.abs(apart).max() < 4
    assert ((1 - state.bias.factors[:, 0]) / state.bias.sigmas[:, 0] > 3).all()


def test_noise_in_what_was_told_makes_factors_doubtful():
    """Where odometry measures with noise its factor comes out too small, within its deviation."""
    apart = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        problem = drives.straight(seed, poses=30)
        motions = problem.motions + np.pad(rng.normal(0, 0.6, (30, 2)), ((0, 0), (0, 1)))
        problem = replace(
            problem,
            motions=motions,
            sigmas=np.tile([0.6, 0.6, 2e-5], (30, 1)),
        )
        smoothed = solve.smooth(problem, np.zeros((30, 3)))
        scales = Scales.unknown(1, odometry_scale.VAGUE)
        learnt = odometry_scale.learn(scales, problem, smoothed, motions, fixed=0.0)
        shares = noise_factors.shares_of(problem, smoothed)
        doubted = odometry_scale.doubted(learnt, problem, motions, shares.redundancies[0])
        apart.append([1 - learnt.factors[0, 0], learnt.sigmas[0, 0], doubted.sigmas[0, 0]])
    missing, sigma, doubt = np.mean(apart, axis=0)
    assert missing > 2 * sigma / np.sqrt(30)
    np.testing.assert_allclose(missing, np.sqrt(doubt**2 - sigma**2), rtol=0.3)


def test_noise_at_the_landmark_grows_by_the_same_factor():
    frame = worlds.drive(0, steps=2)[1][0]
    noisier, offsets = frame.with_noise(3.0), 0.05 * frame.positions
    own, other = (at_landmarks(f.covariances, *f.ranging, offsets) for f in (frame, noisier))
    assert (own != frame.covariances).any()
    np.testing.assert_allclose(other, 9 * own)
