"""The table of the accuracy study, `accuracy.csv`, and its summary."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np

from msg_defs.errors import InputError
from multi_robot_slam.studies import table

REJUVENATED = "rejuvenated"


@dataclass(frozen=True)
class Row:
    """Figures of one run."""

    filter: str
    robots: int
    particles: int
    seed: int
    odometry_path_rmse_m: float
    batch_path_rmse_m: float
    path_rmse_m: float
    mean_path_rmse_m: float
    refined_path_rmse_m: float
    online_path_rmse_m: float
    optimum_ratio: float
    """RMS error of the poses as published over that of the filtering optimum, at its instants."""
    association_precision: float
    association_recall: float
    pose_nees: float
    landmark_nees: float
    ancestors: int
    """Distinct ancestors at a tenth of the run, of the particles at its end."""
    step_ms_mean: float
    step_ms_max: float


COLUMNS = tuple(field.name for field in fields(Row))
TYPES = table.types_of(Row)
Key = tuple[str, int, int, int]
"""Filter, robots, particles, seed: the first columns."""


def key_of(row: Row) -> Key:
    """What sets the row apart."""
    return row.filter, row.robots, row.particles, row.seed


def opened(path: Path) -> table.Table[Key, Row]:
    """The table at `path`."""
    form = table.Format(",".join(COLUMNS), lambda _, row: table.line(astuple(row)), _from_line)
    return table.Table(path, form)


def _from_line(text: str) -> tuple[Key, Row]:
    cells = table.cells(text, COLUMNS, TYPES)
    if None in cells:
        raise InputError(f"a cell is empty in '{text.strip()}'; remove the row")
    row = Row(*cells)
    return key_of(row), row


def markdown(rows: Sequence[Row]) -> str:
    """The table of `docs/results.md`: mean ± standard deviation over the seeds.

    NEES is the mean over the seeds where particles are rejuvenated, and the median elsewhere: that
    of a particle set that has collapsed to a point is beyond all bounds, and its mean would say
    nothing.
    """
    head = (
        "filter",
        "K",
        "M",
        "yardstick [m]",
        "odometry",
        "best particle",
        "mean",
        "refined",
        "published",
        "published / optimum",
        "recall",
        "pose NEES",
        "landmark NEES",
        "ancestors",
    )
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 1)]
    groups: dict[tuple[str, int, int], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.filter, row.robots, row.particles), []).append(row)
    for key, group in groups.items():
        lines.append("| " + " | ".join([*map(str, key), *_cells(group)]) + " |")
    return "\n".join(lines) + "\n"


def _cells(group: list[Row]) -> list[str]:
    batch = _column(group, "batch_path_rmse_m")
    kinds = ("odometry_", "", "mean_", "refined_", "online_")
    centre = np.mean if group[0].filter == REJUVENATED else np.median
    return [
        _spread(batch, ".3f"),
        *(_spread(_column(group, f"{kind}path_rmse_m") / batch, ".2f") for kind in kinds),
        _spread(_column(group, "optimum_ratio"), ".2f"),
        _spread(_column(group, "association_recall"), ".3f"),
        f"{centre(_column(group, 'pose_nees')):.3g}",
        f"{centre(_column(group, 'landmark_nees')):.3g}",
        _spread(_column(group, "ancestors"), ".1f"),
    ]


def _column(group: list[Row], name: str) -> np.ndarray:
    return np.array([getattr(row, name) for row in group], float)


def _spread(values: np.ndarray, form: str) -> str:
    return f"{values.mean():{form}} ± {values.std():{form}}"
