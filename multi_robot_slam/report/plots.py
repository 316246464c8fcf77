"""The paper's figures of a single run, 3(b) and 4, from a `Run` alone.

Figures are plain Matplotlib objects without global state; colours are Okabe and Ito's, told apart
by the colour-blind too.
"""

from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from msg_defs.errors import InputError
from msg_defs.types import LandmarkMap
from multi_robot_slam.runs import RobotRun, Run
from multi_robot_slam.runs.colours import ROBOT_COLOURS
from multi_robot_slam.runs.places import placed
from multi_robot_slam.runs.robot_errors import odometry_in_map, robot_errors
from multi_robot_slam.runs.trajectory_errors import PoseErrors, rmse

ROBOT_LINES = ("-", "--", "-.", ":")
"""Line styles of the robots in the error figure, as in the paper."""
WALL_COLOUR = "#DADADA"
TRUE_LANDMARK_COLOUR = "#9A9A9A"
LANDMARK_COLOUR = "#222222"
ELLIPSE_SIGMAS = 2.4477
"""Half axes of an ellipse that holds 95 % of a planar Gaussian, in standard deviations."""
DPI = 160

Look = dict[str, Any]
"""Keywords of Matplotlib's artists."""

_WALL: Look = {"linewidth": 4.0, "color": WALL_COLOUR, "label": "wall"}
_TRUE_PATH: Look = {"linestyle": "-", "linewidth": 1.4, "label": "true path"}
_ODOMETRY: Look = {"linestyle": "--", "linewidth": 1.2, "label": "odometry"}
_LIVE: Look = {
    "linestyle": "-",
    "linewidth": 0.8,
    "marker": "s",
    "markersize": 4.5,
    "markerfacecolor": "white",
    "markeredgewidth": 1.1,
    "label": "live path",
}
_AFTER: Look = {"linestyle": ":", "linewidth": 1.6, "label": "path after the run"}
_PLACED: Look = {
    "linestyle": "none",
    "marker": "*",
    "markersize": 13,
    "label": "place became known",
}
_TRUE_LANDMARK: Look = {
    "linestyle": "none",
    "marker": (8, 2),
    "markersize": 5,
    "markeredgewidth": 0.6,
    "color": TRUE_LANDMARK_COLOUR,
    "label": "true landmark",
}
_LANDMARK: Look = {
    "linestyle": "none",
    "marker": ".",
    "markersize": 2.5,
    "color": LANDMARK_COLOUR,
    "label": "landmark, 95 %",
}


def map_figure(run: Run) -> Figure:
    """The map and the paths seen from above, in metres (paper fig. 3(b))."""
    figure = _figure(9.5, 7.0)
    axes = figure.add_subplot()
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    _draw_world(axes, run)
    _draw_landmarks(axes, run.landmarks)
    known = placed(run.steps)
    for colour, (name, robot) in zip(cycle(ROBOT_COLOURS), run.robots.items(), strict=False):
        _draw_paths(axes, robot, colour)
        if name in known:
            look = {**_PLACED, "color": colour}
            axes.plot(*robot.online.poses[:1, :2].T, **look, zorder=8)
    axes.margins(0.03)
    _plain(axes)
    axes.legend(
        handles=_map_legend(run), loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False
    )
    return figure


def error_figure(run: Run) -> Figure:
    """Errors of x, y and theta over time (paper fig. 4): live, after the run, of the odometry."""
    errors = robot_errors(run)
    if not errors:
        raise InputError("this run has no ground truth, so its errors cannot be drawn")
    figure = _figure(13.0, 6.0)
    grid = figure.subplots(3, 3, sharex=True)
    looks = dict(zip(run.robots, zip(cycle(ROBOT_COLOURS), cycle(ROBOT_LINES)), strict=False))
    starts = [stamp for robot in errors.values() for e in robot for stamp in e.stamps_ns[:1]]
    start_ns = min(starts, default=0)
    for column, title, series in (
        (0, "(a) live − truth", {name: robot.online for name, robot in errors.items()}),
        (1, "(b) after the run − truth", {name: robot.path for name, robot in errors.items()}),
        (2, "(c) odometry − truth", {name: robot.odometry for name, robot in errors.items()}),
    ):
        _draw_errors(grid[:, column], series, looks, start_ns)
        grid[0, column].set_title(title + _team_rmse(series), loc="left")
    _mark_placed(grid[:, 0], run, looks, start_ns)
    for axes, label in zip(grid[:, 0], ("x [m]", "y [m]", "θ [rad]"), strict=True):
        axes.set_ylabel(label)
    figure.align_ylabels(grid[:, 0])
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    return figure


def save(run: Run, folder: Path) -> list[Path]:
    """Write `map.png`, and `errors.png` if the run has truth, into `folder`; return their paths."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    figures = {"map.png": map_figure}
    if any(robot.truth is not None for robot in run.robots.values()):
        figures["errors.png"] = error_figure
    for name, draw in figures.items():
        draw(run).savefig(folder / name, dpi=DPI, bbox_inches="tight")
    return [folder / name for name in figures]


def _figure(width_in: float, height_in: float) -> Figure:
    figure = Figure(figsize=(width_in, height_in), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _plain(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#ECECEC", linewidth=0.6)
    axes.set_axisbelow(True)


def _draw_world(axes: Axes, run: Run) -> None:
    if run.walls is not None:
        segments = run.walls.segments.reshape(-1, 2, 2)
        axes.add_collection(LineCollection(list(segments), **_WALL, zorder=1))
    if run.true_landmarks is not None:
        x, y, _ = run.true_landmarks.positions.T
        axes.plot(x, y, **_TRUE_LANDMARK, zorder=2)


def _draw_landmarks(axes: Axes, landmarks: LandmarkMap) -> None:
    x, y, _ = landmarks.positions.T
    widths, heights, angles = ellipses(landmarks.covariances)
    axes.add_collection(
        EllipseCollection(
            widths,
            heights,
            angles,
            units="xy",
            offsets=np.column_stack([x, y]),
            offset_transform=axes.transData,
            facecolors="none",
            edgecolors=LANDMARK_COLOUR,
            linewidths=0.5,
            alpha=0.6,
            zorder=3,
        )
    )
    axes.plot(x, y, **_LANDMARK, zorder=3)


def ellipses(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Seen from above, the 95 % ellipses of (N, 6) covariances: full axes [m] and angle [deg].

    Widths belong to the larger axis, whose direction from x the angle gives.
    """
    xx, xy, _, yy = covariances[:, :4].astype(float).T
    mean, spread = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    variances = np.maximum([mean + spread, mean - spread], 0.0)
    widths, heights = 2 * ELLIPSE_SIGMAS * np.sqrt(variances)
    return widths, heights, np.degrees(np.arctan2(2 * xy, xx - yy) / 2)


def _draw_paths(axes: Axes, robot: RobotRun, colour: str) -> None:
    odometry = odometry_in_map(robot).poses
    axes.plot(*odometry[:, :2].T, **_ODOMETRY, color=colour, zorder=4)
    if robot.truth is not None:
        axes.plot(*robot.truth.poses[:, :2].T, **_TRUE_PATH, color=colour, zorder=5)
    axes.plot(*robot.path.poses[:, :2].T, **_AFTER, color=colour, zorder=6)
    axes.plot(*robot.online.poses[:, :2].T, **_LIVE, color=colour, markevery=0.025, zorder=7)


def _map_legend(run: Run) -> list[Line2D]:
    robots = [
        Line2D([], [], color=colour, linewidth=4, label=name)
        for colour, name in zip(cycle(ROBOT_COLOURS), run.robots, strict=False)
    ]
    styles = [_LIVE, _AFTER, _ODOMETRY, _LANDMARK]
    if any(robot.truth is not None for robot in run.robots.values()):
        styles.insert(0, _TRUE_PATH)
    if run.true_landmarks is not None:
        styles.append(_TRUE_LANDMARK)
    if placed(run.steps):
        styles.append(_PLACED)
    neutral = [Line2D([], [], **{"color": "#222222", **style}) for style in styles]
    if run.walls is not None:
        neutral.append(Line2D([], [], **_WALL))
    return robots + neutral


def _draw_errors(
    column: np.ndarray,
    series: dict[str, PoseErrors],
    looks: dict[str, tuple[str, str]],
    start_ns: int,
) -> None:
    for index, axes in enumerate(column):
        axes.axhline(0.0, color="#BBBBBB", linewidth=0.8, zorder=1)
        for name, (stamps_ns, errors, _) in series.items():
            colour, line = looks[name]
            seconds = (stamps_ns - start_ns) / 1e9
            axes.plot(seconds, errors[:, index], line, color=colour, linewidth=1.3, label=name)
        _plain(axes)
    column[-1].set_xlabel("time [s]")


def _mark_placed(
    column: np.ndarray, run: Run, looks: dict[str, tuple[str, str]], start_ns: int
) -> None:
    """A line where the place of a robot in `map` became known."""
    for name, (stamp_ns, _) in placed(run.steps).items():
        seconds = (stamp_ns - start_ns) / 1e9
        for axes in column:
            axes.axvline(seconds, color=looks[name][0], linestyle=":", linewidth=1.0, zorder=1)
        text = {"color": looks[name][0], "fontsize": 8, "rotation": 90, "ha": "right", "va": "top"}
        in_axes = column[0].get_xaxis_transform()
        column[0].text(seconds, 0.98, f"{name}: place known", transform=in_axes, **text)


def _team_rmse(series: dict[str, PoseErrors]) -> str:
    error = rmse(np.concatenate([e.errors[:, :2] for e in series.values()]))
    return "" if error is None else f", path RMSE {error:.3f} m"
