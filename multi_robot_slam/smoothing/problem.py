"""What a history of frames measured, in the form that smoothing solves."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from multi_robot_slam.models.frames import NOBODY, Record
from multi_robot_slam.models.motion import MotionSettings, standard_deviations
from multi_robot_slam.models.symmetric import inverses

SMALLEST_SIGMA = 1e-5
"""Floor of odometry's standard deviations [m, rad].

A robot that stood still has exact odometry; the information must stay finite all the same. A
hundredth of a millimetre is nothing beside what any camera sees.
"""

MAP = -1
"""Stands for the pose of an observation whose position is in `map` already."""


class PoseSightings(NamedTuple):
    """S observations of robots by robots: which pose saw the `base_link` of which other one."""

    seen_from: np.ndarray
    """(S,) int64: pose of the robot that sees."""
    seen: np.ndarray
    """(S,) int64: pose of the robot that is seen."""
    positions: np.ndarray
    """(S, 2) float64: s in the `base_link` of `seen_from` [m]."""
    information: np.ndarray
    """(S, 3) float64: inverse of its covariance, `xx xy yy` [1/m^2]."""

    @classmethod
    def none(cls) -> "PoseSightings":
        return cls(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 3)))


class Observations(NamedTuple):
    """O observations of N landmarks, ordered by landmark; the arrays of `Problem`."""

    starts: np.ndarray
    """(N + 1,) int64."""
    seen_from: np.ndarray
    """(O,) int64."""
    positions: np.ndarray
    """(O, 3)."""
    information: np.ndarray
    """(O, 6), times the observations' weights."""


class Known(NamedTuple):
    """What is known of n landmarks from poses that no longer move."""

    ids: np.ndarray
    """(n,) int64: identities, ascending."""
    positions: np.ndarray
    """(n, 3) float64: mean in `map` [m]."""
    information: np.ndarray
    """(n, 6) float64: inverse of the covariance [1/m^2]."""

    @classmethod
    def nothing(cls) -> "Known":
        return cls(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 6)))


@dataclass(frozen=True, eq=False)
class Problem:
    """What was measured: P poses of K robots, O observations of N landmarks, ordered by landmark.

    Every pose follows another one of the same robot, or the robot's known start pose.
    """

    start_poses: np.ndarray
    """(K, 3) float64: x, y [m], yaw [rad] in `map`, known exactly."""
    robots: np.ndarray
    """(P,) int64: index of the robot."""
    previous: np.ndarray
    """(P,) int64: the pose before, -1 for the start pose; always smaller than the own index."""
    motions: np.ndarray
    """(P, 3) float64: u since the pose before, in its body frame [m, m, rad]."""
    sigmas: np.ndarray
    """(P, 3) float64: standard deviations of `motions`, above zero."""
    seen_from: np.ndarray
    """(O,) int64: pose of each observation, or MAP; ascending within a landmark."""
    starts: np.ndarray
    """(N + 1,) int64: landmark n has the observations starts[n] .. starts[n + 1] - 1."""
    positions: np.ndarray
    """(O, 3) float64: v in `base_link` (of MAP: in `map`) [m]."""
    information: np.ndarray
    """(O, 6) float64: R^-1 in the same frame [1/m^2]."""
    ids: np.ndarray
    """(N,) int64: identity of each landmark, ascending."""
    sighted: PoseSightings = field(default_factory=PoseSightings.none)

    @property
    def landmarks(self) -> np.ndarray:
        """(O,) int64: index of the landmark of each observation."""
        return np.repeat(np.arange(len(self.ids)), np.diff(self.starts))

    def observations(self, weights: np.ndarray | None = None) -> Observations:
        """With `weights` (O + S,), the first O of them, on the information."""
        information = self.information
        if weights is not None:
            information = information * weights[: len(information), None]
        return Observations(self.starts, self.seen_from, self.positions, information)

    def sightings(self, weights: np.ndarray | None = None) -> PoseSightings:
        """With `weights` (O + S,), the last S of them, on the information."""
        if weights is None:
            return self.sighted
        information = self.sighted.information * weights[len(self.positions) :, None]
        return self.sighted._replace(information=information)

    def poses_before(self, poses: np.ndarray) -> np.ndarray:
        """(P, 3): the pose that each of `poses` (P, 3) follows."""
        starts = self.start_poses[self.robots]
        return np.where(self.previous[:, None] < 0, starts, poses[self.previous])


def problem_of(
    records: Sequence[Record],
    identities: Sequence[np.ndarray],
    start_poses: np.ndarray,
    noise: MotionSettings,
    known: Known | None = None,
    factors: np.ndarray | None = None,
) -> Problem:
    """The problem that a history poses.

    Parameters
    ----------
    records : P frames of all robots, oldest first.
    identities : for each record (B,), which landmark each observation is of; below 0: of none, a
        gross error.
    start_poses : (K, 3).
    known : what older poses say of landmarks (`marginals.marginalise`); ids in any order.
    factors : (K, 2) of the odometry's distances and turns; default: none.

    """
    known = known or Known.nothing()
    robots = np.array([record.robot for record in records], np.int64)
    motions = np.array([record.motion for record in records], float).reshape(-1, 3)
    seconds = np.array([record.seconds for record in records])
    sigmas = standard_deviations(motions.T, seconds, noise).T
    if factors is not None:
        motions = motions * factors[robots][:, [0, 0, 1]]
    counts = [len(record.positions) for record in records]
    seen_from = np.concatenate(
        [np.full(len(known.ids), MAP), np.repeat(np.arange(len(records)), counts)]
    )
    seen = np.concatenate([known.ids, *identities]).astype(np.int64)
    positions = np.concatenate([np.empty((0, 3)), *(record.positions for record in records)])
    covariances = np.concatenate([np.empty((0, 6)), *(record.covariances for record in records)])
    order = np.argsort(seen, kind="stable")
    order = order[np.searchsorted(seen[order], 0) :]
    ids, first = np.unique(seen[order], return_index=True)
    return Problem(
        start_poses=np.asarray(start_poses, float),
        robots=robots,
        previous=_previous(robots),
        motions=motions,
        sigmas=np.maximum(sigmas, SMALLEST_SIGMA),
        seen_from=seen_from[order],
        starts=np.append(first, len(order)),
        positions=np.concatenate([known.positions, positions])[order],
        information=np.concatenate([known.information, inverses(covariances)])[order],
        ids=ids,
        sighted=_sighted(records),
    )


def with_map(poses: np.ndarray) -> np.ndarray:
    """`poses` (P, 3) and, at the end, the one that MAP stands for."""
    return np.concatenate([poses, np.zeros((1, 3))])


def _previous(robots: np.ndarray) -> np.ndarray:
    """(P,) the pose before of the same robot, -1 where there is none."""
    previous = np.full(len(robots), -1)
    for robot in np.unique(robots):
        own = np.flatnonzero(robots == robot)
        previous[own[1:]] = own[:-1]
    return previous


def _sighted(records: Sequence[Record]) -> PoseSightings:
    """The sightings of all records; a robot seen has a record of the same step."""
    pose_of = {(record.step, record.robot): p for p, record in enumerate(records)}
    sightings = [record.sightings for record in records]
    seen_from = np.repeat(np.arange(len(records)), [len(seen.others) for seen in sightings])
    others = np.concatenate([NOBODY.others, *(seen.others for seen in sightings)])
    seen = [
        pose_of[records[p].step, other]
        for p, other in zip(seen_from.tolist(), others.tolist(), strict=True)
    ]
    positions = np.concatenate([NOBODY.positions, *(seen.positions for seen in sightings)])
    covariances = np.concatenate([NOBODY.covariances, *(seen.covariances for seen in sightings)])
    xx, xy, yy = covariances.T
    information = np.column_stack([yy, -xy, xx]) / (xx * yy - xy * xy)[:, None]
    return PoseSightings(seen_from, np.array(seen, np.int64), positions, information)
