"""The rows of the benchmark: what each is called, and what it is to reach."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
}

TARGETS = {
    "particle_observation_ns_motion": ("ns", "<=", 20.0),
    "particle_observation_ns_informed": ("ns", "<=", 20.0),
    "step_ms_m2000_k3": ("ms", "<=", 5.0),
    "resample_share_m2000_k3": ("share", "<=", 0.2),
    "map_growth_ratio": ("times", "<=", 1.2),
    "growth_pause_ms": ("ms", "<=", 20.0),
    "speedup_over_literal": ("times", ">=", 1000.0),
    "speedup_over_textbook": ("times", ">=", 3000.0),
    "step_ms_m100_k1": ("ms", "<=", 0.5),
    "step_ms_m500_k1_frame": ("ms", "<=", 0.45),
    "state_mb_m2000_n1000": ("MB", "<=", 150.0),
    "first_step_s": ("s", "<=", 2.0),
    "cpu_s_per_s_k3": ("s/s", "<=", 0.15),
    "cpu_s_per_s_k10": ("s/s", "<=", 0.6),
    "rejuvenation_ratio": ("times", "<=", 4.0),
    "rejuvenation_ratio_thread": ("times", "<=", 2.0),
    "run_times_real_time": ("times", ">=", 100.0),
    "run_times_real_time_rejuvenated": ("times", ">=", 30.0),
}
"""Name of each row -> unit, direction, target."""


@dataclass(frozen=True)
class Row:
    """One figure. `limit` is what the rates of this machine would allow, in the same unit."""

    name: str
    value: float
    unit: str
    target: float
    limit: float
    spread: tuple[float, float]
    met: bool
    note: str


def row_of(
    name: str,
    values: Sequence[float] | np.ndarray,
    limit: float,
    note: str,
    value: float | None = None,
) -> Row:
    """The row of a figure: the median of its `values`, or `value`, and their spread."""
    unit, direction, target = TARGETS[name]
    value = float(np.median(values) if value is None else value)
    met = value <= target if direction == "<=" else value >= target
    low, high = np.quantile(values, [0.1, 0.9])
    return Row(name, value, unit, target, float(limit), (float(low), float(high)), met, note)
