"""The report's curves over time. Every chart has the time [s] on its x axis."""

from collections.abc import Callable

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from msg_defs.types import Estimate, Trajectory
from multi_robot_slam.report import levels
from multi_robot_slam.report.scene import NEUTRAL, colours
from multi_robot_slam.report.size import SIGMAS
from multi_robot_slam.report.timeline import Timeline, first_rows, grouped, thinned
from multi_robot_slam.runs import Run
from multi_robot_slam.runs.robot_errors import RobotErrors, robot_errors
from multi_robot_slam.runs.trajectory_errors import PoseErrors, pose_errors

REJECTED = "#C0392B"
SPACING = 0.06
"""Between the four parts of a robot's chart, as a share of its height; a legend fits in."""
LIVE = "live"
"""The kind of path that has a robot's own name in the legend: as it was published."""
AXES = ("x [m]", "y [m]", "heading [rad]")


def charts(run: Run, times: Timeline) -> dict[str, go.Figure]:
    """Chart of each kind the run has data for, and `robot <name>` of each robot."""
    errors = robot_errors(run)
    found = {f"robot {name}": _robot(run, name, times, errors) for name in run.robots}
    if run.steps:
        found |= {"effective": _effective(run, times), "durations": _durations(run, times)}
    if errors:
        found["distances"] = _distances(run, errors, times)
    _mark_levels(run, found, times)
    if len(times.steps) > 1:
        for figure in found.values():
            figure.update_xaxes(range=[0.0, times.seconds(times.stamps_ns[-1])])
    return found


def _mark_levels(run: Run, found: dict[str, go.Figure], times: Timeline) -> None:
    """A line where the monitor changed its mind of a robot, in the charts of its errors."""
    for name, own in levels.changes(run).items():
        line = {"color": colours(run)[name], "width": 1.2, "dash": "dashdot"}
        for change in own:
            x = float(times.seconds(np.array(change.stamp_ns)))
            text = change.told
            for chart, told in ((f"robot {name}", text), ("distances", f"{name}: {text}")):
                if chart in found:
                    across = {"yref": "paper", "y0": 0, "y1": 1}
                    label = {"text": told, "textposition": "end", "xanchor": "right"}
                    found[chart].add_shape(
                        type="line", x0=x, x1=x, **across, line=line, label=label
                    )


def inside(run: Run, name: str) -> np.ndarray | None:
    """(3,) share of a robot's published means whose x, y, heading are within 2 sigma of the truth.

    None without truth.
    """
    robot, estimates = run.robots[name], _estimates(run, name)
    if robot.truth is None or not estimates:
        return None
    errors, bounds = _mean_errors(estimates, robot.truth, name)
    return np.mean(np.abs(errors.errors) <= bounds, axis=0) if len(bounds) else None


def _estimates(run: Run, name: str) -> list[Estimate]:
    found = [e for step in run.steps for e in step.estimates if e.robot == name]
    return sorted(found, key=lambda e: e.stamp_ns)


def _mean_errors(
    estimates: list[Estimate], truth: Trajectory, name: str
) -> tuple[PoseErrors, np.ndarray]:
    """Errors of the means (the poses where none was recorded), and 2 sigma (T, 3) at the same."""
    stamps = np.array([e.stamp_ns for e in estimates], np.int64)
    means = np.array([e.pose if e.mean is None else e.mean for e in estimates])
    errors = pose_errors(Trajectory(stamps, means), truth, f"published means of {name}")
    rows = np.searchsorted(stamps, errors.stamps_ns)
    return errors, _bounds(estimates)[rows]


def _bounds(estimates: list[Estimate]) -> np.ndarray:
    """(T, 3): 2 sigma of x [m], y [m], heading [rad]."""
    variances = np.array([np.diag(e.covariance) for e in estimates]).reshape(-1, 3)
    return SIGMAS * np.sqrt(np.maximum(variances, 0.0))


def _robot(run: Run, name: str, times: Timeline, errors: dict[str, RobotErrors]) -> go.Figure:
    """Errors of x, y and heading with 2-sigma bounds, and the association record below."""
    figure = make_subplots(rows=4, shared_xaxes=True, vertical_spacing=SPACING)
    colour = colours(run)[name]
    _draw_bounds(figure, run, name, times, colour)
    if name in errors:
        _draw_final(figure, errors[name], times)
    _draw_associations(figure, run, name, times, colour)
    for row, title in enumerate((*AXES, "per frame"), start=1):
        figure.update_yaxes(title_text=title, row=row, col=1)
    figure.update_xaxes(title_text="time [s]", row=4, col=1)
    flat = {"orientation": "h", "traceorder": "normal", "x": 0, "yanchor": "bottom"}
    lowest = {**flat, "y": figure.layout.yaxis4.domain[1]}
    return figure.update_layout(legend={**flat, "y": 1}, legend2=lowest)


def _draw_bounds(figure: go.Figure, run: Run, name: str, times: Timeline, colour: str) -> None:
    estimates, truth = _estimates(run, name), run.robots[name].truth
    if not estimates:
        return
    stamps, bounds, errors = np.array([e.stamp_ns for e in estimates]), _bounds(estimates), None
    if truth is not None:
        (stamps, errors, _), bounds = _mean_errors(estimates, truth, name)
    rows = thinned(len(stamps), times.most)
    seconds, bounds = times.seconds(stamps[rows]), bounds[rows]
    around = np.concatenate([seconds, seconds[::-1]])
    for axis in range(3):
        place = {"row": axis + 1, "col": 1}
        band = np.concatenate([bounds[:, axis], -bounds[::-1, axis]])
        look = {"fill": "toself", "fillcolor": colour, "opacity": 0.22, "line": {"width": 0}}
        legend = {"showlegend": axis == 0, "hoverinfo": "skip"}
        shape = go.Scatter(x=around, y=band, mode="lines", name="2 σ", **look, **legend)
        figure.add_trace(shape, **place)
        if errors is not None:
            figure.add_trace(_line(seconds, errors[rows, axis], "live", colour, axis == 0), **place)


def _draw_final(figure: go.Figure, errors: RobotErrors, times: Timeline) -> None:
    """The whole path at the end, and the refined one where there is one."""
    for title, series, dash in (
        ("after the run", errors.path, "dash"),
        ("refined", errors.refined, "dot"),
    ):
        rows = thinned(len(series.stamps_ns), times.most)
        for axis in range(3 if len(rows) else 0):
            line = _line(
                times.seconds(series.stamps_ns[rows]),
                series.errors[rows, axis],
                title,
                NEUTRAL,
                axis == 0,
                dash,
            )
            figure.add_trace(line, row=axis + 1, col=1)


def _draw_associations(
    figure: go.Figure, run: Run, name: str, times: Timeline, colour: str
) -> None:
    """Mean observations a frame: matched, new, and new because every match was rejected."""
    own = [(step.stamp_ns, f) for step in run.steps for f in step.frames if f.robot == name]
    if not own:
        return
    new = np.array([np.count_nonzero(f.is_new) for _, f in own])
    rejected = np.array([np.count_nonzero(f.is_new & f.is_rejected) for _, f in own])
    matched = np.array([len(f.is_new) for _, f in own]) - new
    stamps = np.array([stamp for stamp, _ in own])[first_rows(len(own), times.most)]
    sizes = grouped(np.add, np.ones(len(own)), times.most)
    for title, counts, shade in (
        ("matched", matched, colour),
        ("new", new - rejected, NEUTRAL),
        ("rejected", rejected, REJECTED),
    ):
        means = grouped(np.add, counts, times.most) / sizes
        look = {"mode": "lines", "line": {"width": 0, "shape": "hvh"}, "fillcolor": shade}
        area = go.Scatter(
            x=times.seconds(stamps),
            y=means,
            stackgroup="all",
            name=title,
            legend="legend2",
            **look,
        )
        figure.add_trace(area, row=4, col=1)


def _distances(run: Run, errors: dict[str, RobotErrors], times: Timeline) -> go.Figure:
    """How far from the truth: live, after the run, refined, odometry."""
    figure = go.Figure()
    kinds: dict[str, tuple[Callable, str]] = {
        LIVE: (lambda e: e.online, "solid"),
        "after the run": (lambda e: e.path, "longdash"),
        "refined": (lambda e: e.refined, "dash"),
        "odometry": (lambda e: e.odometry, "dot"),
    }
    for kind, (of, dash) in kinds.items():
        drawn = {name: of(e) for name, e in errors.items() if len(of(e).stamps_ns)}
        for name, series in drawn.items():
            rows = thinned(len(series.stamps_ns), times.most)
            metres = np.hypot(*series.errors[rows, :2].T)
            seconds = times.seconds(series.stamps_ns[rows])
            own = kind == LIVE
            title = name if own else f"{name}, {kind}"
            figure.add_trace(_line(seconds, metres, title, colours(run)[name], own, dash))
        if drawn:
            figure.add_trace(_line([None], [None], kind, NEUTRAL, True, dash))
    figure.update_yaxes(title_text="distance [m]", rangemode="tozero")
    return figure.update_xaxes(title_text="time [s]")


def _effective(run: Run, times: Timeline) -> go.Figure:
    """The least effective sample size of each group of steps; where particles were resampled."""
    effective = grouped(np.minimum, [s.effective_particles for s in run.steps], times.most)
    resampled = grouped(np.logical_or, [s.resampled for s in run.steps], times.most)
    seconds = times.seconds(times.stamps_ns)
    particles = run.config.filter.particles
    limit = run.config.filter.resample_below * particles
    dots = {"color": "#D55E00", "size": 6}
    figure = go.Figure(
        [
            _line(seconds, effective, "effective particles", NEUTRAL),
            go.Scatter(
                x=seconds[resampled],
                y=effective[resampled],
                mode="markers",
                marker=dots,
                name="resampled",
            ),
        ]
    )
    figure.add_hline(limit, line={"color": NEUTRAL, "dash": "dot", "width": 1})
    figure.update_yaxes(title_text=f"of {particles} particles", rangemode="tozero")
    return figure.update_xaxes(title_text="time [s]")


def _durations(run: Run, times: Timeline) -> go.Figure:
    """The longest step of each group."""
    longest = grouped(np.maximum, [s.duration_ms for s in run.steps], times.most)
    dots = {"color": NEUTRAL, "size": 4}
    seconds = times.seconds(times.stamps_ns)
    figure = go.Figure(
        go.Scatter(x=seconds, y=longest, mode="markers", marker=dots, name="step [ms]")
    )
    figure.update_yaxes(title_text="step [ms]", type="log")
    return figure.update_xaxes(title_text="time [s]")


def _line(
    x: object, y: object, name: str, colour: str, showlegend: bool = True, dash: str = "solid"
) -> go.Scatter:
    line = {"color": colour, "width": 1.6, "dash": dash}
    return go.Scatter(x=x, y=y, mode="lines", name=name, line=line, showlegend=showlegend)
