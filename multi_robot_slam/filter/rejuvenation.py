"""Back to the posterior of all paths: what resampling forgot is drawn anew.

Particles that went through many resamplings share their past, and with it its errors. But given
who saw what, the posterior of all paths is nearly Gaussian around its optimum, and smoothing finds
both. So when few of the particles of the last time have descendants left, for each association
history A that enough particles share:

    x_hat, H     optimum of the paths and its information, landmarks eliminated (`smoothing`)
    x_m          = x_hat + L^-T n_m,  n_m ~ N(0, I),  H = L L^T
    w_m          ~ p(x_m, z | A) / N(x_m; x_hat, H^-1), tempered where few would remain
    landmarks_m  = exact sums of information along x_m: what its EKFs would hold

Every particle has a past of its own again, and the filter goes on. Particles whose history too few
share stay as they are: a smoothing for each would cost more than they weigh.

Where a run grows beyond a window, its older poses settle: they stay where they are in each path,
and what they say of landmarks is kept once for all, as seen from the optimum. So the cost is
bounded; how the oldest part lies in `map` is then taken for certain.
"""

from itertools import islice
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from multi_robot_slam.filter import resampling
from multi_robot_slam.filter.history import Past, Record
from multi_robot_slam.filter.settings import FilterSettings, RejuvenationSettings, threads
from multi_robot_slam.filter.state import Settled, State, resample
from multi_robot_slam.smoothing import draws, joining, solve
from multi_robot_slam.smoothing.odometry_scale import learn
from multi_robot_slam.smoothing.problem import Problem, problem_of
from multi_robot_slam.smoothing.solve import Smoothed

NEAR_ENOUGH = 0.1
"""Distance from the optimum, in standard deviations, at which smoothing ends.

The importance weights are exact around any centre.
"""


class Heirs:
    """Landmarks that were joined: which id each of them goes by now."""

    def __init__(self, old: np.ndarray | None = None, new: np.ndarray | None = None):
        self._old = np.empty(0, np.int64) if old is None else old
        self._new = np.empty(0, np.int64) if new is None else new

    def of(self, ids: np.ndarray) -> np.ndarray:
        """`ids`, any shape, each replaced by its heir where it has one."""
        if not len(self._old):
            return ids
        places = np.searchsorted(self._old, ids).clip(max=len(self._old) - 1)
        return np.where(self._old[places] == ids, self._new[places], ids).astype(ids.dtype)

    def and_then(self, pairs: np.ndarray) -> "Heirs":
        """Also pairs[:, 1] are replaced by pairs[:, 0] (A, 2)."""
        order = np.argsort(pairs[:, 1])
        later = Heirs(pairs[order, 1], pairs[order, 0])
        old = np.append(self._old, pairs[:, 1])
        new = np.append(later.of(self._new), pairs[:, 0])
        order = np.argsort(old)
        return Heirs(old[order], new[order])


class Rejuvenated(NamedTuple):
    """What a rejuvenation did."""

    ancestors: np.ndarray
    """(M,) int32: the particle whose association history each has taken over."""
    groups: int
    """Histories that were smoothed."""
    alone: int
    """Particles that were left as they were."""
    effective_particles: float
    """Effective sample size of the exact importance weights, summed over the groups."""


def is_due(state: State, settings: RejuvenationSettings) -> bool:
    """Too few of the particles of the last rejuvenation have descendants."""
    if state.steps - state.origin_step < settings.rest:
        return False
    count = len(state.origins)
    return np.count_nonzero(np.bincount(state.origins)) < settings.ancestors_below * count


def rejuvenate(state: State, settings: FilterSettings, rng: np.random.Generator) -> Rejuvenated:
    """Draw the paths of all particles anew, in place."""
    weights = resampling.normalise(state.log_weights)
    ancestors = resampling.systematic(weights, rng.random())
    resample(state, ancestors)
    groups = _groups(state)
    shared = [g for g in groups if len(g) >= settings.rejuvenation.share * len(weights)]
    alike = _alike(state, settings.descriptor_gate)
    drawn = [_draw(state, group, alike, settings, rng) for group in shared]
    state.history.rewrite([group.past for group in drawn], state.settled.records)
    for group in drawn:
        _go_on(state, group, settings)
    if drawn:
        _settle(state, drawn[0], settings.rejuvenation.window)
    state.origins = np.arange(len(weights), dtype=np.int32)
    state.origin_step = state.steps
    state.landmarks.bound(state.landmarks.alive(), settings.gate)
    return Rejuvenated(
        ancestors,
        len(shared),
        len(weights) - sum(map(len, shared)),
        sum(group.effective_particles for group in drawn),
    )


def _groups(state: State) -> list[np.ndarray]:
    """The particles of each association history, the largest group first.

    So that the best particle (17) is one of the largest group, each group's sums of weights begin
    at the logarithm of its size.
    """
    signatures, places = np.unique(state.history.signatures, return_inverse=True)
    groups = [np.flatnonzero(places == g) for g in range(len(signatures))]
    for group in groups:
        of_group = state.log_weight_sum[group]
        state.log_weight_sum[group] = np.log(len(group)) + of_group - of_group.max()
    return sorted(groups, key=len, reverse=True)


def _alike(state: State, threshold: float) -> np.ndarray:
    """(A, 2) ids of landmarks that look alike, the smaller first."""
    columns = state.landmarks.alive()
    columns = columns[np.argsort(state.landmarks.ids[columns])]
    pairs = joining.alike(state.landmarks.descriptors[columns], threshold)
    return state.landmarks.ids[columns][pairs]


class Drawn(NamedTuple):
    """What the particles of one association history go on from."""

    past: Past
    problem: Problem
    smoothed: Smoothed
    heirs: Heirs
    planes: np.ndarray
    """(N, 9, n): its mean and covariance, as in `Landmarks`."""
    log_weights: np.ndarray
    """(n,) float64: logarithm of the weights, tempered; their mean weight is 1."""
    effective_particles: float
    """Effective sample size of the importance weights before they were tempered, 1 .. n."""
    log_densities: np.ndarray
    """(n,) float64: logarithm of the posterior density over that of the optimum."""


def _draw(
    state: State,
    members: np.ndarray,
    alike: np.ndarray,
    settings: FilterSettings,
    rng: np.random.Generator,
) -> Drawn:
    """Smooth the history `members` share, and draw a path for each; the first is the optimum."""
    records, poses, identities = _past(state, members)
    problem, smoothed, heirs = _smooth(
        state.scales.factors, state.settled, records, poses, identities, alike, settings
    )
    normals = rng.standard_normal((smoothed.factor.size, len(members)), np.float32)
    normals[:, 0] = 0
    paths, drawn_densities = draws.draw(problem, smoothed, normals)
    planes, densities = draws.landmarks_and_log_density(
        problem, paths, smoothed.weights, state.landmarks.planes.dtype, threads(settings)
    )
    exact = densities - drawn_densities
    log_weights = tempered(exact)
    log_weights -= log_weights.max()
    log_weights -= np.log(np.exp(log_weights).mean())
    return Drawn(
        Past(members, paths, [heirs.of(own) for own in identities]),
        problem,
        smoothed,
        heirs,
        planes,
        log_weights,
        resampling.effective_sample_size(resampling.normalise(exact)),
        densities - densities[0],
    )


def tempered(log_weights: np.ndarray) -> np.ndarray:
    """`log_weights` (n,) times the largest b <= 1 that leaves half of the sample size effective.

    Of a posterior far from Gaussian few draws have any weight, and to keep those alone would lose
    more than the weights correct.
    """

    def lacking(b: float) -> float:
        weights = resampling.normalise(b * log_weights)
        return 0.5 * len(weights) - resampling.effective_sample_size(weights)

    return log_weights * (1.0 if lacking(1.0) <= 0 else brentq(lacking, 0.0, 1.0, xtol=1e-6))


def _past(state: State, members: np.ndarray) -> tuple[list[Record], np.ndarray, list[np.ndarray]]:
    """Records not settled, the mean of the members' paths (P, 3), their common identities."""
    count = len(state.history.records) - state.settled.records
    lineage = list(islice(state.history.lineage(members), count))[::-1]
    records = [record for record, _ in lineage]
    poses = np.array([record.poses[:, rows].mean(axis=1) for record, rows in lineage])
    return records, poses, [record.matches[:, rows[0]] for record, rows in lineage]


def _smooth(
    factors: np.ndarray,
    settled: Settled,
    records: list[Record],
    poses: np.ndarray,
    identities: list[np.ndarray],
    alike: np.ndarray,
    settings: FilterSettings,
) -> tuple[Problem, Smoothed, Heirs]:
    """Smooth, join landmarks that turn out to be one, repeat until none do."""
    heirs = Heirs()
    while True:
        problem = problem_of(
            records,
            [heirs.of(own) for own in identities],
            settled.start_poses,
            settings.motion,
            settled.known._replace(ids=heirs.of(settled.known.ids)),
            factors,
        )
        smoothed = solve.smooth(problem, poses, settings.robust_above, NEAR_ENOUGH)
        pairs = heirs.of(alike)
        pairs = pairs[np.isin(pairs, problem.ids).all(axis=1) & (pairs[:, 0] != pairs[:, 1])]
        rows = joining.joined(
            problem,
            smoothed,
            np.searchsorted(problem.ids, pairs),
            settings.gate,
            settings.exclusive,
        )
        if not len(rows):
            return problem, smoothed, heirs
        poses = smoothed.poses
        heirs = heirs.and_then(problem.ids[rows])


def _go_on(state: State, drawn: Drawn, settings: FilterSettings) -> None:
    """The members go on from their new pasts."""
    members, paths = drawn.past.members, drawn.past.paths
    last = {int(robot): p for p, robot in enumerate(drawn.problem.robots)}
    for robot, p in last.items():
        state.poses[robot][:, members] = paths[p]
    ids = drawn.problem.ids.astype(np.int32)
    state.landmarks.rewrite(members, ids, drawn.planes, threads(settings))
    state.log_weights[members] = drawn.log_weights
    state.log_weight_sum[members] = np.log(len(members)) + drawn.log_densities


def _settle(state: State, drawn: Drawn, window: int) -> None:
    """Let the poses before the window settle at the optimum of the largest group: whole steps."""
    settled, records = state.settled, state.history.records
    first = max(len(records) - window, settled.records)
    while settled.records < first and records[first].step == records[first - 1].step:
        first -= 1
    for record in records[: settled.records]:
        record.matches = drawn.heirs.of(record.matches)
    count = first - settled.records
    motions = np.array([record.motion for record in records[settled.records :]])
    share = count / len(motions)
    state.scales = learn(state.scales, drawn.problem, drawn.smoothed, motions, share)
    start_poses, known = solve.settle(drawn.problem, drawn.smoothed, count)
    state.settled = Settled(first, start_poses, known)
