"""The state at one step, for a rejuvenation that is done while the filter goes on."""

from dataclasses import dataclass

import numpy as np

from multi_robot_slam.filter import new_map, resampling
from multi_robot_slam.filter.covisible import Covisible
from multi_robot_slam.filter.existence import Existence
from multi_robot_slam.filter.history import History
from multi_robot_slam.filter.new_map import Held
from multi_robot_slam.filter.pieces import Pieces
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.filter.state import Optimum, State
from multi_robot_slam.smoothing.noise_factors import NoiseFactors
from multi_robot_slam.smoothing.odometry_scale import Scales
from multi_robot_slam.smoothing.prior import Prior


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The state at one step, resampled, on which later steps have no effect."""

    steps: int
    poses: np.ndarray
    """(K, 3, M)."""
    log_weight_sum: np.ndarray
    """(M,)."""
    history: History
    scales: Scales
    bias: Scales
    noise: NoiseFactors
    prior: Prior
    existence: Existence
    pieces: Pieces
    covisible: Covisible
    optimum: Optimum | None
    groups: tuple[np.ndarray, ...]
    """Particles (n,) of each association history, the largest group first."""
    held: Held
    """The landmarks, as the particles hold them that are not of the largest group."""


def taken(state: State, settings: FilterSettings, rng: np.random.Generator) -> Snapshot:
    """What a rejuvenation of the particles, resampled now, has to know."""
    weights = resampling.normalise(state.log_weights)
    ancestors = resampling.systematic(weights, rng.random())
    history = state.history.copy()
    history.resample(ancestors)
    groups = _groups(history.signatures)
    is_shared = len(groups[0]) >= settings.rejuvenation.share * len(weights)
    others = (
        np.sort(np.concatenate([np.empty(0, int), *groups[1:]])) if is_shared else groups[0][:0]
    )
    held = new_map.held(state.landmarks, others, ancestors[others], ancestors[groups[0][0]])
    lost = np.setdiff1d(state.prior.ids, held.ids)
    return Snapshot(
        state.steps,
        np.take(state.poses, ancestors, axis=2),
        state.log_weight_sum[ancestors],
        history,
        state.scales,
        state.bias,
        state.noise,
        state.prior.forget(lost) if len(lost) else state.prior,
        state.existence,
        state.pieces,
        state.covisible,
        state.optimum,
        tuple(groups),
        held,
    )


def _groups(signatures: np.ndarray) -> list[np.ndarray]:
    """The particles of each association history, the largest group first."""
    order = np.argsort(signatures, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(signatures[order])) + 1)
    return sorted(groups, key=len, reverse=True)
