"""From weights to ancestors."""

import numpy as np

from multi_robot_slam.models.compiled import kernel


def normalise(log_weights: np.ndarray) -> np.ndarray:
    """Weights (M,) that sum to one, from their logarithms up to a constant."""
    weights = np.exp(log_weights - log_weights.max())
    return weights / weights.sum()


def effective_sample_size(weights: np.ndarray) -> float:
    """1 / sum of squares of normalised weights: 1 (one particle counts) .. M (all count alike)."""
    return float(1.0 / np.square(weights).sum())


@kernel
def systematic(weights: np.ndarray, uniform: float) -> np.ndarray:
    """Systematic resampling: ancestors (M,) int32, ascending, for one `uniform` in [0, 1).

    Particle m gets floor or ceil of M * weights[m] copies. `weights` need not sum to one exactly;
    a particle of weight zero is never chosen.
    """
    count = weights.size
    ancestors = np.empty(count, np.int32)
    total = 0.0
    last = 0
    for m in range(count):
        total += weights[m]
        if weights[m] > 0:
            last = m
    spacing = total / count
    m = 0
    cumulative = weights[0]
    for n in range(count):
        target = (n + uniform) * spacing
        while m < last and (cumulative <= target):
            m += 1
            cumulative += weights[m]
        ancestors[n] = m
    return ancestors
