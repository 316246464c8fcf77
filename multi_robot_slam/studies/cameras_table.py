"""The table of the study of cameras, `cameras.csv`, and its summary."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np

from multi_robot_slam.studies import table

TEAM = "team"
"""In the column `robot`: all of them."""


@dataclass(frozen=True)
class Row:
    """Figures of one robot in one run, or of the whole team."""

    setup: str
    robot: str
    seed: int
    """Of the odometry's errors and of the filter."""
    particles: int
    odometry_path_rmse_m: float
    online_path_rmse_m: float
    """As published."""
    path_rmse_m: float
    batch_path_rmse_m: float | None
    """Least squares with the associations that the true poses tell."""
    online_heading_rmse_rad: float
    association_precision: float | None
    association_recall: float | None
    revisits: int | None
    """Observations of landmarks not seen for `revisits.LONG_S`; of the team."""
    revisit_precision: float | None
    revisit_recall: float | None
    pose_nees: float | None
    pose_nees_median: float | None
    """2.37 for an honest filter: a mean is made by few poses."""


Key = tuple[str, str, int, int]
NAMES = tuple(field.name for field in fields(Row))
TYPES = table.types_of(Row)


def key_of(row: Row) -> Key:
    """What sets the row apart."""
    return row.setup, row.robot, row.seed, row.particles


def opened(path: Path) -> table.Table[Key, Row]:
    """The table at `path`."""
    form = table.Format(",".join(NAMES), lambda _, row: table.line(astuple(row)), _from_line)
    return table.Table(path, form)


def _from_line(text: str) -> tuple[Key, Row]:
    row = Row(*table.cells(text, NAMES, TYPES))
    return key_of(row), row


COLUMNS = {
    "odometry_path_rmse_m": "odometry [m]",
    "online_path_rmse_m": "as published [m]",
    "path_rmse_m": "after the run [m]",
    "batch_path_rmse_m": "batch [m]",
    "online_heading_rmse_rad": "heading [rad]",
    "association_precision": "precision",
    "association_recall": "recall",
    "revisits": "revisits",
    "revisit_precision": "their precision",
    "revisit_recall": "their recall",
    "pose_nees": "pose NEES",
    "pose_nees_median": "its median",
}


def markdown(rows: Sequence[Row], over: str | None = None) -> str:
    """Mean ± standard deviation over the seeds, for each set-up and robot, in their order.

    With ratios: of the published error over the odometry's, over the batch's in those runs that
    have one, and over that of the set-up `over`, each of root mean squares over the seeds.
    """
    ratios = ["published / odometry", "published / batch"]
    ratios += [f"published / {over}"] if over else []
    head = ("set-up", "robot", "runs", *COLUMNS.values(), *ratios)
    lines = ["| " + " | ".join(head) + " |", "|---|---|" + "---:|" * (len(head) - 2)]
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.setup, row.robot), []).append(row)
    for (setup, robot), group in groups.items():
        cells = [_cell([getattr(row, name) for row in group]) for name in COLUMNS]
        cells += [_ratio(group, group, "odometry_path_rmse_m")]
        solved = [row for row in group if row.batch_path_rmse_m is not None]
        cells += [_ratio(solved, solved, "batch_path_rmse_m")]
        if over:
            cells += [_ratio(group, groups.get((over, robot), []), "online_path_rmse_m")]
        lines.append("| " + " | ".join([setup, robot, str(len(group)), *cells]) + " |")
    return "\n".join(lines) + "\n"


def _ratio(group: list[Row], reference: list[Row], name: str) -> str:
    """Published errors of the `group` over those that the `reference` has under `name`."""
    if not reference:
        return "-"
    own = [row.online_path_rmse_m for row in group]
    over = [getattr(row, name) for row in reference]
    return f"{np.sqrt(np.mean(np.square(own)) / np.mean(np.square(over))):.2f}"


def _cell(values: list[float | None]) -> str:
    known = np.array([value for value in values if value is not None], float)
    if not len(known):
        return "-"
    form = ".0f" if known.max() >= 100 else ".3f"
    if len(known) == 1:
        return f"{known[0]:{form}}"
    return f"{known.mean():{form}} ± {known.std():{form}}"
