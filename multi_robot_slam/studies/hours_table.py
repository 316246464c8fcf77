"""The table of the study of hours, `hours.csv`, and its summary."""

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from multi_robot_slam.studies import table

PARTS = 10
"""The rows of a run are a multiple of so many: what is compared are tenths of it."""
POSE = 3
"""Degrees of freedom of a pose."""
RATIO = 1.1
"""Most that a figure may have grown, and that published poses may be worse than the optimum."""
MOST_MB = 500.0
HEAD = ("minutes", "position [m]", "heading [rad]", "with predictions [m]", "NEES mean", "median")
MORE = (
    *("step [ms]", "longest [ms]", "cpu [s/s]", "pictures [ms]", "memory [MB]"),
    *("landmarks", "settled", "rejuvenations"),
)
"""Columns of the summary, before and after the bounds of NEES."""


@dataclass(frozen=True)
class Row:
    """One part of one run."""

    robots: int
    particles: int
    seed: int
    part: int
    from_s: float
    to_s: float
    steps: int
    rejuvenations: int
    position_rmse_m: float
    """Of the poses published at steps."""
    heading_rmse_rad: float
    all_position_rmse_m: float
    """Of these and the predictions in between."""
    all_heading_rmse_rad: float
    nees_mean: float
    """Of the poses published at steps; 3 for an honest filter."""
    nees_median: float
    step_ms_mean: float
    """Processor time of all threads."""
    step_ms_max: float
    """Time that passed."""
    cpu_s_per_s: float
    """Processor time for all messages of a second."""
    pictures_ms_mean: float
    """Time that passed for one map and all paths, which a live filter publishes every second."""
    memory_mb: float
    """Resident memory of the process at the end of the part, the simulation's included."""
    landmarks: int
    settled: int
    """Frames that have left the window at the end of the part."""
    dropped: int
    """Events and messages lost so far."""
    published_m: float | None
    """RMS over the robots of the error of their last published poses at the end of the part."""
    optimum_m: float | None
    """The same of least squares with the true associations of everything up to there."""


COLUMNS = tuple(field.name for field in fields(Row))
TYPES = table.types_of(Row)
Key = tuple[int, int, int, int]
"""Robots, particles, seed, part: the first columns."""


def key_of(row: Row) -> Key:
    """What sets the row apart."""
    return row.robots, row.particles, row.seed, row.part


def opened(path: Path) -> table.Table[Key, Row]:
    """The table at `path`."""
    form = table.Format(",".join(COLUMNS), lambda _, row: table.line(astuple(row)), _from_line)
    return table.Table(path, form)


def _from_line(text: str) -> tuple[Key, Row]:
    row = Row(*table.cells(text, COLUMNS, TYPES))
    return key_of(row), row


def bounds(runs: int) -> tuple[float, float]:
    """Between these lies the mean NEES of an honest filter over so many runs, 19 times of 20.

    Each run counts as one independent sample, however many poses there are: they have their errors
    in common. So the same bounds hold for the median over a part, whose samples are then one.
    """
    low, high = chi2.ppf([0.025, 0.975], POSE * runs) / runs
    return float(low), float(high)


def markdown(rows: Sequence[Row]) -> str:
    """The table over time, and what it is to reach.

    Errors are RMS over the seeds, NEES, times and memory means, longest steps the longest.
    """
    parts = _by_part(rows)
    seeds, (low, high) = len(parts[0]), bounds(len(parts[0]))
    names = [*HEAD, f"bounds of {seeds}", *MORE]
    lines = [f"| {' | '.join(names)} |", f"|{'---:|' * len(names)}"]
    for part in parts:
        cells = (
            f"{part[0].from_s / 60:.4g} .. {part[0].to_s / 60:.4g}",
            f"{_rms(part, lambda row: row.position_rmse_m):.4f}",
            f"{_rms(part, lambda row: row.heading_rmse_rad):.5f}",
            f"{_rms(part, lambda row: row.all_position_rmse_m):.4f}",
            f"{_mean(part, lambda row: row.nees_mean):.2f}",
            f"{_mean(part, lambda row: row.nees_median):.2f}",
            f"{low:.2f} .. {high:.2f}",
            f"{_mean(part, lambda row: row.step_ms_mean):.2f}",
            f"{max(row.step_ms_max for row in part):.0f}",
            f"{_mean(part, lambda row: row.cpu_s_per_s):.3f}",
            f"{_mean(part, lambda row: row.pictures_ms_mean):.1f}",
            f"{_mean(part, lambda row: row.memory_mb):.0f}",
            f"{_mean(part, lambda row: row.landmarks):.0f}",
            f"{_mean(part, lambda row: row.settled):.0f}",
            f"{_mean(part, lambda row: row.rejuvenations):.0f}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", *_summary(parts)]) + "\n"


def _summary(parts: list[list[Row]]) -> list[str]:
    """Each figure against its target."""
    low, high = bounds(len(parts[0]))
    means = [_mean(part, lambda row: row.nees_mean) for part in parts]
    medians = [_mean(part, lambda row: row.nees_median) for part in parts]
    inside = [sum(low <= nees <= high for nees in found) for found in (means, medians)]
    growth = {
        "step time": _growth(parts, lambda row: row.step_ms_mean),
        "memory": _growth(parts, lambda row: row.memory_mb),
    }
    most = max(row.memory_mb for part in parts for row in part)
    first = parts[0][0]
    figures = [
        *(
            (f"{name}, last tenth over the second", f"{value:.2f}", f"<= {RATIO}", value <= RATIO)
            for name, value in growth.items()
        ),
        ("most memory [MB]", f"{most:.0f}", f"<= {MOST_MB:g}", most <= MOST_MB),
        *(
            (f"parts with their {name} NEES inside", f"{n} of {len(parts)}", "all", n == len(parts))
            for name, n in zip(("mean", "median"), inside, strict=True)
        ),
        *_optimum(parts),
    ]
    title = f"{first.robots} robots, M = {first.particles}, {len(parts[0])} seeds"
    lines = [f"| {title} | value | target | met |", "|---|---:|---|---|"]
    return lines + [
        f"| {name} | {value} | {target} | {'yes' if met else '**no**'} |"
        for name, value, target, met in figures
    ]


def _optimum(parts: list[list[Row]]) -> list[tuple[str, str, str, bool]]:
    """Published poses over the optimum, over all ends of parts where it is known."""
    known = [
        (row.published_m, row.optimum_m)
        for part in parts
        for row in part
        if row.published_m is not None and row.optimum_m is not None
    ]
    if not known:
        return []
    published, optimum = np.sqrt(np.mean(np.square(known), axis=0))
    ratio = float(published / optimum)
    what = f"published over the filtering optimum, {len(known)} instants"
    return [(what, f"{ratio:.3f}", f"<= {RATIO}", ratio <= RATIO)]


def _growth(parts: list[list[Row]], figure: Callable[[Row], float]) -> float:
    """The mean of a figure over the last tenth over that of the second tenth."""
    each = len(parts) // PARTS
    last, second = parts[-each:], parts[each : 2 * each]
    means = [np.mean([_mean(part, figure) for part in tenth]) for tenth in (last, second)]
    return float(means[0] / means[1])


def _by_part(rows: Sequence[Row]) -> list[list[Row]]:
    parts = sorted({row.part for row in rows})
    return [[row for row in rows if row.part == part] for part in parts]


def _mean(rows: Sequence[Row], figure: Callable[[Row], float]) -> float:
    return float(np.mean([figure(row) for row in rows]))


def _rms(rows: Sequence[Row], figure: Callable[[Row], float]) -> float:
    return float(np.sqrt(np.mean(np.square([figure(row) for row in rows]))))
