"""A map without robots: what lasts when they go, and what the next ones begin with.

When a map is closed all frames settle, as the older ones do in `rejuvenation`: they are smoothed,
and what they say of the landmarks is one joint Gaussian, with the paths marginalised out. So the
correlations between landmarks stay, and nothing else of the robots does: others may come, and more
or fewer. When it is opened every landmark rests, as those do that no robot of a window sees: all
particles hold the same, its marginal, and the next rejuvenation goes by the joint Gaussian.
"""

from dataclasses import dataclass, replace

import numpy as np

from msg_defs.types import LandmarkMap
from multi_robot_slam.filter import rejuvenation
from multi_robot_slam.filter.covisible import Covisible
from multi_robot_slam.filter.existence import Evidence, Existence, Placed, published
from multi_robot_slam.filter.forgetting import forgotten
from multi_robot_slam.filter.landmarks import Landmarks
from multi_robot_slam.filter.looks import frames_of
from multi_robot_slam.filter.pieces import MAP
from multi_robot_slam.filter.reserved import reserved
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.filter.settled import SeenLandmarks
from multi_robot_slam.filter.snapshot import Snapshot
from multi_robot_slam.filter.state import State, best_particle
from multi_robot_slam.models.symmetric import inverses, pack, unpack
from multi_robot_slam.smoothing.aliases import Aliases
from multi_robot_slam.smoothing.prior import Prior

SHARED = 0.5
"""Share of the covariance in the plane that stands for the path's, where nothing joint is known."""


@dataclass(frozen=True, eq=False)
class KeptMap:
    """n landmarks, and what is known of them."""

    ids: np.ndarray
    """(n,) int64, ascending."""
    positions: np.ndarray
    """(n, 3) float64: mean in `map` [m]."""
    covariances: np.ndarray
    """(n, 6) float64: marginal covariance in `map` [m^2]."""
    descriptors: np.ndarray
    """(n, 128) float32."""
    observations: np.ndarray
    """(n,) int64: how often each was observed."""
    robots: np.ndarray
    """(n,) int64: bit i is set when robot i observed it."""
    published: np.ndarray
    """(n,) bool: it is likely to be there; the others are in no published map."""
    places: np.ndarray
    """(n,) int64: from how many places each was seen; this and the next four as in `Evidence`."""
    horizon: np.ndarray
    """(n,) int64."""
    found: np.ndarray
    """(n,) int64."""
    failed: np.ndarray
    """(n,) int64."""
    in_a_row: np.ndarray
    """(n,) int64."""
    together: np.ndarray
    """(n, n) bool: some frame had both."""
    information: np.ndarray
    """(n, 6) float64: of each landmark given its centre, Lambda of `Prior` [1/m^2]."""
    joint: np.ndarray
    """(2 n, 2 n) float64: covariance of the centres x, y [m^2], whose means are the positions."""
    next_id: np.ndarray
    """() int64: of the landmark that is created next."""

    def landmark_map(self) -> LandmarkMap:
        """The published map."""
        own = self.published
        return LandmarkMap(
            ids=self.ids[own].astype(np.uint32),
            positions=self.positions[own].astype(np.float32),
            covariances=self.covariances[own].astype(np.float32),
            observations=self.observations[own].astype(np.uint32),
            robots=self.robots[own].astype(np.uint32),
            descriptors=self.descriptors[own],
        )


EVIDENCE = ("places", "horizon", "found", "failed", "in_a_row")


def closed(old: Snapshot, settings: FilterSettings, rng: np.random.Generator) -> KeptMap:
    """The map as the largest group of particles has it.

    `SmoothingError` where its history cannot be smoothed.
    """
    prior, existence, covisible, seen = rejuvenation.all_settled(old, settings, rng)
    seen = replace(seen, robots=old.pieces.bits_of_team(seen.robots))
    ids, centres = np.unique(prior.ids, return_index=True)
    rows = np.searchsorted(old.held.ids, ids)
    is_in_map = old.held.pieces[rows] == MAP
    prior, descriptors = prior.of(centres[is_in_map]), old.held.descriptors[rows[is_in_map]]
    return assembled(prior, descriptors, existence, covisible, seen, old.held.next_id, settings)


def independent(state: State, settings: FilterSettings) -> KeptMap:
    """The map of the best particle (17), whose landmarks are taken for independent.

    For a filter that is never rejuvenated: it knows nothing joint.
    """
    landmarks, best = state.landmarks, best_particle(state)
    columns, values = landmarks.of_particle(best)
    lineage = [
        (record, row)
        for record, row in reversed(list(state.history.lineage(best)))
        if state.pieces.robots_in_map[record.robot]
    ]
    records, rows = [record for record, _ in lineage], [row for _, row in lineage]
    identities = [record.matches[:, row] for record, row in lineage]
    seen = state.history.settled.seen.also(records, identities)
    seen = replace(seen, robots=state.pieces.bits_of_team(seen.robots))
    is_in_map = landmarks.pieces[columns] == MAP
    columns, values = columns[is_in_map], values[is_in_map]
    ids, values = landmarks.ids[columns].astype(np.int64), values.astype(float)
    worthless = forgotten(ids, values[:, :3], seen.of_ids(ids)[0], settings.rejuvenation)
    kept = np.isin(ids, worthless, invert=True)
    ids, values, columns = ids[kept], values[kept], columns[kept]
    existence = state.existence
    if settings.existence.is_on:
        poses = [record.poses[:, row] for record, row in zip(records, rows, strict=True)]
        frames = frames_of(records, np.array(poses), identities)
        placed = Placed.of(ids, values)
        existence = existence.also(frames, placed, existence.seen(frames), settings.existence)
    covisible = state.covisible.also(records, identities, Aliases())
    prior = _independent_prior(ids, values)
    descriptors = landmarks.descriptors[columns]
    return assembled(prior, descriptors, existence, covisible, seen, landmarks.next_id, settings)


def _independent_prior(ids: np.ndarray, values: np.ndarray) -> Prior:
    """No robots, and landmarks `ids` (n,) with means and covariances `values` (n, 9)."""
    given_height = np.linalg.inv(unpack(inverses(values[:, 3:]))[:, :2, :2])
    shared = SHARED * given_height
    own = values[:, 3:] - pack(np.pad(shared, ((0, 0), (0, 1), (0, 1))))
    covariance = np.zeros((2 * len(ids), 2 * len(ids)))
    rows = np.arange(2 * len(ids)).reshape(-1, 2)
    covariance[rows[:, :, None], rows[:, None, :]] = shared
    return Prior(np.empty((0, 3)), ids, values[:, :3], inverses(own), covariance)


def assembled(
    prior: Prior,
    descriptors: np.ndarray,
    existence: Existence,
    covisible: Covisible,
    seen: SeenLandmarks,
    next_id: int,
    settings: FilterSettings,
) -> KeptMap:
    """The landmarks of `prior`, each of which has one centre, ids ascending."""
    ids = prior.ids.astype(np.int64)
    joint = prior.covariance[prior.poses.size :, prior.poses.size :]
    evidence = existence.evidence.of(ids)
    is_there = np.ones(len(ids), bool)
    if settings.existence.is_on:
        gate = settings.descriptor_gate
        is_there = published(evidence, descriptors, gate, settings.existence)
    observations, robots = seen.of_ids(ids)
    return KeptMap(
        ids,
        prior.centres,
        _marginals(prior.information, joint),
        descriptors,
        observations,
        robots,
        is_there,
        **{name: getattr(evidence, name) for name in EVIDENCE},
        together=_together(covisible, ids),
        information=prior.information,
        joint=joint,
        next_id=np.array(next_id, np.int64),
    )


def _marginals(information: np.ndarray, joint: np.ndarray) -> np.ndarray:
    """(n, 6) of the landmarks: given the centres, and what is unknown of these."""
    covariances = inverses(information)
    own = np.arange(len(joint)).reshape(-1, 2)
    blocks = joint[own[:, :, None], own[:, None, :]]
    covariances[:, [0, 1, 3]] += blocks[:, [0, 0, 1], [0, 1, 1]]
    return covariances


def _together(covisible: Covisible, ids: np.ndarray) -> np.ndarray:
    """(n, n) of the landmarks `ids` (n,), ascending."""
    together = np.zeros((len(ids), len(ids)), bool)
    own = covisible.only(ids)
    places = np.searchsorted(ids, own.ids)
    together[np.ix_(places, places)] = own.together
    return together


def opened(state: State, kept: KeptMap, settings: FilterSettings) -> None:
    """Have the robots of a new `state` begin in a map; the state is changed in place.

    `robots` of the map are those of this team, by their bits.
    """
    count = len(kept.ids)
    if not count:
        return
    shape = (count, *state.landmarks.planes.shape[1:])
    planes = reserved(shape, state.landmarks.planes.dtype)
    planes[:, :3] = kept.positions[:, :, None]
    planes[:, 3:] = kept.covariances[:, :, None]
    ids, next_id = kept.ids.astype(np.int32), int(kept.next_id)
    state.landmarks = Landmarks.holding(ids, planes, kept.descriptors.copy(), next_id, MAP)
    state.landmarks.bound(state.landmarks.alive(), settings.gate)
    starts = state.prior
    anchors = starts.poses.size
    covariance = np.zeros(2 * [anchors + len(kept.joint)])
    covariance[:anchors, :anchors], covariance[anchors:, anchors:] = starts.covariance, kept.joint
    state.prior = Prior(starts.poses, kept.ids, kept.positions, kept.information, covariance)
    evidence = Evidence(
        kept.ids,
        last_place=np.zeros(count, np.int64),
        **{name: getattr(kept, name).copy() for name in EVIDENCE},
    )
    state.existence = replace(state.existence, evidence=evidence)
    state.covisible = Covisible(kept.ids, kept.together, {})
    seen = SeenLandmarks(kept.ids, kept.observations, kept.robots)
    state.history.settled = replace(state.history.settled, seen=seen)
