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
history cannot be smoothed; where that is the largest group, all do.

Where smoothing would have too many unknowns, the older frames settle: they are marginalised into
the prior, a joint Gaussian of landmarks and of where the robots go on from (`smoothing.prior`). No
pose is taken for certain, and what the largest group makes of settled frames holds for all.

A rejuvenation reads a `Snapshot` and makes a new state, so that it can be done beside the filter
(`running`).
"""

from typing import NamedTuple

import numpy as np

from multi_robot_slam.filter import new_map
from multi_robot_slam.filter.covisible import Covisible
from multi_robot_slam.filter.existence import Existence, Placed
from multi_robot_slam.filter.forgetting import forgotten
from multi_robot_slam.filter.looks import frames_of
from multi_robot_slam.filter.new_past import Drawn, draw
from multi_robot_slam.filter.settings import FilterSettings, RejuvenationSettings
from multi_robot_slam.filter.settled import SeenLandmarks
from multi_robot_slam.filter.snapshot import Snapshot
from multi_robot_slam.filter.state import Optimum, State
from multi_robot_slam.smoothing import joining, noise_factors, odometry_scale
from multi_robot_slam.smoothing.absorption import absorb
from multi_robot_slam.smoothing.noise_factors import NoiseFactors
from multi_robot_slam.smoothing.odometry_scale import Scales
from multi_robot_slam.smoothing.prior import Prior

FAILURES = (ArithmeticError, ValueError)
"""What a step or a smoothing raises where it cannot be done, with the state as before.

`ValueError` includes `SmoothingError` and NumPy's `LinAlgError`.
"""

MULTIPLICATIONS = 2e8
"""Of one factorisation, some 10 ms: beyond that the older half of the window settles.

Six hundred poses of robots that explore take half as many; poses among landmarks that are all known
jointly take as many with 1,200 unknowns.
"""


class Rejuvenated(NamedTuple):
    """What a rejuvenation did."""

    groups: int
    """Histories that were smoothed; 0: nothing was drawn anew."""
    alone: int
    """Particles that were left as they were."""
    effective_particles: float
    """Effective sample size of the exact importance weights, summed over the groups."""
    failures: tuple[str, ...]
    """Why a history that enough particles share could not be smoothed, for each of those."""


class Learnt(NamedTuple):
    """What is known of odometry and noise; as in `State`."""

    scales: Scales
    bias: Scales
    noise: NoiseFactors


def is_due(state: State, settings: RejuvenationSettings) -> bool:
    """Too few of the particles of the last rejuvenation, or of the last try, have descendants."""
    count = len(state.origins)
    return int(np.count_nonzero(np.bincount(state.origins))) < settings.ancestors_below * count


def rejuvenate(
    old: Snapshot, settings: FilterSettings, rng: np.random.Generator
) -> tuple[State | None, Rejuvenated]:
    """The state in which the paths of all particles are drawn anew; None where none could be."""
    drawn, failures = _draw_groups(old, settings, rng)
    state = None
    if drawn:
        try:
            state = _renewed(old, drawn, settings)
        except FAILURES as error:
            drawn, failures = [], [*failures, str(error)]
    return state, Rejuvenated(
        len(drawn),
        len(old.log_weight_sum) - sum(len(group.past.members) for group in drawn),
        sum(group.effective_particles for group in drawn),
        tuple(failures),
    )


class AllSettled(NamedTuple):
    """What is known of the landmarks when all frames have left."""

    prior: Prior
    existence: Existence
    covisible: Covisible
    seen: SeenLandmarks


def all_settled(old: Snapshot, settings: FilterSettings, rng: np.random.Generator) -> AllSettled:
    """What remains when the robots go: all frames settle, as the largest group has them.

    `SmoothingError` where that cannot be smoothed.
    """
    records, seen = old.history.records, old.history.settled.seen
    if not records:
        return AllSettled(old.prior, old.existence, old.covisible, seen)
    largest = draw(old, old.groups[0], _alike(old, settings), settings, rng)
    count, past = len(records), largest.past
    no_centre = _without_centre(old, largest, count, settings)
    return AllSettled(
        absorb(largest.problem, largest.smoothed, count, largest.prior, no_centre),
        _existence(old, largest, count, settings),
        old.covisible.also(records, past.identities, past.aliases),
        seen.renamed(past.aliases).also(records, past.identities),
    )


def _draw_groups(
    old: Snapshot, settings: FilterSettings, rng: np.random.Generator
) -> tuple[list[Drawn], list[str]]:
    """New pasts of the groups that are large enough; why some have none.

    None at all without the largest: what settles is what it makes of it.
    """
    least = settings.rejuvenation.share * len(old.log_weight_sum)
    alike = _alike(old, settings)
    drawn: list[Drawn] = []
    failures: list[str] = []
    for members in old.groups:
        if len(members) >= least:
            try:
                drawn.append(draw(old, members, alike, settings, rng))
            except FAILURES as error:
                failures.append(str(error))
                if members is old.groups[0]:
                    break
    return drawn, failures


def _alike(old: Snapshot, settings: FilterSettings) -> np.ndarray:
    """(A, 2) ids of landmarks of one piece that look alike."""
    rows = joining.alike(old.held.descriptors, settings.descriptor_gate)
    own, other = old.held.pieces[rows].T
    return old.held.ids[rows[own == other]]


def _renewed(old: Snapshot, drawn: list[Drawn], settings: FilterSettings) -> State:
    """All groups go on from their new pasts; the largest says what settles."""
    largest = drawn[0]
    settle = _how_many_settle(old, largest, settings)
    no_centre = _without_centre(old, largest, settle, settings)
    prior = absorb(largest.problem, largest.smoothed, settle, largest.prior, no_centre)
    lost = _unseen_since(no_centre, old, largest, settle)
    covisible = old.covisible.also(
        old.history.records[:settle], largest.past.identities[:settle], largest.past.aliases
    )
    landmarks = new_map.of_groups(old.held, [(g.past.members, g.ids, g.planes) for g in drawn])
    landmarks.forget(lost)
    landmarks.bound(landmarks.alive(), settings.gate)
    state = State(
        poses=old.poses.copy(),
        landmarks=landmarks,
        log_weights=np.zeros(len(old.log_weight_sum)),
        log_weight_sum=old.log_weight_sum.copy(),
        history=old.history.renewed([group.past for group in drawn], settle),
        **_learnt(old, largest, settle, settings)._asdict(),
        prior=prior,
        existence=_existence(old, largest, settle, settings).forget(lost),
        pieces=old.pieces.when_joined(),
        covisible=covisible.only(prior.ids),
        optimum=Optimum(largest.smoothed.of_records[settle:], None if settle else largest.smoothed),
        steps=old.steps,
    )
    state.history.settled = state.history.settled.forget(lost)
    for group in old.groups:
        of_group = state.log_weight_sum[group]
        state.log_weight_sum[group] = np.log(len(group)) + of_group - of_group.max()
    for drawn_group in drawn:
        members = drawn_group.past.members
        state.poses[:, :, members] = drawn_group.poses
        state.log_weights[members] = drawn_group.log_weights
        state.log_weight_sum[members] = np.log(len(members)) + drawn_group.log_densities
    return state


def _learnt(old: Snapshot, largest: Drawn, settle: int, settings: FilterSettings) -> Learnt:
    """What the largest group's paths say of odometry and noise, where `settle` records leave."""
    problem, smoothed = largest.problem, largest.smoothed
    motions = np.array([record.motion for record in old.history.records])
    shares = noise_factors.shares_of(problem, smoothed)
    known = problem, smoothed, motions, settle / len(motions)
    bias = odometry_scale.learn(old.bias._replace(factors=old.scales.factors), *known)
    limit = min(settings.gate, settings.robust_above)
    return Learnt(
        odometry_scale.learn(old.scales, *known),
        odometry_scale.doubted(bias, problem, motions, shares.redundancies[0]),
        noise_factors.learn(
            old.noise, problem, smoothed, shares, settle, limit, settings.learn_noise
        ),
    )


def _existence(old: Snapshot, largest: Drawn, settle: int, settings: FilterSettings) -> Existence:
    """What is known of the landmarks' existence without the first `settle` records, which leave."""
    known = old.existence.renamed(largest.past.aliases)
    if settle == 0 or not settings.existence.is_on:
        return known
    past, records = largest.past, old.history.records
    poses, identities = past.paths[:, :, 0], past.identities
    views = known.seen(frames_of(records, poses, identities))
    pieces = old.pieces.of_robots[[record.robot for record in records[:settle]]]
    of_landmarks = _pieces_of(old, largest.ids)
    for piece in np.unique(pieces):
        rows = np.flatnonzero(pieces == piece)
        leaving = frames_of([records[p] for p in rows], poses[rows], [identities[p] for p in rows])
        own = of_landmarks == piece
        placed = Placed.of(largest.ids[own], largest.planes[own, :, 0])
        known = known.also(leaving, placed, views, settings.existence)
    return known


def _pieces_of(old: Snapshot, ids: np.ndarray) -> np.ndarray:
    """The piece of each of the landmarks `ids`."""
    return old.held.pieces[np.searchsorted(old.held.ids, ids)]


def _how_many_settle(old: Snapshot, largest: Drawn, settings: FilterSettings) -> int:
    """Records that leave the window: the older half, whole steps, where it is too large."""
    records = old.history.records
    envelope = largest.smoothed.factor.envelope
    is_small = envelope.edges[-1] <= settings.rejuvenation.unknowns
    if is_small and envelope.multiplications <= MULTIPLICATIONS:
        return 0
    count = len(records) // 2
    while count and records[count].step == records[count - 1].step:
        count -= 1
    return count


def _without_centre(
    old: Snapshot, largest: Drawn, settle: int, settings: FilterSettings
) -> np.ndarray:
    """Ids of landmarks of the first `settle` records, which leave, that are not worth a centre."""
    identities = largest.past.identities
    seen = old.history.settled.seen.renamed(largest.past.aliases).also(
        old.history.records, identities
    )
    leaving = np.concatenate([np.empty(0, np.int64), *identities[:settle]])
    ids = np.union1d(largest.prior.ids, leaving) if settle else leaving
    ids = ids[np.isin(ids, largest.ids)]
    places = largest.planes[np.searchsorted(largest.ids, ids), :3, 0].astype(float)
    counts, pieces = seen.of_ids(ids)[0], _pieces_of(old, ids)
    return forgotten(ids, places, counts, settings.rejuvenation, pieces)


def _unseen_since(ids: np.ndarray, old: Snapshot, largest: Drawn, settle: int) -> np.ndarray:
    """Those of the landmarks `ids` that no particle saw after the first `settle` records."""
    if not len(ids):
        return ids
    since = [np.unique(record.matches) for record in old.history.records[settle:]]
    return np.setdiff1d(ids, np.concatenate([*since, *largest.past.identities[settle:]]))
