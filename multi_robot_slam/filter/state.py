"""What the particle filter carries from step to step."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from multi_robot_slam.filter.covisible import Covisible
from multi_robot_slam.filter.existence import Existence
from multi_robot_slam.filter.history import History
from multi_robot_slam.filter.landmarks import Landmarks
from multi_robot_slam.filter.pieces import Pieces
from multi_robot_slam.smoothing.noise_factors import NoiseFactors
from multi_robot_slam.smoothing.odometry_scale import Scales
from multi_robot_slam.smoothing.prior import Prior
from multi_robot_slam.smoothing.solve import Smoothed


class Optimum(NamedTuple):
    """The most likely paths of the largest group, from where the next smoothing starts."""

    poses: np.ndarray
    """(P, 3) float64 in the first P records."""
    smoothed: Smoothed | None
    """Where the window begins, unless some of it has settled since."""


@dataclass
class State:
    """What the next step needs; `rbpf.step` changes it in place."""

    poses: np.ndarray
    """(K, 3, M) float64: x, y [m], yaw [rad] in the frame of the robot's piece."""
    landmarks: Landmarks
    log_weights: np.ndarray
    """(M,) float64: logarithm of the weights since the last resampling, up to a constant."""
    log_weight_sum: np.ndarray
    """(M,) float64: sum over all steps of each particle's lineage (17)."""
    history: History
    scales: Scales
    bias: Scales
    """The odometry's factors as the paths tell them, whatever is used; next to nothing is known of
    them before."""
    noise: NoiseFactors
    prior: Prior
    """What the settled frames say: of where the robots were at their end, and of landmarks."""
    existence: Existence
    """Of the landmarks, by what settled frames say."""
    pieces: Pieces
    covisible: Covisible = field(default_factory=Covisible.nothing)
    """Of the settled frames."""
    optimum: Optimum | None = None
    """What the last rejuvenation found."""
    steps: int = 0
    origins: np.ndarray = field(init=False)
    """(M,) int32: the particle right after the last rejuvenation that each descends from."""
    origin_step: int = 0
    """The step of the last rejuvenation."""

    def __post_init__(self) -> None:
        self.begin_origins()

    def begin_origins(self) -> None:
        """Count descendants from now on."""
        self.origins = np.arange(len(self.log_weights), dtype=np.int32)
        self.origin_step = self.steps


def best_particle(state: State) -> int:
    """The particle with the largest sum of log weights (17)."""
    return int(np.argmax(state.log_weight_sum))


def resample(state: State, ancestors: np.ndarray) -> None:
    """Particle m continues as particle ancestors[m]: Algorithm 1, line 10."""
    state.poses = np.take(state.poses, ancestors, axis=2)
    state.log_weight_sum = state.log_weight_sum[ancestors]
    state.log_weights = np.zeros(len(ancestors))
    state.landmarks.resample(ancestors)
    state.history.resample(ancestors)
    state.origins = state.origins[ancestors]
