"""A recorded team of planar robots that measure range and bearing, whatever file it came from."""

from dataclasses import dataclass

import numpy as np

from msg_defs.types import CameraMount, Trajectory


@dataclass(frozen=True, eq=False)
class Commands:
    """Velocities that hold from their stamp until the next one."""

    stamps_ns: np.ndarray
    """(C,) int64, ascending."""
    forward: np.ndarray
    """(C,) float64 [m/s]."""
    yaw_rate: np.ndarray
    """(C,) float64 [rad/s]."""


@dataclass(frozen=True, eq=False)
class Readings:
    """R range-bearing measurements of known things, by time."""

    stamps_ns: np.ndarray
    """(R,) int64, ascending."""
    targets: np.ndarray
    """(R,) int64: row of the landmark, or index in the team of the robot."""
    ranges: np.ndarray
    """(R,) float64, from the sensor [m]."""
    bearings: np.ndarray
    """(R,) float64, to the left [rad]."""

    def __getitem__(self, rows: np.ndarray) -> "Readings":
        parts = self.stamps_ns, self.targets, self.ranges, self.bearings
        return Readings(*(part[rows] for part in parts))

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True, eq=False)
class RobotLog:
    """What one robot recorded, and where it truly was."""

    commands: Commands
    truth: Trajectory
    landmarks: Readings
    robots: Readings
    unknown: int = 0
    """Readings of something that is neither."""


@dataclass(frozen=True)
class Noise:
    """How good a robot's sensor and odometry are."""

    range_m: float
    """Standard deviation of a range of 0 m [m]."""
    range_per_m: float
    """How much it grows with the range [m/m]."""
    bearing_rad: float
    range_memory_s: float
    """After this time the correlation of two range errors of one target is 1/e; 0: none [s]."""
    forward_per_sqrt_s: float
    """Of odometry [m/sqrt(s)]."""
    left_per_sqrt_s: float
    yaw_per_sqrt_s: float
    """Of odometry [rad/sqrt(s)]."""
    scale_sigma: float = 0.0
    """Standard deviation of odometry's unknown factors of distances and turns, around 1."""


@dataclass(frozen=True, eq=False)
class Recording:
    """A team, its landmarks, and its noise."""

    robots: dict[str, RobotLog]
    """In the team's order."""
    landmarks: np.ndarray
    """(N, 2) float64: true x, y in `map` [m]."""
    landmark_ids: np.ndarray
    """(N,) uint32: their numbers in the source."""
    noise: Noise
    mount: CameraMount
