"""The report's building in three dimensions: its layers, and the traces that draw them."""

from itertools import cycle
from typing import Any

import numpy as np
import plotly.graph_objects as go

from msg_defs.types import LandmarkMap, Trajectory, Walls
from multi_robot_slam.report.size import extent
from multi_robot_slam.report.slider import MOST_LANDMARKS
from multi_robot_slam.report.timeline import Timeline, thinned
from multi_robot_slam.runs import RobotRun, Run
from multi_robot_slam.runs.colours import ROBOT_COLOURS
from multi_robot_slam.runs.robot_errors import odometry_in_map

NEUTRAL = "#7D8590"
"""What belongs to no robot; readable on white and on black."""
LIFT_M = 0.01
"""How far an estimate is drawn above the ground, where it would flicker with the true path."""

LAYERS = {
    "landmarks": "landmarks",
    "uncertainty": "their uncertainty",
    "truth": "true paths",
    "odometry": "odometry",
    "live": "live paths",
    "after": "paths after the run",
    "refined": "refined paths",
    "sight": "lines of sight",
    "walls": "walls",
    "true_landmarks": "true landmarks",
}
"""What can be shown and hidden, and what it is called."""
HIDDEN_AT_FIRST = {"after", "true_landmarks"}


def colours(run: Run) -> dict[str, str]:
    """The accent colour of each robot."""
    return dict(zip(run.robots, cycle(ROBOT_COLOURS), strict=False))


def figure(run: Run, times: Timeline) -> go.Figure:
    """All traces, each with its layer and robot in `meta`; those that move are still empty."""
    still = [*_walls(run.walls), *_true_landmarks(run.true_landmarks)]
    landmarks = [_moving("landmarks", go.Scatter3d, **_LANDMARK)] if len(run.landmarks.ids) else []
    if landmarks:
        landmarks.append(_moving("uncertainty", go.Mesh3d, **_ELLIPSOID))
    robots = [
        trace
        for (name, colour), robot in zip(colours(run).items(), run.robots.values(), strict=True)
        for trace in [*_paths(name, colour, robot, times), *_body(name, colour, robot)]
    ]
    low, high = extent(run)
    names = dict(zip("xyz", zip(low.tolist(), high.tolist(), strict=True), strict=True))
    axes = {f"{axis}axis": {"title": f"{axis} [m]", "range": names[axis]} for axis in names}
    ratio = (high - low) / (high - low)[:2].max()
    aspect = dict(zip("xyz", ratio.tolist(), strict=True))
    scene = axes | {"aspectmode": "manual", "aspectratio": aspect}
    return go.Figure([*still, *landmarks, *robots], {"scene": scene, "showlegend": False})


_ELLIPSOID: dict[str, Any] = {
    "color": NEUTRAL,
    "opacity": 0.35,
    "hoverinfo": "skip",
    "lighting": {"ambient": 0.7},
}
_LANDMARK: dict[str, Any] = {
    "mode": "markers",
    "marker": {"size": 2.2, "color": NEUTRAL},
    "hovertemplate": "landmark %{text}<br>%{x:.2f}, %{y:.2f}, %{z:.2f} m<extra></extra>",
}


_BODY: dict[str, Any] = {"flatshading": True, "opacity": 0.55, "lighting": {"ambient": 0.85}}


def _moving(layer: str, kind: type, robot: str | None = None, **style: object) -> object:
    return kind(x=[], y=[], z=[], meta={"layer": layer, "robot": robot, "moves": True}, **style)


def _walls(walls: Walls | None) -> list:
    if walls is None or not len(walls.segments):
        return []
    x0, y0, x1, y1 = walls.segments.T
    low, high = np.zeros_like(x0), np.full_like(x0, walls.height_m)
    x, y = np.column_stack([x0, x1, x1, x0]), np.column_stack([y0, y1, y1, y0])
    z = np.column_stack([low, low, high, high])
    corner = 4 * np.arange(len(x0))
    i, j, k = (
        np.column_stack([corner + first, corner + second]).ravel()
        for first, second in ((0, 0), (1, 2), (2, 3))
    )
    outline = [np.column_stack([*a.T, a[:, 0], np.full(len(a), np.nan)]).ravel() for a in (x, y, z)]
    style = {"meta": {"layer": "walls"}, "hoverinfo": "skip"}
    faces = {"i": i, "j": j, "k": k, "opacity": 0.12, "flatshading": True, "color": NEUTRAL}
    return [
        go.Mesh3d(x=x.ravel(), y=y.ravel(), z=z.ravel(), **faces, **style),
        go.Scatter3d(
            **dict(zip("xyz", outline, strict=True)),
            mode="lines",
            line={"color": NEUTRAL, "width": 1.5},
            opacity=0.55,
            **style,
        ),
    ]


def _true_landmarks(landmarks: LandmarkMap | None) -> list:
    if landmarks is None:
        return []
    x, y, z = landmarks.positions[thinned(len(landmarks.ids), MOST_LANDMARKS)].T
    marker = {"size": 2.5, "color": NEUTRAL, "symbol": "cross"}
    meta = {"layer": "true_landmarks"}
    style = {"mode": "markers", "marker": marker, "opacity": 0.6, "hoverinfo": "skip"}
    return [go.Scatter3d(x=x, y=y, z=z, meta=meta, **style)]


def _paths(name: str, colour: str, robot: RobotRun, times: Timeline) -> list:
    kinds: dict[str, tuple[Trajectory | None, dict[str, Any], float]] = {
        "odometry": (odometry_in_map(robot), {"width": 2.5, "dash": "dot"}, 0.0),
        "truth": (robot.truth, {"width": 11}, 0.0),
        "live": (robot.online, {"width": 3.5}, LIFT_M),
        "after": (robot.path, {"width": 3.5, "dash": "longdash"}, 2 * LIFT_M),
        "refined": (robot.refined, {"width": 5, "dash": "dash"}, 3 * LIFT_M),
    }
    return [
        _path(name, layer, path, {"color": colour, **line}, lift_m, times)
        for layer, (path, line, lift_m) in kinds.items()
        if path is not None and len(path.stamps_ns)
    ]


def _path(
    name: str, layer: str, path: Trajectory, line: dict, lift_m: float, times: Timeline
) -> go.Scatter3d:
    """A path with the time [s] of each point in `customdata`, for which the page cuts it."""
    rows = thinned(len(path.poses), times.most)
    x, y, _ = path.poses[rows].T
    told = f"{name}, {LAYERS[layer].replace('paths', 'path')}<br>%{{x:.2f}}, %{{y:.2f}} m"
    return go.Scatter3d(
        x=x,
        y=y,
        z=np.full_like(x, lift_m),
        customdata=times.seconds(path.stamps_ns[rows]),
        mode="lines",
        line=line,
        opacity=0.28 if layer == "truth" else 1.0,
        meta={"layer": layer, "robot": name, "is_path": True},
        hovertemplate=f"{told}<br>%{{customdata:.1f}} s<extra></extra>",
    )


def _body(name: str, colour: str, robot: RobotRun) -> list:
    """The robot as an arrow-head, its 2-sigma ellipse, what it sees, and where it truly is."""
    line = {"color": colour, "width": 5}
    sight = {"color": colour, "width": 1.5}
    told = {"hovertemplate": f"{name}<extra></extra>"}
    lines = {"mode": "lines", "hoverinfo": "skip"}
    traces = [
        _moving("body", go.Mesh3d, name, color=colour, **_BODY, **told),
        _moving("ellipse", go.Scatter3d, name, line=line, **lines),
        _moving("sight", go.Scatter3d, name, line=sight, opacity=0.45, **lines),
    ]
    if robot.truth is not None:
        traces.append(_moving("true_body", go.Scatter3d, name, line=line, **lines))
    return traces
