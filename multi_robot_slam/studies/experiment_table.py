"""The table of an experiment: one row a run, in a CSV file that survives being interrupted.

Rows are appended as runs finish; a row is whole when its line ends. The finished table is sorted,
so it does not depend on the order in which the runs ended.
"""

import os
from collections.abc import Mapping
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from msg_defs.errors import InputError


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


Result = dict[str, float | None]
"""The measured columns of a run, None where there is nothing to measure."""

Rows = dict[tuple[str, Trial], Result]
"""(figure, run) -> result. A run that several figures need has a row in each."""

RESULTS = (
    *("path_rmse_m", "heading_rmse_rad", "map_rmse_m", "odometry_path_rmse_m"),
    *("batch_path_rmse_m", "association_precision", "association_recall", "step_ms_mean"),
    *("landmarks", "landmarks_seen"),
)
TIMING = "step_ms_mean"
"""The one column that differs when a run is repeated."""
COLUMNS = ("figure", *(field.name for field in fields(Trial)), *RESULTS)
HEADER = ",".join(COLUMNS)


def to_line(figure: str, trial: Trial, result: Mapping[str, float | None]) -> str:
    """A row as CSV, numbers with six digits."""
    return ",".join([figure, *map(_cell, astuple(trial)), *(_cell(result[n]) for n in RESULTS)])


def from_line(line: str) -> tuple[str, Trial, Result]:
    """The inverse of `to_line`; `InputError` names the cell that does not fit."""
    cells = dict(zip(COLUMNS, line.strip().split(","), strict=False))
    if len(cells) < len(COLUMNS) or line.count(",") >= len(COLUMNS):
        raise InputError(f"not a row of table.csv: '{line.strip()}'; its columns are {HEADER}")
    trial = Trial(*(_parse(f.type, f.name, cells[f.name]) for f in fields(Trial)))
    results = {n: _parse(float, n, cells[n]) if cells[n] else None for n in RESULTS}
    return cells["figure"], trial, results


def read(path: Path) -> Rows:
    """The rows of the table at `path`, none if it does not exist.

    A last line that was cut off is left out.
    """
    try:
        text = path.read_text()
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {error}") from None
    header, *lines = text.split("\n")[:-1] or [HEADER]
    if header != HEADER:
        raise InputError(f"{path} has other columns than this version writes; use another --out")
    rows = {}
    for line in lines:
        figure, trial, result = from_line(line)
        rows[figure, trial] = result
    return rows


def append(path: Path, rows: Rows) -> None:
    """Add `rows` to the table at `path`, at once and for good."""
    with path.open("a") as file:
        file.writelines(f"{to_line(*key, result)}\n" for key, result in rows.items())
        file.flush()
        os.fsync(file.fileno())


def write(path: Path, rows: Rows) -> None:
    """Write the whole table, sorted, in place of the old one."""
    lines = [HEADER, *(to_line(*key, rows[key]) for key in sorted(rows))]
    new = path.with_suffix(".new")
    new.write_text("\n".join(lines) + "\n")
    os.replace(new, path)


def _cell(value: float | str | None) -> str:
    if value is None:
        return ""
    return value if isinstance(value, str) else f"{value:.6g}"


def _parse(kind: type, name: str, text: str) -> float | int | str:
    try:
        return kind(text)
    except ValueError:
        raise InputError(f"{name} = '{text}' is no number; give a row of table.csv") from None
