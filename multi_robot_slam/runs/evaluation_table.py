"""Figures of merit (`evaluation.evaluate`) for people to read."""

from collections.abc import Collection, Iterator

from rich.box import SIMPLE
from rich.table import Table
from rich.text import Text

from multi_robot_slam.runs.run import TEAM

SECTIONS = {
    "path [m]": {
        "online_path_rmse_m": "live",
        "online_path_aligned_rmse_m": "live, aligned alone",
        "path_rmse_m": "after the run",
        "path_aligned_rmse_m": "after the run, aligned alone",
        "path_team_aligned_rmse_m": "after the run, aligned as a team",
        "mean_path_rmse_m": "after the run, mean of the particles",
        "refined_path_rmse_m": "refined",
        "refined_path_aligned_rmse_m": "refined, aligned alone",
        "batch_path_rmse_m": "yardstick",
        "odometry_path_rmse_m": "odometry",
    },
    "truth": {
        "truth_coverage": "share of the path it covers",
    },
    "heading [rad]": {
        "online_heading_rmse_rad": "live",
        "online_heading_aligned_rmse_rad": "live, aligned alone",
        "heading_rmse_rad": "after the run",
        "heading_aligned_rmse_rad": "after the run, aligned alone",
        "heading_team_aligned_rmse_rad": "after the run, aligned as a team",
        "refined_heading_rmse_rad": "refined",
        "batch_heading_rmse_rad": "yardstick",
        "odometry_heading_rmse_rad": "odometry",
    },
    "motion": {
        "online_rte_1m_rmse_m": "live, over 1 m [m]",
        "online_rte_1m_rmse_rad": "live, over 1 m [rad]",
        "online_rte_10m_rmse_m": "live, over 10 m [m]",
        "online_rte_10m_rmse_rad": "live, over 10 m [rad]",
        "rte_1m_rmse_m": "after the run, over 1 m [m]",
        "rte_1m_rmse_rad": "after the run, over 1 m [rad]",
        "rte_10m_rmse_m": "after the run, over 10 m [m]",
        "rte_10m_rmse_rad": "after the run, over 10 m [rad]",
    },
    "map [m]": {
        "map_rmse_m": "at the end",
        "map_aligned_rmse_m": "at the end, aligned",
        "map_all_rmse_m": "at the end, duplicates included",
        "refined_map_rmse_m": "refined",
        "refined_map_aligned_rmse_m": "refined, aligned",
    },
    "landmarks": {
        "landmarks": "in the map",
        "landmarks_seen": "true ones seen",
        "misses": "of these, not in the map",
        "duplicates": "duplicates in the map",
    },
    "association": {
        "association_precision": "precision",
        "association_recall": "recall",
    },
    "NEES (3 is right)": {
        "pose_nees": "poses",
        "landmark_nees": "landmarks",
        "refined_landmark_nees": "landmarks, refined",
    },
    "step [ms]": {
        "step_ms_mean": "mean",
        "step_ms_p99": "99 % are below",
        "step_ms_max": "longest",
    },
}
"""Figures in the table by section, and what they are called there.

*Live* is the pose as it was published at each step; *after the run* the whole path in hindsight.
"""


NUMBER_WIDTH = 6
"""Of a column of figures, at least [characters]."""
COLUMN_GAP = 2
"""Between two columns, and at both ends of the table together [characters]."""


def table(result: dict, width: int) -> Table:
    """All known figures of `result` (from `evaluate`), a column for the team and each robot.

    Of many robots as many as fit into `width` characters; below the table is told of the others.
    """
    robots = result["robots"]
    known = {
        key for own in (result, *robots.values()) for key, value in own.items() if value is not None
    }
    sections = list(titles(known))
    left = width - max(len(title) for rows in sections for title in rows.values()) - COLUMN_GAP
    columns = left // (NUMBER_WIDTH + COLUMN_GAP)
    fitting = dict(list(robots.items())[: max(columns - 1, 0)])
    shown = empty()
    shown.columns[0].no_wrap = columns > 0
    shown.add_column(TEAM, justify="right", no_wrap=True, min_width=NUMBER_WIDTH)
    for name in fitting:
        shown.add_column(Text(name), justify="right", overflow="fold", min_width=NUMBER_WIDTH)
    whose = (result, *fitting.values())
    for rows in sections:
        shown.add_section()
        for key, title in rows.items():
            cells = (number(figures[key]) if key in figures else "" for figures in whose)
            shown.add_row(Text(title), *cells)
    if left_out := len(robots) - len(fitting):
        shown.caption = f"{left_out} more robots: result.json, figures.csv"
        shown.caption_justify = "left"
    return shown


def empty() -> Table:
    """A table with the column of titles alone."""
    title = "Figures of merit; errors are RMS"
    shown = Table(title=title, title_justify="left", box=SIMPLE, padding=(0, 1, 0, 0))
    shown.add_column("", no_wrap=True)
    return shown


def titles(known: Collection[str]) -> Iterator[dict[str, str]]:
    """Of each section those figures that are `known`, each with its title."""
    for section, names in SECTIONS.items():
        rows = {key: title for key, title in names.items() if key in known}
        for key in list(rows)[:1]:
            rows[key] = f"{section}: {rows[key]}"
        yield rows


def number(value: object) -> str:
    """A figure in up to six characters."""
    if not isinstance(value, float):
        return "-" if value is None else str(value)
    for limit, form in ((10, ".3f"), (100, ".1f"), (1e5, ".0f")):
        if abs(value) < limit:
            return format(value, form)
    return f"{value:.0e}"
