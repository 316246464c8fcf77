"""The paper's figures 5 to 9 from the table of an experiment alone, and 3 and 4 from one run.

Mean over the runs with bars of two standard deviations; circle, square and triangle are one, two
and three robots, as in the paper. Solid lines with open markers are the paper's filter, dashed
lines with filled ones the informed proposal; odometry and the batch solution are references.
"""

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter
from matplotlib.typing import LineStyleType
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D

from msg_defs.types import CameraMount, ObservationSet, Walls
from multi_robot_slam.models import stereo
from multi_robot_slam.report import plots
from multi_robot_slam.report.plots import DPI
from multi_robot_slam.runs import Run
from multi_robot_slam.runs.colours import ROBOT_COLOURS
from multi_robot_slam.studies.experiment_table import Result, Rows, Trial

MARKERS = {1: "o", 2: "s", 3: "^"}
"""Number of robots -> marker."""
LINES = {"motion": "-", "informed": "--"}
"""Proposal -> line style."""
PROPOSALS = {"motion": "paper's proposal", "informed": "informed proposal"}
REFERENCES: dict[str, tuple[LineStyleType, str]] = {
    "odometry_path_rmse_m": (":", "odometry"),
    "batch_path_rmse_m": ("-.", "batch"),
}
PATH, MAP = "path_rmse_m", "map_rmse_m"
SPREAD = 0.04
"""Shift between the lines of a panel, so that their bars do not hide each other."""

Value = Callable[[Trial, Result], float | None]


class Panel(NamedTuple):
    """One pair of axes: what it shows of which runs."""

    title: str
    label: str
    value: Value
    keep: Callable[[Trial], bool] = lambda trial: True
    is_log: bool = False
    has_references: bool = False


def column(name: str) -> Value:
    """The value of a column of the table."""
    return lambda trial, result: result[name]


def path_or_odometry(trial: Trial, result: Result) -> float | None:
    """The path error; without observations odometry is the estimate."""
    return result[PATH if trial.observations else "odometry_path_rmse_m"]


def summary(points: dict[float, list[float]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ascending x, and mean and standard deviation of the values there."""
    x = np.array(sorted(points))
    values = [points[key] for key in x.tolist()]
    spread = [np.std(v, ddof=1) if len(v) > 1 else 0.0 for v in values]
    return x, np.array([np.mean(v) for v in values]), np.array(spread)


def draw(figure: str, rows: Rows) -> Figure:
    """Figure `fig5` ... `fig9` from the table's rows."""
    runs = {trial: result for (name, trial), result in rows.items() if name == figure}
    x_name, x_label = AXES[figure]
    panels = PANELS[figure](runs)
    columns = min(len(panels), 3 if len(panels) == 3 else 2)
    sheet = Figure((5.2 * columns, 4.4 * -(-len(panels) // columns) + 0.6), layout="constrained")
    for axes, panel in zip(
        np.ravel(sheet.subplots(-(-len(panels) // columns), columns)), panels, strict=True
    ):
        _draw_panel(axes, panel, runs, x_name)
        axes.set(xlabel=x_label, ylabel=panel.label)
        axes.set_title(panel.title, loc="left")
    handles = _legend(runs, any(panel.has_references for panel in panels))
    sheet.legend(
        handles=handles, loc="outside lower center", ncols=-(-len(handles) // 2), frameon=False
    )
    return sheet


Curves = dict[tuple[int, str], dict[float, list[float]]]
"""Robots and name of a curve -> x -> values."""


def _draw_panel(axes: Axes, panel: Panel, runs: dict[Trial, Result], x_name: str) -> None:
    lines: Curves = defaultdict(lambda: defaultdict(list))
    references: Curves = defaultdict(lambda: defaultdict(list))
    for trial, result in runs.items():
        value, x = panel.value(trial, result), getattr(trial, x_name)
        if panel.keep(trial) and value is not None:
            lines[trial.robots, trial.proposal][x].append(value)
        for name in REFERENCES if panel.has_references else ():
            reference = result[name]
            if reference is not None:
                references[trial.robots, name][x].append(reference)
    _scale(axes, panel, runs, x_name)
    for place, ((robots, proposal), points) in enumerate(sorted(lines.items(), reverse=True)):
        x, mean, sigma = summary(points)
        shift = place - (len(lines) - 1) / 2
        axes.errorbar(
            _shifted(axes, x, shift / len(lines)),
            mean,
            2 * sigma,
            **_look(robots, proposal),
            linewidth=1.3,
            elinewidth=0.7,
            capsize=2,
        )
    for (robots, name), points in sorted(references.items()):
        x, mean, _ = summary(points)
        axes.plot(x, mean, REFERENCES[name][0], color=ROBOT_COLOURS[robots - 1], linewidth=1.0)
    if not panel.is_log:
        axes.set_ylim(bottom=0)


def _scale(axes: Axes, panel: Panel, runs: dict[Trial, Result], x_name: str) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#ECECEC", linewidth=0.6)
    axes.set_axisbelow(True)
    if panel.is_log:
        axes.set(xscale="log", yscale="log", ylim=_log_limits(panel, runs))
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())
    else:
        x = sorted({getattr(trial, x_name) for trial in runs})
        axes.set_xlim(x[0], x[-1])
        axes.margins(x=0.05)
        axes.autoscale(axis="x")


def _log_limits(panel: Panel, runs: dict[Trial, Result]) -> tuple[float, float] | None:
    """Limits that show every run and reference: a bar below zero leaves the panel."""
    names = REFERENCES if panel.has_references else ()
    shown = [run for run in runs.items() if panel.keep(run[0])]
    values = [panel.value(*run) for run in shown]
    values += [result[name] for _, result in shown for name in names]
    known = [value for value in values if value]
    return (min(known) / 1.3, max(known) * 1.3) if known else None


def _shifted(axes: Axes, x: np.ndarray, share: float) -> np.ndarray:
    """`x` moved a little, the same distance on paper everywhere."""
    if axes.get_xscale() == "log":
        return x * np.exp(2 * SPREAD * share * np.log(10))
    return x + SPREAD * share * (x[-1] - x[0])


def _look(robots: int, proposal: str) -> dict:
    colour = ROBOT_COLOURS[robots - 1]
    return {
        "color": colour,
        "linestyle": LINES[proposal],
        "marker": MARKERS[robots],
        "markersize": 5.5,
        "markerfacecolor": "white" if proposal == "motion" else colour,
    }


def _legend(runs: dict[Trial, Result], has_references: bool) -> list[Line2D]:
    kinds = sorted({(trial.proposal, trial.robots) for trial in runs}, key=lambda k: (k[1], k[0]))
    handles = [
        Line2D([], [], **_look(robots, proposal), label=f"{_team(robots)}, {PROPOSALS[proposal]}")
        for proposal, robots in kinds
    ]
    for name, (line, label) in REFERENCES.items():
        if has_references and any(result[name] is not None for result in runs.values()):
            handles.append(Line2D([], [], linestyle=line, color="#222222", label=label))
    return handles


def _team(robots: int) -> str:
    return f"{robots} robot{'s' if robots > 1 else ''}"


def _errors(is_log: bool = False) -> list[Panel]:
    return [
        Panel("(a) path", "RMS error [m]", path_or_odometry, is_log=is_log, has_references=True),
        Panel("(b) map", "RMS error [m]", column(MAP), is_log=is_log),
    ]


def _association() -> list[Panel]:
    return [
        Panel("(c) precision of the association", "precision", column("association_precision")),
        Panel("(d) recall of the association", "recall", column("association_recall")),
    ]


def shares_b(runs: dict[Trial, Result]) -> Callable[[Trial], bool]:
    """Whether a run's robots share the B observations of one robot, with B/K each."""
    most = max(trial.observations for trial in runs)
    return lambda trial: trial.observations == most // trial.robots


def has_b(runs: dict[Trial, Result]) -> Callable[[Trial], bool]:
    """Whether each robot of a run makes B observations."""
    most = max(trial.observations for trial in runs)
    return lambda trial: trial.observations == most


def _times(runs: dict[Trial, Result]) -> list[Panel]:
    time, each, shared = column("step_ms_mean"), has_b(runs), shares_b(runs)
    most, shares = _numbers(runs, each), _numbers(runs, shared)
    return [
        Panel(f"(a) B = {most} observations each", "time per step [ms]", time, each),
        Panel(f"(b) B/K = {shares} observations each", "time per step [ms]", time, shared),
        Panel("(c) map, B/K observations each", "RMS error [m]", column(MAP), shared, is_log=True),
    ]


def _numbers(runs: dict[Trial, Result], keep: Callable[[Trial], bool]) -> str:
    """The numbers of observations among the kept runs, for one robot first."""
    return ", ".join(map(str, sorted({t.observations for t in runs if keep(t)}, reverse=True)))


AXES = {
    "fig5": ("particles", "number of particles M"),
    "fig6": ("d_max_m", "maximum distance of an observation $d_{max}$ [m]"),
    "fig7": ("descriptor_noise", "noise in the descriptor $\\sigma_{desc}$"),
    "fig8": ("observations", "observations B (0: odometry alone)"),
    "fig9": ("particles", "number of particles M"),
}
"""Figure -> the column its lines run along, and its label."""
PANELS: dict[str, Callable[[dict[Trial, Result]], list[Panel]]] = {
    "fig5": lambda runs: _errors(is_log=True),
    "fig6": lambda runs: _errors(),
    "fig7": lambda runs: _errors() + _association(),
    "fig8": lambda runs: _errors(),
    "fig9": _times,
}


def save(rows: Rows, folder: Path) -> list[Path]:
    """Write a picture of every figure 5 to 9 that has rows; return their paths."""
    paths = []
    for figure in sorted({name for name, _ in rows} & set(PANELS)):
        paths.append(folder / f"{figure}.png")
        draw(figure, rows).savefig(paths[-1], dpi=DPI)
    return paths


class View(NamedTuple):
    """What one robot saw at one instant, in `map`."""

    eye: np.ndarray
    """(3,): the left camera [m]."""
    points: np.ndarray
    """(B, 3): the measured points [m]."""


def view(true_pose: np.ndarray, seen: ObservationSet, mount: CameraMount) -> View:
    """The observations of a robot at `true_pose` (x, y, yaw)."""
    points, _ = stereo.to_body(seen.positions, seen.covariances, mount)
    eye = np.array([[mount.forward_m, mount.left_m, mount.up_m]])
    return View(stereo.to_map(true_pose, eye)[0], stereo.to_map(true_pose, points))


def world_figure(run: Run, views: list[View]) -> Figure:
    """The walls, the true landmarks and what the robots observe (paper fig. 3(a))."""
    sheet = Figure((10.0, 9.0), layout="constrained")
    if run.walls is None or run.true_landmarks is None:
        raise ValueError("the run knows no world: it is not of a simulation")
    axes: Axes3D = sheet.add_subplot(projection="3d")
    _draw_walls(axes, run.walls)
    axes.scatter(*run.true_landmarks.positions.T, marker="*", s=16, color="#555555", linewidths=0)
    for colour, robot, seen in zip(ROBOT_COLOURS, run.robots, views, strict=False):
        sights = [[seen.eye, point] for point in seen.points]
        axes.add_collection3d(
            Line3DCollection(sights, colors=colour, linestyles="--", linewidths=0.8)
        )
        axes.scatter(*seen.eye, color=colour, s=40, depthshade=False, label=robot)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", zticks=[0, 1, 2])
    axes.set_box_aspect((30, 30, 5))
    axes.view_init(elev=50, azim=-70)
    axes.legend(loc="upper left", frameon=False)
    return sheet


def _draw_walls(axes: Axes3D, walls: Walls) -> None:
    height = walls.height_m
    faces = [
        [(x0, y0, 0), (x1, y1, 0), (x1, y1, height), (x0, y0, height)]
        for x0, y0, x1, y1 in walls.segments
    ]
    axes.add_collection3d(
        Poly3DCollection(faces, facecolors="#DADADA", edgecolors="#B0B0B0", alpha=0.25)
    )
    ends = walls.segments.reshape(-1, 2)
    axes.set(xlim=(ends[:, 0].min(), ends[:, 0].max()), ylim=(ends[:, 1].min(), ends[:, 1].max()))
    axes.set_zlim(0, height)


def map_figure(run: Run, particles: dict[str, np.ndarray]) -> Figure:
    """The map and the paths with the particles of each robot at the end (paper fig. 3(b))."""
    sheet = plots.map_figure(run)
    (axes,) = sheet.axes
    for colour, cloud in zip(ROBOT_COLOURS, particles.values(), strict=False):
        axes.plot(*cloud[:, :2].T, ".", markersize=3, color=colour, alpha=0.5, zorder=7)
    legend = axes.get_legend()
    handles = [] if legend is None else [*legend.legend_handles]
    handles.append(Line2D([], [], marker=".", linestyle="", color="#222222", label="particles"))
    axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)
    return sheet
