"""What one robot did and saw at one instant, as the filter remembers it."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


class Seen(NamedTuple):
    """The S robots that one robot sees, in its `base_link`."""

    others: np.ndarray
    """(S,) int64: index in the team; each has a frame in the same step."""
    positions: np.ndarray
    """(S, 2) float64 [m]."""
    covariances: np.ndarray
    """(S, 3) float64: xx xy yy [m^2]."""


NOBODY = Seen(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 3)))


@dataclass
class Record:
    """One robot's frame in one step; R rows, one for each particle that is still needed."""

    robot: int
    stamp_ns: int
    step: int
    motion: np.ndarray
    """(3,) float64: u since the robot's frame before."""
    positions: np.ndarray
    """(B, 3) float32: v of each observation, camera frame [m]."""
    covariances: np.ndarray
    """(B, 6) float32: R of each observation, camera frame [m^2]."""
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
    sightings: Seen = NOBODY
