"""What a history of frames measured, in the form that smoothing solves."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from multi_robot_slam.models.frames import NOBODY, Record
from multi_robot_slam.models.motion import MotionSettings, standard_deviations
from multi_robot_slam.models.symmetric import inverses
from multi_robot_slam.smoothing.prior import SMALLEST_SIGMA, Active, Prior


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


@dataclass(frozen=True, eq=False)
class Problem:
    """What was measured, and what was known before.

    A + P poses: anchors, then those of P records; N landmarks with O observations, ordered by
    landmark. V = A + P + a views: the poses, then a centres, each with one observation of its own.
    """

    prior: Active
    """Of the anchors and centres."""
    robots: np.ndarray
    """(A + P,) int64: index of the robot."""
    previous: np.ndarray
    """(P,) int64: the pose before that of each record, smaller than its own."""
    motions: np.ndarray
    """(P, 3) float64: u since the pose before, in its body frame [m, m, rad]."""
    sigmas: np.ndarray
    """(P, 3) float64: standard deviations of `motions`, above zero."""
    seen_from: np.ndarray
    """(O,) int64: view of each observation, ascending within a landmark."""
    starts: np.ndarray
    """(N + 1,) int64: landmark n has the observations starts[n] .. starts[n + 1] - 1."""
    positions: np.ndarray
    """(O, 3) float64: v in `base_link`; of centres: (0, 0, k_z) [m]."""
    information: np.ndarray
    """(O, 6) float64: R^-1 in the same frame; of centres: Lambda [1/m^2]."""
    ids: np.ndarray
    """(N,) int64: identity of each landmark, ascending."""
    sighted: PoseSightings = field(default_factory=PoseSightings.none)
    with_gaps: np.ndarray | None = None
    """(P,) bool: motions whose sigmas hold what a gap hides; None: of none."""

    @property
    def anchors(self) -> np.ndarray:
        """(A,) int64: robots whose anchors are the first poses."""
        return self.prior.robots

    @property
    def poses(self) -> int:
        """A + P, also the first view that is a centre."""
        return len(self.robots)

    @property
    def columns(self) -> np.ndarray:
        """(V + 1,) int64: views begin at these among the rows of poses, 3 each, and centres, 2."""
        centres = 3 * self.poses + 2 * np.arange(len(self.prior.rows) + 1)
        return np.append(3 * np.arange(self.poses), centres)

    @property
    def prior_columns(self) -> np.ndarray:
        """(3 A + 2 a,) int64: rows of anchors and centres among those of all views."""
        columns = self.columns
        anchors = np.arange(3 * len(self.anchors))
        return np.append(anchors, np.arange(columns[self.poses], columns[-1]))

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


def problem_of(
    records: Sequence[Record],
    identities: Sequence[np.ndarray],
    prior: Prior,
    noise: MotionSettings,
    factors: np.ndarray | None = None,
    also: Sequence[int] | np.ndarray = (),
    covariances: np.ndarray | None = None,
    noisier: np.ndarray | None = None,
) -> Problem:
    """The problem that a history poses.

    Parameters
    ----------
    records : P frames of all robots, oldest first.
    identities : for each record (B,), which landmark each observation is of; below 0: of none, a
        gross error.
    prior : what is known of the poses before the first records, and of landmarks. Of its landmarks
        the problem holds those in `identities`, those in `also`, and those with several centres.
    factors : (K, 2) of the odometry's distances and turns; default: none.
    also : ids of landmarks that the problem shall hold although no record names them.
    covariances : (O, 6) of all observations in the records' order [m^2], instead of the records'.
    noisier : (K, 2) factors on the standard deviations of the odometry and of the observations;
        default: none.

    """
    robots = np.array([record.robot for record in records], np.int64)
    anchors = np.arange(len(prior.poses))
    motions = np.array([record.motion for record in records], float).reshape(-1, 3)
    seconds = np.array([record.seconds for record in records])
    extra = np.array([record.extra for record in records]).reshape(-1, 3)
    noisier = np.ones((len(prior.poses), 2)) if noisier is None else noisier
    sigmas = standard_deviations(motions.T, seconds, noise, extra.T, noisier[robots, 0]).T
    if factors is not None:
        motions = motions * factors[robots][:, [0, 0, 1]]
    named = np.concatenate([np.empty(0, np.int64), *identities]).astype(np.int64)
    active = prior.active(anchors, _active_centres(prior.ids, np.append(named, also)))
    counts = [len(record.positions) for record in records]
    views = len(anchors) + len(records) + np.arange(len(active.ids))
    seen_from = np.append(np.repeat(len(anchors) + np.arange(len(records)), counts), views)
    seen = np.append(named, active.ids)
    positions = np.concatenate([np.empty((0, 3)), *(record.positions for record in records)])
    if covariances is None:
        own = [record.covariances for record in records]
        covariances = np.concatenate([np.empty((0, 6)), *own])
    covariances = covariances * np.square(noisier[np.repeat(robots, counts), 1])[:, None]
    order = np.argsort(seen, kind="stable")
    order = order[np.searchsorted(seen[order], 0) :]
    ids, first = np.unique(seen[order], return_index=True)
    information = np.concatenate([inverses(covariances), active.landmark_information])
    all_robots = np.append(anchors, robots)
    return Problem(
        prior=active,
        robots=all_robots,
        previous=_previous(all_robots)[len(anchors) :],
        motions=motions,
        sigmas=np.maximum(sigmas, SMALLEST_SIGMA),
        seen_from=seen_from[order],
        starts=np.append(first, len(order)),
        positions=np.concatenate([positions, active.centres * [0, 0, 1]])[order],
        information=information[order],
        ids=ids,
        sighted=_sighted(records, len(anchors)),
        with_gaps=np.any(extra > 0, axis=1),
    )


def views_of(poses: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """(V, 3): poses (A + P, 3), then centres (a, 2 or 3) as poses that never turn."""
    return np.concatenate([poses, np.pad(centres[:, :2], ((0, 0), (0, 1)))])


def _active_centres(ids: np.ndarray, named: np.ndarray) -> np.ndarray:
    """Rows of those `ids` (n,) that are `named` or there several times."""
    _, places, counts = np.unique(ids, return_inverse=True, return_counts=True)
    return np.flatnonzero(np.isin(ids, named) | (counts[places] > 1))


def _previous(robots: np.ndarray) -> np.ndarray:
    """The pose before of the same robot, -1 where there is none."""
    previous = np.full(len(robots), -1)
    for robot in np.unique(robots):
        own = np.flatnonzero(robots == robot)
        previous[own[1:]] = own[:-1]
    return previous


def _sighted(records: Sequence[Record], first: int) -> PoseSightings:
    """The sightings of all records, the first of which is pose `first`.

    A robot that is seen has a record of the same step.
    """
    pose_of = {(record.step, record.robot): first + p for p, record in enumerate(records)}
    sightings = [record.sightings for record in records]
    own = np.repeat(np.arange(len(records)), [len(seen.others) for seen in sightings])
    others = np.concatenate([NOBODY.others, *(seen.others for seen in sightings)])
    seen = [
        pose_of[records[p].step, other]
        for p, other in zip(own.tolist(), others.tolist(), strict=True)
    ]
    positions = np.concatenate([NOBODY.positions, *(seen.positions for seen in sightings)])
    covariances = np.concatenate([NOBODY.covariances, *(seen.covariances for seen in sightings)])
    xx, xy, yy = covariances.T
    information = np.column_stack([yy, -xy, xx]) / (xx * yy - xy * xy)[:, None]
    return PoseSightings(first + own, np.array(seen, np.int64), positions, information)
