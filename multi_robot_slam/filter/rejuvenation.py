"""Back to the posterior of all paths: what resampling forgot is drawn anew.

Particles that went through many resamplings share their past, and with it its errors. But given
who saw what, the posterior of all paths is nearly Gaussian around its optimum, and smoothing finds
both. So when few of the particles of the last time have descendants left, for each association
history A that enough particles share:

    x_hat, H     optimum of the paths and its information, landmarks eliminated (`smoothing`)
    x_m          = x_hat + L^-T n_m,  n_m ~ N(0, I),  H = L L^T
    w_m          ~ p(x_m, z | A) / N(x_m; x_hat, H^-1)
    landmarks_m  = exact sums of information along x_m: what its EKFs would hold

Every particle has a past of its own again, and the filter goes on. Particles whose history too few
share stay as they are: a smoothing for each would cost more than they weigh.
"""

from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Interval

from msg_defs.types import CameraMount, settings
from multi_robot_slam.filter import joining, resampling, smoothing, whole_paths
from multi_robot_slam.filter.history import Past, Record
from multi_robot_slam.filter.motion import MotionSettings
from multi_robot_slam.filter.smoothing_problem import problem_of
from multi_robot_slam.filter.state import State, resample

NEAR_ENOUGH = 0.1
"""Distance from the optimum, in standard deviations, at which smoothing ends: the weights see to it."""


@settings
class RejuvenationSettings:
    """When and how the particles return to the posterior of all paths."""

    ancestors_below: Annotated[
        float,
        Interval(ge=0, le=1),
        "rejuvenate when the particles descend from less than this share of those of the last "
        "time; 0 is never",
    ] = 0.0
    rest: Annotated[int, Ge(1), "fewest steps between two rejuvenations"] = 1
    share: Annotated[
        float,
        Interval(gt=0, le=1),
        "smallest share of the particles with one association history that is rejuvenated",
    ] = 0.1


class Associations(NamedTuple):
    """What the rejuvenation needs to know of the filter's settings."""

    gate: float
    descriptor_gate: float
    exclusive: bool
    motion: MotionSettings
    mount: CameraMount
    threads: int


class Rejuvenated(NamedTuple):
    """What a rejuvenation did."""

    ancestors: np.ndarray
    """(M,) int32: the particle whose association history each has taken over."""
    groups: int
    """Histories that were smoothed."""
    alone: int
    """Particles that were left as they were."""
    effective_particles: float
    """Effective sample size of the importance weights of those that were not."""


def is_due(state: State, settings: RejuvenationSettings) -> bool:
    """Too few of the particles of the last rejuvenation have descendants."""
    if state.steps - state.origin_step < settings.rest:
        return False
    count = len(state.origins)
    return np.count_nonzero(np.bincount(state.origins)) < settings.ancestors_below * count


def rejuvenate(
    state: State,
    settings: RejuvenationSettings,
    associations: Associations,
    rng: np.random.Generator,
) -> Rejuvenated:
    """Draw the paths of all particles anew, in place."""
    weights = resampling.normalise(state.log_weights)
    ancestors = resampling.systematic(weights, rng.random())
    resample(state, ancestors)
    signatures, places = np.unique(state.history.signatures, return_inverse=True)
    groups = [np.flatnonzero(places == g) for g in range(len(signatures))]
    shared = [g for g in groups if len(g) >= settings.share * len(weights)]
    for group in groups:
        of_group = state.log_weight_sum[group]
        state.log_weight_sum[group] = np.log(len(group)) + of_group - of_group.max()
    drawn = [_draw(state, group, associations, rng) for group in shared]
    state.history.rewrite([group.past for group in drawn])
    for group in drawn:
        _settle(state, group, associations)
    state.origins = np.arange(len(weights), dtype=np.int32)
    state.origin_step = state.steps
    landmarks = state.landmarks
    landmarks.bound(landmarks.alive(), associations.gate)
    fresh = np.concatenate([*shared, np.empty(0, int)]).astype(int)
    effective = resampling.effective_sample_size(resampling.normalise(state.log_weights[fresh]))
    return Rejuvenated(ancestors, len(shared), len(weights) - len(fresh), effective)


class Drawn(NamedTuple):
    """What the particles of one association history go on from."""

    past: Past
    ids: np.ndarray
    """(N,) int32: id of each landmark."""
    planes: np.ndarray
    """(N, 9, n): its mean and covariance, as in `Landmarks`."""
    log_weights: np.ndarray
    """(n,) float64: logarithm of the importance weights; their mean weight is 1."""
    log_densities: np.ndarray
    """(n,) float64: logarithm of the posterior density over that of the optimum."""


def _draw(
    state: State, members: np.ndarray, associations: Associations, rng: np.random.Generator
) -> Drawn:
    """Smooth the history `members` share, and draw a path for each; the first is the optimum."""
    records, poses, identities = _past(state, members)
    problem, smoothed, identities = _smooth(state, records, poses, identities, associations)
    normals = rng.standard_normal((3 * len(records), len(members)))
    normals[:, 0] = 0
    paths = whole_paths.draw(smoothed, normals)
    planes, densities = whole_paths.landmarks_and_log_density(
        problem, paths, smoothed.weights, state.landmarks.planes.dtype, associations.threads
    )
    log_weights = densities + 0.5 * np.square(normals).sum(axis=0)
    log_weights -= log_weights.max()
    log_weights -= np.log(np.exp(log_weights).mean())
    return Drawn(
        Past(members, paths, identities),
        problem.ids.astype(np.int32),
        planes,
        log_weights,
        densities - densities[0],
    )


def _past(state: State, members: np.ndarray) -> tuple[list[Record], np.ndarray, list[np.ndarray]]:
    """Records, the mean of the members' paths (P, 3), and their common identities."""
    lineage = list(state.history.lineage(members))[::-1]
    records = [record for record, _ in lineage]
    poses = np.array([record.poses[:, rows].mean(axis=1) for record, rows in lineage])
    return records, poses, [record.matches[:, rows[0]] for record, rows in lineage]


def _smooth(state, records, poses, identities, associations: Associations):
    """Smooth, join landmarks that turn out to be one, repeat until none do."""
    while True:
        problem = problem_of(
            records, identities, state.start_poses, associations.motion, associations.mount
        )
        smoothed = smoothing.smooth(problem, poses, associations.gate, NEAR_ENOUGH)
        descriptors = state.landmarks.descriptors[state.landmarks.columns_of(problem.ids)]
        pairs = joining.joined(
            problem,
            smoothed,
            joining.alike(descriptors, associations.descriptor_gate),
            associations.gate,
            associations.exclusive,
        )
        if not len(pairs):
            return problem, smoothed, identities
        poses = smoothed.poses
        heirs = problem.ids.copy()
        heirs[pairs[:, 1]] = problem.ids[pairs[:, 0]]
        identities = [_inherited(own, problem.ids, heirs) for own in identities]


def _inherited(identities: np.ndarray, ids: np.ndarray, heirs: np.ndarray) -> np.ndarray:
    """Each of `identities` (B,) among `ids` (N,) replaced by its heir; -1 stays."""
    known = identities >= 0
    result = identities.copy()
    result[known] = heirs[np.searchsorted(ids, identities[known])]
    return result


def _settle(state: State, drawn: Drawn, associations: Associations) -> None:
    """The members go on from their new pasts."""
    members, paths = drawn.past.members, drawn.past.paths
    last = {record.robot: p for p, record in enumerate(state.history.records)}
    for robot, p in last.items():
        state.poses[robot][:, members] = paths[p]
    state.landmarks.rewrite(members, drawn.ids, drawn.planes, associations.threads)
    state.log_weights[members] = drawn.log_weights
    state.log_weight_sum[members] = np.log(len(members)) + drawn.log_densities
