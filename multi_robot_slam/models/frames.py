"""What one robot did and saw at one instant, as the filter remembers it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from msg_defs.types import CameraMount, ObservationSet, Sightings
from multi_robot_slam.models import stereo
from multi_robot_slam.models.motion import NO_EXTRA
from multi_robot_slam.models.ranging import Ranging


class BodySightings(NamedTuple):
    """The S robots that one robot sees, in its `base_link`."""

    others: np.ndarray
    """(S,) int64: index in the team; each has a frame in the same step."""
    positions: np.ndarray
    """(S, 2) float64 [m]."""
    covariances: np.ndarray
    """(S, 3) float64: xx xy yy [m^2]."""


class Start(NamedTuple):
    """What is believed of a robot's pose at its first frame before anything is seen."""

    mean: np.ndarray
    """(3,) float64: x, y [m], yaw [rad] in `map`."""
    covariance: np.ndarray
    """(3, 3) float64 [m^2, m rad, rad^2]; zero: known."""


NOBODY = BodySightings(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 3)))


@dataclass(frozen=True, eq=False)
class RobotFrame:
    """One robot's share of a filter step: how it moved since its last frame, and what it sees.

    All is in the robot's `base_link`: the filter knows no camera.
    """

    robot: int
    """Index in the team."""
    stamp_ns: int
    motion: np.ndarray
    """(3,) float64: u = (dx, dy, dyaw) in the robot's previous `base_link` [m, m, rad]."""
    positions: np.ndarray
    """(B, 3) float64: v' of each observation [m]."""
    covariances: np.ndarray
    """(B, 6) float64: R' of each observation [m^2]."""
    descriptors: np.ndarray
    """(B, 128) float32: d of each observation."""
    seconds: float = 0.0
    """How long the motion took [s]."""
    sightings: BodySightings = NOBODY
    """Robots it sees, each of which has a frame at the same instant."""
    ranging: Ranging | None = None
    """None: the covariances are what they are, at whatever distance a point truly is."""
    extra: np.ndarray = field(default_factory=lambda: NO_EXTRA)
    """(3,) float64: standard deviations of what gaps in the odometry hide [m, m, rad]."""
    start: Start | None = None
    """In the robot's first frame, whose motion is zero."""

    @classmethod
    def from_camera(
        cls,
        robot: int,
        motion: np.ndarray,
        seconds: float,
        observations: ObservationSet,
        mount: CameraMount,
        sightings: Sightings | None = None,
        extra: np.ndarray = NO_EXTRA,
        start: Start | None = None,
    ) -> "RobotFrame":
        """The frame of what a camera at `mount` saw, after `motion` (3,) that took `seconds`."""
        return cls(
            robot,
            observations.stamp_ns,
            motion,
            *stereo.to_body(observations.positions, observations.covariances, mount),
            observations.descriptors,
            seconds,
            in_body(sightings, mount),
            Ranging.of(observations.positions, observations.covariances, mount),
            extra,
            start,
        )

    def called(self, indices: Sequence[int]) -> "RobotFrame":
        """With the index that `indices` (K,) has for each robot of the team."""
        seen = self.sightings
        if seen is not NOBODY:
            seen = seen._replace(others=np.array(indices, np.int64)[seen.others])
        return replace(self, robot=indices[self.robot], sightings=seen)

    def with_noise(self, factor: float) -> "RobotFrame":
        """With `factor` times the standard deviations of the observations."""
        if factor == 1:
            return self
        covariances, ranging = factor**2 * self.covariances, self.ranging
        if ranging is not None:
            ranging = ranging._replace(along=factor * ranging.along)
        return replace(self, covariances=covariances, ranging=ranging)


def in_body(sightings: Sightings | None, mount: CameraMount) -> BodySightings:
    """The sightings in `base_link`; at which height a robot was seen says nothing of its pose."""
    if sightings is None:
        return NOBODY
    positions, covariances = stereo.to_body(sightings.positions, sightings.covariances, mount)
    others = sightings.others.astype(np.int64)
    return BodySightings(others, positions[:, :2], covariances[:, [0, 1, 3]])


@dataclass
class Record:
    """One robot's frame in one step; R rows, one for each particle that is still needed."""

    robot: int
    stamp_ns: int
    step: int
    motion: np.ndarray
    """(3,) float64: u since the robot's frame before."""
    positions: np.ndarray
    """(B, 3) float64: v' of each observation, in `base_link` [m]."""
    covariances: np.ndarray
    """(B, 6) float64: R' of each observation, in `base_link` [m^2]."""
    poses: np.ndarray
    """(3, R) float64."""
    matches: np.ndarray
    """(B, R) int32: id of the landmark each observation updated or created."""
    new_ids: np.ndarray
    """(B,) int32: id of the landmark that each observation would have created."""
    parents: np.ndarray
    """(R,) int32: row in the record before."""
    seconds: float = 0.0
    """How long the motion took [s]."""
    sightings: BodySightings = NOBODY
    ranging: Ranging | None = None
    extra: np.ndarray = field(default_factory=lambda: NO_EXTRA)
    """(3,) float64: as of the frame."""
    start: Start | None = None

    def with_rows(self, poses: np.ndarray, matches: np.ndarray, parents: np.ndarray) -> "Record":
        """The same frame with other rows: `poses` (3, R), `matches` (B, R), `parents` (R,)."""
        return replace(self, poses=poses, matches=matches, parents=parents)
