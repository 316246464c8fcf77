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
share stay as they are: a smoothing for each would cost more than they weigh. So do those whose
history cannot be smoothed.

Where a run grows beyond a window, its older poses are fixed: they stay where they are in each path,
and what they say of landmarks is kept as one Gaussian for each landmark, as seen from the optimum.
So the cost is bounded; how the oldest part lies in `map` counts as known from then on. Particles
that were not smoothed keep what was fixed before, until they are.
"""

from itertools import islice
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from multi_robot_slam.filter import resampling
from multi_robot_slam.filter.history import Past, Record, signature_of
from multi_robot_slam.filter.settings import FilterSettings, RejuvenationSettings, threads
from multi_robot_slam.filter.state import Fixed, State, resample
from multi_robot_slam.smoothing import draws, joining, marginals, solve
from multi_robot_slam.smoothing.aliases import Aliases
from multi_robot_slam.smoothing.odometry_scale import Scales, learn
from multi_robot_slam.smoothing.problem import Problem, problem_of
from multi_robot_slam.smoothing.solve import Smoothed, SmoothingError

NEAR_ENOUGH = 0.1
"""Distance from the optimum, in standard deviations, at which smoothing ends.

The importance weights are exact around any centre.
"""


class Rejuvenated(NamedTuple):
    """What a rejuvenation did."""

    ancestors: np.ndarray
    """(M,) int32: the particle whose association history each has taken over."""
    groups: int
    """Histories that were smoothed; 0: nothing was drawn anew."""
    alone: int
    """Particles that were left as they were."""
    effective_particles: float
    """Effective sample size of the exact importance weights, summed over the groups."""
    failures: tuple[str, ...]
    """Why a history that enough particles share could not be smoothed, for each of those."""


def is_due(state: State, settings: RejuvenationSettings) -> bool:
    """Too few of the particles of the last rejuvenation, or of the last try, have descendants."""
    if state.steps - state.origin_step < settings.rest:
        return False
    count = len(state.origins)
    return int(np.count_nonzero(np.bincount(state.origins))) < settings.ancestors_below * count


def rejuvenate(state: State, settings: FilterSettings, rng: np.random.Generator) -> Rejuvenated:
    """Draw the paths of all particles anew, in place.

    What cannot be smoothed stays as it was: if that is every history, the particles have been
    resampled and nothing else; the next try is when `is_due` says so.
    """
    weights = resampling.normalise(state.log_weights)
    ancestors = resampling.systematic(weights, rng.random())
    resample(state, ancestors)
    groups = _groups(state)
    drawn, failures = _draw_groups(state, groups, settings, rng)
    if drawn or not failures:
        _begin_sums(state, groups)
    if drawn:
        _go_on(state, drawn, settings)
    state.origins = np.arange(len(weights), dtype=np.int32)
    state.origin_step = state.steps
    return Rejuvenated(
        ancestors,
        len(drawn),
        len(weights) - sum(len(group.past.members) for group in drawn),
        sum(group.effective_particles for group in drawn),
        tuple(failures),
    )


def _groups(state: State) -> list[np.ndarray]:
    """The particles of each association history, the largest group first."""
    signatures, places = np.unique(state.history.signatures, return_inverse=True)
    groups = [np.flatnonzero(places == g) for g in range(len(signatures))]
    return sorted(groups, key=len, reverse=True)


def _begin_sums(state: State, groups: list[np.ndarray]) -> None:
    """Each group's sums of weights begin at the logarithm of its size.

    So the best particle (17) is one of the largest group.
    """
    for group in groups:
        of_group = state.log_weight_sum[group]
        state.log_weight_sum[group] = np.log(len(group)) + of_group - of_group.max()


class Drawn(NamedTuple):
    """What the particles of one association history go on from."""

    past: Past
    problem: Problem
    fixed: Fixed
    """The part of the past that moves no more."""
    scales: Scales
    """Factors of the odometry."""
    planes: np.ndarray
    """(N, 9, n): mean and covariance of each landmark, as in `Landmarks`."""
    log_weights: np.ndarray
    """(n,) float64: logarithm of the weights, tempered; their mean weight is 1."""
    effective_particles: float
    """Effective sample size of the importance weights before they were tempered, 1 .. n."""
    log_densities: np.ndarray
    """(n,) float64: logarithm of the posterior density over that of the optimum."""


def _draw_groups(
    state: State, groups: list[np.ndarray], settings: FilterSettings, rng: np.random.Generator
) -> tuple[list[Drawn], list[str]]:
    """New pasts of the groups that are large enough; why some have none. The state stays as is."""
    least = settings.rejuvenation.share * len(state.log_weights)
    alike = _alike(state, settings.descriptor_gate)
    drawn: list[Drawn] = []
    failures: list[str] = []
    for members in groups:
        if len(members) >= least:
            try:
                drawn.append(_draw(state, members, alike, settings, rng))
            except SmoothingError as error:
                failures.append(str(error))
    return drawn, failures


def _alike(state: State, threshold: float) -> np.ndarray:
    """(A, 2) ids of landmarks that look alike, the smaller first."""
    columns = state.landmarks.alive()
    columns = columns[np.argsort(state.landmarks.ids[columns])]
    pairs = joining.alike(state.landmarks.descriptors[columns], threshold)
    return state.landmarks.ids[columns][pairs]


def _draw(
    state: State,
    members: np.ndarray,
    alike: np.ndarray,
    settings: FilterSettings,
    rng: np.random.Generator,
) -> Drawn:
    """Smooth the history `members` share, and draw a path for each; the first is the optimum."""
    fixed = state.fixed[state.fixed_of[members[0]]]
    records, poses, identities = _past(state, members, fixed.records)
    problem, smoothed, aliases = _smooth(
        state.scales.factors, fixed, records, poses, identities, alike, settings
    )
    normals = rng.standard_normal((smoothed.factor.size, len(members)), np.float32)
    normals[:, 0] = 0
    paths, drawn_densities = draws.draw(problem, smoothed, normals)
    planes, densities = draws.landmarks_and_log_density(
        problem, paths, smoothed.weights, state.landmarks.planes.dtype, threads(settings)
    )
    exact = densities - drawn_densities
    if not (np.isfinite(exact).all() and np.isfinite(planes).all()):
        raise SmoothingError(f"smoothing {len(poses)} poses: a path drawn is not finite")
    log_weights = tempered(exact)
    log_weights -= log_weights.max()
    log_weights -= np.log(np.exp(log_weights).mean())
    renamed = aliases.among(fixed.known.ids)
    scales, fixed = _fix(state, fixed, problem, smoothed, settings.rejuvenation.window)
    identities = [aliases.of(own) for own in identities]
    signature = signature_of([*identities, fixed.known.ids.astype(np.int32)])
    return Drawn(
        Past(members, paths, identities, renamed, signature),
        problem,
        fixed,
        scales,
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


def _past(
    state: State, members: np.ndarray, fixed: int
) -> tuple[list[Record], np.ndarray, list[np.ndarray]]:
    """Records after the `fixed` ones, the mean of the members' paths (P, 3), their identities."""
    count = len(state.history.records) - fixed
    lineage = list(islice(state.history.lineage(members), count))[::-1]
    records = [record for record, _ in lineage]
    poses = np.array([record.poses[:, rows].mean(axis=1) for record, rows in lineage])
    return records, poses, [record.matches[:, rows[0]] for record, rows in lineage]


def _smooth(
    factors: np.ndarray,
    fixed: Fixed,
    records: list[Record],
    poses: np.ndarray,
    identities: list[np.ndarray],
    alike: np.ndarray,
    settings: FilterSettings,
) -> tuple[Problem, Smoothed, Aliases]:
    """Smooth, and join landmarks that turn out to be one."""

    def smoothed_with(aliases: Aliases, poses: np.ndarray) -> tuple[Problem, Smoothed]:
        problem = problem_of(
            records,
            [aliases.of(own) for own in identities],
            fixed.start_poses,
            settings.motion,
            fixed.known._replace(ids=aliases.of(fixed.known.ids)),
            factors,
        )
        return problem, solve.smooth(problem, poses, settings.robust_above, NEAR_ENOUGH)

    return joining.smooth_and_join(smoothed_with, poses, alike, settings.gate, settings.exclusive)


def _fix(
    state: State, fixed: Fixed, problem: Problem, smoothed: Smoothed, window: int
) -> tuple[Scales, Fixed]:
    """The odometry's factors, and the past with the poses before the window fixed: whole steps."""
    records = state.history.records
    first = max(len(records) - window, fixed.records)
    while fixed.records < first and records[first].step == records[first - 1].step:
        first -= 1
    count = first - fixed.records
    motions = np.array([record.motion for record in records[fixed.records :]])
    scales = learn(state.scales, problem, smoothed, motions, count / len(motions))
    return scales, Fixed(first, *marginals.marginalise(problem, smoothed, count))


def _go_on(state: State, drawn: list[Drawn], settings: FilterSettings) -> None:
    """All groups go on from their new pasts; the largest says what the odometry's factors are."""
    state.history.rewrite([group.past for group in drawn])
    for group in drawn:
        members, paths = group.past.members, group.past.paths
        last = {int(robot): p for p, robot in enumerate(group.problem.robots)}
        for robot, p in last.items():
            state.poses[robot][:, members] = paths[p]
        ids = group.problem.ids.astype(np.int32)
        state.landmarks.rewrite(members, ids, group.planes, threads(settings))
        state.log_weights[members] = group.log_weights
        state.log_weight_sum[members] = np.log(len(members)) + group.log_densities
    _begin_with_fixed(state, drawn)
    state.scales = drawn[0].scales
    state.landmarks.bound(state.landmarks.alive(), settings.gate)


def _begin_with_fixed(state: State, drawn: list[Drawn]) -> None:
    """The groups' pasts begin with what was fixed now; with the largest group's where equal."""
    new: list[Fixed] = []
    for group in drawn:
        own = group.fixed.known.ids
        same = [i for i, fixed in enumerate(new) if np.array_equal(fixed.known.ids, own)]
        if not same:
            new.append(group.fixed)
        index = same[0] if same else len(new) - 1
        state.fixed_of[group.past.members] = len(state.fixed) + index
    used, places = np.unique(state.fixed_of, return_inverse=True)
    everything = (*state.fixed, *new)
    state.fixed = tuple(everything[i] for i in used)
    state.fixed_of = places.astype(np.int32)
