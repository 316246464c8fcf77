"""Two maps of teams that knew nothing of each other become one, in the frame of the first.

Where the second lies in the first is the pose T that landmarks that look alike vote for (`vote`);
in what follows it counts as next to unknown, as where pieces are tied (Q5). Two landmarks that are
one, l_i = l_j, condition the joint Gaussian (L1) of both maps: of their centres it is observed that

    k_i - T k_j ~ N(0, Lambda_i^-1 + Lambda_j^-1)                                              (L2)

and given the centres the landmark is their mean by information, which is the new centre,

    l | k ~ N(Lambda^-1 (Lambda_i k_i + Lambda_j T k_j), Lambda^-1),  Lambda = Lambda_i + Lambda_j
                                                                                               (L3)
with Lambda_j turned. Beside those that voted all are joined that look alike and lie together by
their joint covariance, as in `smoothing.joining`.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, cho_factor, cho_solve

from multi_robot_slam.filter import vote
from multi_robot_slam.filter.covisible import Covisible
from multi_robot_slam.filter.existence import Evidence, Existence
from multi_robot_slam.filter.kept import EVIDENCE, KeptMap, assembled
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.filter.settled import SeenLandmarks
from multi_robot_slam.filter.tying import VAGUER
from multi_robot_slam.filter.vote import Points, Vote
from multi_robot_slam.models.motion import wrap
from multi_robot_slam.models.symmetric import inverses, pack, unpack
from multi_robot_slam.smoothing.aliases import Aliases
from multi_robot_slam.smoothing.joining import widened_gate
from multi_robot_slam.smoothing.prior import Prior

ROUNDS = 4
"""Of linearising the pose: what a turn by a degree leaves out after the first is 5 mm in 30 m, and
after the next nothing."""


class Merged(NamedTuple):
    """Two maps that have become one."""

    kept: KeptMap
    pose: np.ndarray
    """(3,): where the frame of the second lies in that of the first: x, y [m], yaw [rad]."""
    joined: int
    """Landmarks that both had."""


class _Joint(NamedTuple):
    """What is known of both maps' n landmarks in the frame of the first, whose come before."""

    places: np.ndarray
    """(n, 3): means of the centres [m]."""
    information: np.ndarray
    """(n, 6): Lambda [1/m^2]."""
    pose: np.ndarray
    """(3,): mean of T."""
    covariance: np.ndarray
    """(2 n + 3, 2 n + 3): of the centres x, y and T."""

    def apart(self, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far the landmarks of `pairs` (m, 2) are apart (m, 3), with covariance (m, 3, 3)."""
        spread = self.noise(pairs)
        rows = _planar(pairs)
        for a, b, sign in ((0, 0, 1), (1, 1, 1), (0, 1, -1), (1, 0, -1)):
            shared = self.covariance[rows[:, a, :, None], rows[:, b, None, :]]
            spread[:, :2, :2] += sign * shared
        return self.places[pairs[:, 0]] - self.places[pairs[:, 1]], spread

    def noise(self, pairs: np.ndarray) -> np.ndarray:
        """(m, 3, 3): covariance of what the landmarks of `pairs` are apart, given centres."""
        given = unpack(inverses(self.information))
        return given[pairs[:, 0]] + given[pairs[:, 1]]


def is_same(one: KeptMap, other: KeptMap) -> bool:
    """Both are one map, to the bit: it knows no more by being told twice."""
    names = ("ids", "descriptors", "positions", "covariances", "joint")
    return all(np.array_equal(getattr(one, n), getattr(other, n)) for n in names)


def count_shared(one: KeptMap, other: KeptMap) -> int:
    """Landmarks that both have from one observation: their descriptors are the same to the bit.

    Those of tags, which alone have no positive elements, are the same whoever sees them.
    """
    ours, theirs = (
        {row.tobytes() for row in kept.descriptors[(kept.descriptors > 0).any(axis=1)]}
        for kept in (one, other)
    )
    return len(ours & theirs)


def voted(one: KeptMap, other: KeptMap, pairs: np.ndarray) -> Vote | None:
    """Where the second map lies in the first, as landmarks that look alike (A, 2) have it."""
    ours, theirs = (Points(kept.positions, kept.covariances) for kept in (one, other))
    return vote.vote(ours, theirs, pairs) if len(pairs) >= 2 else None


def merged(
    one: KeptMap, other: KeptMap, found: Vote, pairs: np.ndarray, settings: FilterSettings
) -> Merged:
    """Both maps as one, in the frame of the first.

    Landmarks keep the id of the first map; those that the second has alone get new ones, as if they
    had been created later, in the same order.

    Parameters
    ----------
    one, other : whose robots' bits mean the same.
    found : by `voted`.
    pairs : (A, 2) rows of landmarks that look alike (`vote.pairs_alike`).

    """
    behind = np.array([0, len(one.ids)])
    pairs, joined = pairs + behind, found.pairs + behind
    limit = widened_gate(settings.gate, len(one.ids) + len(other.ids))
    while True:
        joint = _conditioned(one, other, found, joined)
        more = _also_one(joint, pairs[~np.isin(pairs, joined).any(axis=1)], limit)
        if not len(more):
            break
        joined = np.append(joined, more, axis=0)
    return Merged(_kept(one, other, joint, joined, settings), joint.pose, len(joined))


def _conditioned(one: KeptMap, other: KeptMap, found: Vote, pairs: np.ndarray) -> _Joint:
    """What is known, given that the landmarks of `pairs` (m, 2) are one (L2)."""
    pose = found.pose
    rows = _planar(pairs)
    for _ in range(ROUNDS):
        joint = _side_by_side(one, other, found, pose)
        gain = np.zeros((len(joint.covariance), len(pairs), 3))
        gain[:, :, :2] = joint.covariance[:, rows[:, 0]] - joint.covariance[:, rows[:, 1]]
        spread = np.zeros((len(pairs), 3, len(pairs), 3))
        spread[:, :2] = gain[rows[:, 0]] - gain[rows[:, 1]]
        own = np.arange(len(pairs))
        spread[own, :, own] += joint.noise(pairs)
        whole = gain.reshape(len(gain), -1)
        factor = cho_factor(spread.reshape(whole.shape[1], -1))
        apart = joint.places[pairs[:, 0]] - joint.places[pairs[:, 1]]
        moved = whole @ cho_solve(factor, apart.ravel())
        pose = joint.pose - moved[-3:]
    places = joint.places.copy()
    places[:, :2] -= moved[:-3].reshape(-1, 2)
    covariance = joint.covariance - whole @ cho_solve(factor, whole.T)
    return joint._replace(places=places, pose=pose, covariance=(covariance + covariance.T) / 2)


def _side_by_side(one: KeptMap, other: KeptMap, found: Vote, pose: np.ndarray) -> _Joint:
    """Both maps, linearised at `pose`, where the second lies as the vote says, next to unknown."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    theirs = other.positions @ turn.T
    by_pose = np.tile(np.eye(2, 3), (len(theirs), 1, 1))
    by_pose[:, 0, 2], by_pose[:, 1, 2] = -theirs[:, 1], theirs[:, 0]
    off = found.pose - pose
    off[2] = wrap(off[2])
    theirs[:, :2] += pose[:2] + by_pose @ off
    by_pose = np.concatenate([by_pose.reshape(-1, 3), np.eye(3)])
    information = pack(turn @ unpack(other.information) @ turn.T)
    blocks = other.joint.reshape(len(theirs), 2, len(theirs), 2)
    own = np.einsum("ik,akbl,jl->aibj", turn[:2, :2], blocks, turn[:2, :2], optimize=True)
    covariance = block_diag(one.joint, own.reshape(other.joint.shape), np.zeros((3, 3)))
    first = 2 * len(one.ids)
    covariance[first:, first:] += by_pose @ (VAGUER * found.covariance) @ by_pose.T
    return _Joint(
        np.concatenate([one.positions, theirs]),
        np.concatenate([one.information, information]),
        found.pose,
        covariance,
    )


def _planar(rows: np.ndarray) -> np.ndarray:
    """(..., 2): where x and y of the centres `rows` (...) are in a covariance."""
    return 2 * rows[..., None] + np.arange(2)


def _also_one(joint: _Joint, pairs: np.ndarray, limit: float) -> np.ndarray:
    """The closest of `pairs` (A, 2) with D up to `limit`, each landmark in one at most."""
    apart, spread = joint.apart(pairs)
    squared = np.einsum("ai,ai->a", apart, np.linalg.solve(spread, apart[:, :, None])[:, :, 0])
    return vote.one_to_one(pairs, squared, limit)


def _kept(
    one: KeptMap, other: KeptMap, joint: _Joint, pairs: np.ndarray, settings: FilterSettings
) -> KeptMap:
    """The map in which each of `pairs` (m, 2) is one landmark."""
    begin, count = int(one.next_id), len(other.ids)
    ids = np.append(one.ids, begin + np.arange(count))
    aliases = Aliases().joined(ids[pairs])

    def both(name: str) -> np.ndarray:
        return np.append(getattr(one, name), getattr(other, name), axis=0)

    counts = {name: both(name) for name in EVIDENCE}
    later = np.searchsorted(other.ids, other.horizon, side="right")
    counts["horizon"] = np.append(one.horizon, begin + later - 1)
    evidence = Evidence(ids, last_place=np.zeros(len(ids), np.int64), **counts)
    stays = np.ones(len(ids), bool)
    stays[pairs[:, 1]] = False
    return assembled(
        _with_means(joint, ids, pairs).of(np.flatnonzero(stays)),
        both("descriptors")[stays],
        replace(Existence.nothing(0), evidence=evidence.renamed(aliases)),
        Covisible(ids, block_diag(one.together, other.together), {}).also([], [], aliases),
        SeenLandmarks(ids, both("observations"), both("robots")).renamed(aliases),
        begin + count,
        settings,
    )


def _with_means(joint: _Joint, ids: np.ndarray, pairs: np.ndarray) -> Prior:
    """With the centre (L3) in place of the first of each of `pairs` (m, 2)."""
    one, other = pairs.T
    places, information = joint.places.copy(), joint.information.copy()
    covariance = joint.covariance[:-3, :-3].copy()
    information[one] += information[other]
    shares = np.linalg.solve(unpack(information[one])[:, None], unpack(joint.information[pairs]))
    places[one] = np.einsum("apij,apj->ai", shares, joint.places[pairs])
    rows, planar = _planar(pairs), shares[:, :, :2, :2]
    covariance[rows[:, 0]] = np.einsum("apij,apjn->ain", planar, covariance[rows])
    covariance[:, rows[:, 0]] = np.einsum("apij,napj->nai", planar, covariance[:, rows])
    return Prior(np.empty((0, 3)), ids, places, information, covariance)
