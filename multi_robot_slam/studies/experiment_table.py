"""The table of the paper's experiments, `table.csv`: one row a figure and run."""

from collections.abc import Mapping
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from msg_defs.errors import InputError
from multi_robot_slam.studies import table


@dataclass(frozen=True, order=True)
class Trial:
    """What sets one run apart from the others of an experiment."""

    robots: int
    particles: int
    observations: int
    d_max_m: float
    descriptor_noise: float
    proposal: str
    trajectory: str
    start_offset: float
    seed: int


Key = tuple[str, Trial]
"""Figure and run. A run that several figures need has a row in each."""

Result = dict[str, float | None]
"""The measured columns of a run, None where there is nothing to measure."""

Rows = dict[Key, Result]

RESULTS = (
    *("path_rmse_m", "heading_rmse_rad", "map_rmse_m", "odometry_path_rmse_m"),
    *("batch_path_rmse_m", "association_precision", "association_recall", "step_ms_mean"),
    *("landmarks", "landmarks_seen"),
)
TIMING = "step_ms_mean"
"""The one column that differs when a run is repeated."""
TRIAL = tuple(field.name for field in fields(Trial))
COLUMNS = ("figure", *TRIAL, *RESULTS)
TYPES = (str, *table.types_of(Trial), *[float] * len(RESULTS))


def to_line(key: Key, result: Mapping[str, float | None]) -> str:
    """A row as CSV."""
    figure, trial = key
    return table.line([figure, *astuple(trial), *(result[name] for name in RESULTS)])


def from_line(text: str) -> tuple[Key, Result]:
    """The inverse of `to_line`; `InputError` names the cell that does not fit."""
    figure, *cells = table.cells(text, COLUMNS, TYPES)
    of_trial, results = cells[: len(TRIAL)], cells[len(TRIAL) :]
    if figure is None or None in of_trial:
        raise InputError(f"a cell that names the run is empty in '{text.strip()}'")
    return (figure, Trial(*of_trial)), dict(zip(RESULTS, results, strict=True))


def opened(path: Path) -> table.Table[Key, Result]:
    """The table at `path`."""
    return table.Table(path, table.Format(",".join(COLUMNS), to_line, from_line))
