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

from typing import NamedTuple

import numpy as np

from multi_robot_slam.filter import resampling
from multi_robot_slam.filter.new_past import Drawn, draw
from multi_robot_slam.filter.settings import FilterSettings, RejuvenationSettings, threads
from multi_robot_slam.filter.state import Fixed, State, resample
from multi_robot_slam.smoothing import joining


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
                drawn.append(draw(state, members, alike, settings, rng))
            except ValueError as error:  # `SmoothingError`, or numbers no library could use
                failures.append(str(error))
    return drawn, failures


def _alike(state: State, threshold: float) -> np.ndarray:
    """(A, 2) ids of landmarks that look alike, the smaller first."""
    columns = state.landmarks.alive()
    columns = columns[np.argsort(state.landmarks.ids[columns])]
    pairs = joining.alike(state.landmarks.descriptors[columns], threshold)
    return state.landmarks.ids[columns][pairs]


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
