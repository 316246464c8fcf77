"""The table of the study of real robots, `real.csv`, and its summary."""

from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np

from msg_defs.errors import InputError
from multi_robot_slam.studies import table

SIGHTINGS, LANDMARKS, ALONE = "together, sightings", "together", "alone"
SETUPS = (SIGHTINGS, LANDMARKS, ALONE)
REJUVENATED = "rejuvenated"
FILTERS = (REJUVENATED, "informed", "motion")
"""The bag's own, and both proposals without rejuvenation, which takes the odometry as it is."""
TEAM = "team"
"""In the column `robot`: all of them."""


@dataclass(frozen=True)
class Row:
    """Figures of one robot in one run, or of the whole team."""

    setup: str
    filter: str
    robot: str
    seed: int
    particles: int
    odometry_path_rmse_m: float
    online_path_rmse_m: float
    optimum_rmse_m: float | None
    """Of the filtering optimum, every OPTIMUM_EVERY steps: with the true identities, and all of
    what was known at that instant."""
    online_path_aligned_rmse_m: float
    online_heading_rmse_rad: float
    online_mean_path_rmse_m: float
    path_rmse_m: float
    mean_path_rmse_m: float
    refined_path_rmse_m: float
    refined_path_aligned_rmse_m: float
    batch_path_rmse_m: float | None
    batch_path_aligned_rmse_m: float | None
    landmark_rmse_m: float
    """Of the map, one landmark for each true one: `map_rmse_m` of `result.json`."""
    landmark_aligned_rmse_m: float
    refined_landmark_rmse_m: float
    rejected: int
    """Observations outside the gate of what they look like."""
    duplicates: int
    """Landmarks beyond the first of each true one."""


Key = tuple[str, str, str, int, int]
"""Set-up, filter, robot, seed, particles: the first columns."""
NAMES = tuple(field.name for field in fields(Row))
TYPES = table.types_of(Row)


def key_of(row: Row) -> Key:
    """What sets the row apart."""
    return row.setup, row.filter, row.robot, row.seed, row.particles


def order(key: Key) -> tuple[int, int, str, int, int]:
    """What the table is sorted by."""
    setup, name, robot, seed, particles = key
    return SETUPS.index(setup), FILTERS.index(name), robot, seed, particles


def opened(path: Path) -> table.Table[Key, Row]:
    """The table at `path`."""
    header = ",".join(NAMES)
    form = table.Format(header, lambda _, row: table.line(astuple(row)), _from_line, order)
    return table.Table(path, form)


def _from_line(text: str) -> tuple[Key, Row]:
    row = Row(*table.cells(text, NAMES, TYPES))
    if row.setup not in SETUPS or row.filter not in FILTERS:
        raise InputError(
            f"no set-up '{row.setup}' or filter '{row.filter}' is known; remove the row"
        )
    return key_of(row), row


COLUMNS = {
    "online_path_rmse_m": "live",
    "online_path_aligned_rmse_m": "live, aligned",
    "online_heading_rmse_rad": "live heading [rad]",
    "online_mean_path_rmse_m": "live mean",
    "optimum_rmse_m": "filtering optimum",
    "path_rmse_m": "after the run",
    "mean_path_rmse_m": "after the run, mean",
    "refined_path_rmse_m": "refined",
    "refined_path_aligned_rmse_m": "refined, aligned",
    "batch_path_rmse_m": "yardstick",
    "batch_path_aligned_rmse_m": "yardstick, aligned",
    "odometry_path_rmse_m": "odometry",
    "landmark_rmse_m": "landmarks",
    "landmark_aligned_rmse_m": "landmarks, aligned",
    "refined_landmark_rmse_m": "landmarks, refined",
    "rejected": "rejected",
    "duplicates": "duplicates",
}
"""Figures of the table, RMS errors in metres but where it says otherwise."""


def markdown(rows: list[Row]) -> str:
    """A table of mean ± standard deviation over the seeds, for each set-up, filter and robot."""
    head = ("set-up", "filter", "robot", *COLUMNS.values())
    lines = ["| " + " | ".join(head) + " |", "|---|---|---|" + "---:|" * len(COLUMNS)]
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.setup, row.filter, row.robot), []).append(row)
    for key, group in groups.items():
        cells = [_cell([getattr(row, name) for row in group]) for name in COLUMNS]
        lines.append("| " + " | ".join([*key, *cells]) + " |")
    return "\n".join(lines) + "\n"


def _cell(values: list[float | None]) -> str:
    known = np.array([value for value in values if value is not None], float)
    if not len(known):
        return "-"
    form = ".0f" if all(isinstance(value, int) for value in values) else ".3f"
    return (
        f"{known.mean():{form}} ± {known.std():{form}}" if len(known) > 1 else f"{known[0]:{form}}"
    )
