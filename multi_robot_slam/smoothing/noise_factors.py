"""How noisy each robot's odometry and observations are, beside what was told: variance components.

The optimum leaves residuals, whitened with the noise as used. Of group g, the odometry or the
observations of one robot, their squares sum to s_g. If all variances of group h are really phi_h
times those used, then to first order, with P = J C J^T the projector onto what the unknowns explain
(J: of the whitened residuals by all unknowns, C: their covariance), whatever the phi are,

    E s_g = sum_h S_gh phi_h,   S_gh = tr((I - P)_gh (I - P)_hg),   sum_h S_gh = n_g - tr P_gg = r_g

(Helmert 1907; Searle, Casella, McCulloch: Variance components, 1992). Where the noise used is the
true one the solution is that of restricted maximum likelihood, and r_g, the redundancy, the degrees
of freedom behind it. What is known otherwise, the prior and sightings of robots by robots, counts
in r_g with the group itself.

With landmarks at their best P = A + B: A from the paths' covariance H^-1, B the landmarks' given
the paths, a projector of its own for each. B is summed exactly. Of M vectors n with independent
signs, y_g = J_g L^-T n has the covariance A, so that over vectors m and pairs m, m'

    tr A_gg = E |y_g|^2,   tr(A_gh A_hg) = E (y_g . y_g')(y_h . y_h'),
    tr(A_gh B_hg) = E y_h^T B_hg y_g

The standard deviations of these means are up to sqrt(2 tr(A_gg^2) / M) of the first and, of the
second, sqrt(2 tr(A_gg^2) tr(A_hh^2)) / M.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtr, chdtri

from multi_robot_slam.models.parallel import one_thread
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.smoothing.blocks import with_block_again
from multi_robot_slam.smoothing.cost import odometry_residuals
from multi_robot_slam.smoothing.kernels import landmarks as kernels
from multi_robot_slam.smoothing.kernels.changes import information_in_map, observation_changes
from multi_robot_slam.smoothing.kernels.links import odometry_jacobians
from multi_robot_slam.smoothing.prior import SMALLEST_SIGMA
from multi_robot_slam.smoothing.problem import Problem
from multi_robot_slam.smoothing.solve import Smoothed

DRAWS = 64
"""M: redundancies of some hundred unknowns come within one in a hundred, S within three."""

SIGNS = np.array([-1, 1], np.float32)

TOLD = 2.0
"""Degrees of freedom that stand for what was told: as if a factor were known to 1 / sqrt(2 TOLD).

Half of it: who measures noise at all is seldom off by more than that.
"""

INSIDE = 0.99
"""Quantile beyond which a residual counts as if it lay there: for an error, or a slip."""

MOST = 16.0
"""Largest factor on variances that is read out of residuals in one go, and over 1 the smallest.

Of noise so much larger than the gate nearly nothing but the gate is seen.
"""

LEAST_USED = 1.0
"""Least factor that is used.

Residuals do not show errors that repeat, such as those of a camera that is fooled alike by the same
texture, and noise that is mostly small hides rare slips. So what was told is not made light of.
"""

LEAST_REDUNDANCY = 0.05
"""Of a single residual, for the question whether it lies inside."""


class NoiseFactors(NamedTuple):
    """Factors on standard deviations, of K robots' odometry and observations."""

    factors: np.ndarray
    """(K, 2) float64: as estimated."""
    redundancies: np.ndarray
    """(K, 2) float64: r, degrees of freedom behind each.

    The standard deviation of a factor's logarithm is 1 / sqrt(2 r).
    """
    used: np.ndarray
    """(K, 2) float64: those that filter and smoothing go by."""
    equations: np.ndarray
    """(2 K, 2 K) float64: of settled frames, `equations` phi = `sums`; phi as K pairs."""
    sums: np.ndarray
    """(2 K,) float64."""

    @classmethod
    def as_told(cls, robots: int) -> "NoiseFactors":
        """Nothing was seen yet."""
        pairs, count = np.ones((robots, 2)), 2 * robots
        nothing = np.zeros((count, count))
        return cls(pairs, np.zeros((robots, 2)), pairs, nothing, np.zeros(count))

    def with_another(self, robot: int) -> "NoiseFactors":
        """With another robot after the others, of which as much is known as of `robot`."""
        own = 2 * robot + np.arange(2)
        return NoiseFactors(
            np.vstack([self.factors, self.factors[robot]]),
            np.vstack([self.redundancies, self.redundancies[robot]]),
            np.vstack([self.used, self.used[robot]]),
            with_block_again(self.equations, own),
            np.append(self.sums, self.sums[own]),
        )


class Shares(NamedTuple):
    """What becomes of the noise in the residuals of G groups."""

    matrix: np.ndarray
    """(G, G): S."""
    groups: tuple[np.ndarray, np.ndarray]
    """(P,) of the odometry, (O,) of the observations: the group of each, -1: of none."""
    redundancies: tuple[np.ndarray, np.ndarray]
    """(P, 3), (O,): of each of three residuals, and of three together over three."""


@one_thread
def learn(
    noise: NoiseFactors,
    problem: Problem,
    smoothed: Smoothed,
    shares: Shares,
    leaving: int,
    limit: float,
    is_used: bool,
) -> NoiseFactors:
    """What the window, for which `smoothed` is the optimum with `noise.used`, adds.

    Parameters
    ----------
    shares : `shares_of` the two.
    leaving : how many of the first records leave the window; their robots' shares count for good.
    limit : D (18) beyond which observations were not matched, or count less.
    is_used : whether the factors are used from now on, at most twice or half those before, and no
        less than `LEAST_USED`.

    """
    used_sq = np.square(noise.used).ravel()
    relative, inside = _relative_variances(problem, smoothed, shares, limit)
    matrix = inside[:, None] * shares.matrix
    equations = matrix * used_sq[:, None] / used_sq
    sums = used_sq * relative * matrix.sum(axis=1)
    all_equations = noise.equations + equations + TOLD * np.eye(len(sums))
    variances = np.linalg.solve(all_equations, noise.sums + sums + TOLD)
    variances = variances.clip(used_sq / MOST, used_sq * MOST)
    factors = np.sqrt(variances).reshape(-1, 2)
    used = noise.used
    if is_used:
        used = factors.clip(noise.used / 2, noise.used * 2).clip(min=LEAST_USED)
    known = np.linalg.inv(all_equations * variances / variances[:, None])
    leave = np.repeat(_leaving_shares(problem, leaving, len(factors)), 2)
    return NoiseFactors(
        factors,
        (1 / np.diag(known) - TOLD).clip(min=0).reshape(-1, 2),
        used,
        noise.equations + leave[:, None] * equations,
        noise.sums + leave * sums,
    )


def _leaving_shares(problem: Problem, leaving: int, robots: int) -> np.ndarray:
    """(K,): of each robot's records, the share of those among the first `leaving`."""
    own = problem.robots[len(problem.anchors) :]
    leave = np.bincount(own[:leaving], minlength=robots)
    return leave / np.bincount(own, minlength=robots).clip(min=1)


@one_thread
def shares_of(problem: Problem, smoothed: Smoothed, draws: int = DRAWS) -> Shares:
    """S of the groups odometry of robot 0, observations of robot 0, odometry of robot 1, ..."""
    robots = problem.robots[len(problem.anchors) :]
    count = 2 * (int(problem.robots.max()) + 1)
    moving = (problem.sigmas > SMALLEST_SIGMA).all(axis=1)
    if problem.with_gaps is not None:
        moving &= ~problem.with_gaps
    of_odometry = np.where(moving, 2 * robots, -1)
    seers = np.append(problem.robots, np.full(len(smoothed.centres), -1))[problem.seen_from]
    of_observations = np.where(seers >= 0, 2 * seers + 1, -1)
    *changes, mixed = _changes(problem, smoothed, of_observations, count, draws)
    grams = np.zeros((count, draws, draws))
    for groups, own in zip((of_odometry, of_observations), changes, strict=True):
        for group in np.unique(groups[groups >= 0]):
            flat = own[groups == group].reshape(-1, draws)
            grams[group] = flat.T @ flat
    landmarks, by_landmarks = _by_landmarks(problem, smoothed, of_observations, count)
    own_odometry = 1 - np.square(changes[0]).mean(axis=2)
    squares = np.einsum("oim,oim->o", changes[1], changes[1], dtype=float)
    own_observations = 1 - (squares / draws + by_landmarks) / 3
    redundancies = np.zeros(count)
    np.add.at(redundancies, of_odometry[moving], own_odometry[moving].sum(axis=1))
    mine = of_observations >= 0
    np.add.at(redundancies, of_observations[mine], 3 * own_observations[mine])
    grams[:, np.arange(draws), np.arange(draws)] = 0  # y with itself is no pair
    between = grams.reshape(count, -1)
    pairs = draws * (draws - 1)
    matrix = (between @ between.T / pairs + landmarks + 2 * mixed).clip(min=0)
    np.fill_diagonal(matrix, 0)
    np.fill_diagonal(matrix, (redundancies - matrix.sum(axis=1)).clip(min=0))
    return Shares(matrix, (of_odometry, of_observations), (own_odometry, own_observations))


def _changes(
    problem: Problem, smoothed: Smoothed, groups: np.ndarray, count: int, draws: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Changes y of odometry (P, 3, M) and observations (O, 3, M), whose `groups` are (O,).

    And tr(A_gh B_hg) (G, G) of different groups; `count` is G.
    """
    signs = np.random.default_rng(0).choice(SIGNS, (smoothed.factor.size, draws))
    moves = smoothed.factor.solve_upper(signs)[: problem.columns[-1]]
    of_poses, of_centres = np.split(moves, [3 * problem.poses])
    of_centres = np.pad(of_centres.reshape(-1, 2, draws), ((0, 0), (0, 1), (0, 0)))
    of_views = np.concatenate([of_poses.reshape(-1, 3, draws), of_centres])
    jacobians = np.empty((len(problem.previous), 3, 6))
    before = smoothed.poses[problem.previous]
    odometry_jacobians(before, problem.sigmas, smoothed.of_records, jacobians)
    own = of_views[len(problem.anchors) : problem.poses]
    ends = np.concatenate([of_views[problem.previous], own], axis=1)
    mixed = np.zeros((count, count))
    of_robots = np.zeros((count // 2, count // 2))
    changes = np.empty((len(problem.positions), 3, draws), np.float32)
    observation_changes(
        problem.observations(smoothed.weights),
        smoothed.views,
        smoothed.landmarks,
        np.where(groups >= 0, groups // 2, -1),
        of_views,
        changes,
        of_robots,
    )
    mixed[1::2, 1::2] = of_robots
    return jacobians @ ends, changes, mixed


def _by_landmarks(
    problem: Problem, smoothed: Smoothed, groups: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """B, landmarks given the paths: tr(B_gh B_hg) (G, G), and the trace of each observation."""
    observations = problem.observations(smoothed.weights)
    information = unpack(information_in_map(observations, smoothed.views))
    landmarks = problem.landmarks
    shares = unpack(smoothed.landmarks[:, 3:])[landmarks] @ information
    mine = groups >= 0
    of_groups = np.zeros((len(problem.ids), count // 2, 3, 3))
    np.add.at(of_groups, (landmarks[mine], groups[mine] // 2), shares[mine])
    matrix = np.zeros((count, count))
    flat = of_groups.swapaxes(0, 1).reshape(count // 2, -1)
    turned = of_groups.transpose(1, 0, 3, 2).reshape(count // 2, -1)
    matrix[1::2, 1::2] = flat @ turned.T
    return matrix, np.trace(shares, axis1=1, axis2=2)


def _relative_variances(
    problem: Problem, smoothed: Smoothed, shares: Shares, limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """(G,) each: variances over those used, and the share of the redundancy that tells them."""
    count = len(shares.matrix)
    relative, inside = np.ones(count), np.zeros(count)
    squared = np.square(odometry_residuals(problem, smoothed.poses))
    distances = np.empty(len(problem.positions))
    observations = problem.observations()
    kernels.mahalanobis_sq(observations, smoothed.views, smoothed.landmarks, distances)
    for group in range(count):
        kind = group % 2
        own = shares.groups[kind] == group
        if own.any():
            relative[group], inside[group] = truncated_variance(
                (squared, distances)[kind][own].ravel(),
                shares.redundancies[kind][own].ravel(),
                (1, 3)[kind],
                (np.inf, limit)[kind],
            )
    return relative, inside


def truncated_variance(
    squares: np.ndarray, redundancies: np.ndarray, freedom: int, limit: float
) -> tuple[float, float]:
    """Variance phi of n sums of squares, redundancy times phi chi2, and the share that tells.

    Over its redundancy one is how far the others put it from themselves. Only those up to `limit`
    count, beyond which others are missing, and none counts for more than q, the quantile INSIDE of
    chi2 with k = `freedom` degrees: phi is where the mean of those that count is that of

        E[min(chi2, q) | chi2 < c = limit / phi]
            = (k F_{k+2}(min(q, c)) + q (F_k(c) - F_k(min(q, c)))) / F_k(c)

    and the logarithm of phi is known as if there were so much less of the redundancy as
    `_information` says.
    """
    apart, quantile = squares / redundancies.clip(min=LEAST_REDUNDANCY), _quantile(freedom)
    inside = apart <= limit
    total = redundancies[inside].sum()
    if total <= 0:
        return 1.0, 0.0
    counted = squares[inside]
    most = quantile * redundancies[inside].clip(min=LEAST_REDUNDANCY)

    def lacking(variance: float) -> float:
        mean = np.minimum(counted / variance, most).sum() / total
        return float(mean - _mean(freedom, limit / variance, quantile))

    variance = MOST
    if lacking(1 / MOST) <= 0:
        variance = 1 / MOST
    elif lacking(MOST) < 0:
        variance = float(brentq(lacking, 1 / MOST, MOST, xtol=1e-4))
    share = float(total / redundancies.sum())
    return variance, min(share, 1.0) * _information(freedom, limit / variance)


def _quantile(freedom: int) -> float:
    return float(chdtri(freedom, 1 - INSIDE))


def _mean(freedom: int, cut: float, most: float) -> float:
    """E[min(chi2, most) | chi2 < cut]."""
    below = min(cut, most)
    above = most * (chdtr(freedom, cut) - chdtr(freedom, below))
    return float((freedom * chdtr(freedom + 2, below) + above) / chdtr(freedom, cut))


def _information(freedom: int, cut: float) -> float:
    """What a chi2 cut off tells of its scale over what a whole one does: Var(chi2 | < c) / 2 k."""
    mean = freedom * float(chdtr(freedom + 2, cut) / chdtr(freedom, cut))
    square = freedom * (freedom + 2) * float(chdtr(freedom + 4, cut) / chdtr(freedom, cut))
    return (square - mean**2) / (2 * freedom)
