"""The report's building in three dimensions: what stands still, and what the slider moves."""

import base64
from itertools import cycle
from typing import Any

import numpy as np
import plotly.graph_objects as go

from msg_defs.types import FrameRecord, LandmarkMap, Trajectory, Walls
from multi_robot_slam.models import stereo
from multi_robot_slam.report.timeline import Timeline, newest_rows, thinned
from multi_robot_slam.runs import RobotRun, Run
from multi_robot_slam.runs.colours import ROBOT_COLOURS
from multi_robot_slam.runs.robot_errors import odometry_in_map

MOST_LANDMARKS = 6000
"""Shown in the scene; of more, those observed most often."""
MOST_SIGHT_LINES = 40
"""Shown of one robot at one instant; of more, every n-th."""
SIGMAS = 2.0
"""Half axes of every ellipse and ellipsoid, in standard deviations."""
SCALES = (1, 5, 10, 30)
"""How many times larger ellipses and ellipsoids can be drawn."""
LEGIBLE = 1 / 40
"""Share of the scene's width that most ellipsoids should not exceed at first."""
NEUTRAL = "#7D8590"
"""What belongs to no robot; readable on white and on black."""
MARGIN = 0.03
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


def frames(run: Run, times: Timeline) -> dict:
    """What the slider shows at each of S instants, and the landmarks by when they were first seen.

    Arrays are little-endian and base64, as in Plotly's figures. Roots are symmetric square roots of
    covariances times `SIGMAS`: they turn the unit circle (xx, xy, yy) or unit sphere (xx, xy, xz,
    yy, yz, zz) into the ellipse or ellipsoid [m].
    """
    first = first_seen(run, times)
    shown = np.argsort(-run.landmarks.observations.astype(np.int64), kind="stable")
    shown = np.sort(shown[:MOST_LANDMARKS])
    shown = shown[np.argsort(first[shown], kind="stable")]
    spatial = _full_roots(run.landmarks)[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    row_of = {landmark: row for row, landmark in enumerate(run.landmarks.ids[shown].tolist())}
    return {
        "seconds": packed(times.seconds(times.stamps_ns), "f4"),
        "steps": packed([run.steps[row].step for row in times.steps], "i4"),
        "body_m": 0.018 * float(np.ptp(extent(run), axis=0)[:2].max()),
        "landmarks": {
            "positions": packed(run.landmarks.positions[shown], "f4"),
            "roots": packed(spatial[shown], "f4"),
            "observations": packed(run.landmarks.observations[shown], "i4"),
            "ids": packed(run.landmarks.ids[shown], "i4"),
            "first": packed(first[shown], "i4"),
        },
        "team": list(run.robots),
        "robots": {name: _robot_frames(run, name, times, row_of) for name in run.robots},
    }


def packed(values: object, dtype: str) -> dict[str, str]:
    """An array as Plotly's figures have it: the type, and its bytes in base64."""
    data = np.ascontiguousarray(values, f"<{dtype}").tobytes()
    return {"dtype": dtype, "bdata": base64.b64encode(data).decode()}


def extent(run: Run) -> np.ndarray:
    """(2, 3): lowest and highest corner of the scene [m].

    It holds live, later and true paths, walls, and all landmarks but the outermost hundredth.
    """
    flat = [path.poses[:, :2] for r in run.robots.values() for path in (r.online, r.path)]
    flat += [r.truth.poses[:, :2] for r in run.robots.values() if r.truth is not None]
    flat += [r.start_pose[None, :2] for r in run.robots.values()]
    cameras = [run.config.mount_of(robot).up_m for robot in range(len(run.config.robots))]
    heights = [0.0, 2 * max(cameras)]
    if run.walls is not None:
        flat.append(run.walls.segments.reshape(-1, 2))
        heights.append(run.walls.height_m)
    if len(run.landmarks.ids):
        inner = np.quantile(run.landmarks.positions, [0.01, 0.99], axis=0)
        flat.append(inner[:, :2])
        heights += inner[:, 2].tolist()
    places = np.concatenate(flat)
    low = np.array([*places.min(axis=0), min(heights)])
    high = np.array([*places.max(axis=0), max(heights)])
    margin = MARGIN * max((high - low)[:2].max(), 1.0)
    return np.array([low, high]) + np.outer([-margin, margin], [1.0, 1.0, 0.0])


def first_scale(run: Run) -> int:
    """The largest of `SCALES` at which nine in ten ellipsoids are legible, else the smallest."""
    if not len(run.landmarks.ids):
        return SCALES[0]
    largest = np.linalg.norm(_full_roots(run.landmarks), ord=2, axis=(1, 2))
    room = LEGIBLE * np.ptp(extent(run), axis=0)[:2].max()
    legible = [scale for scale in SCALES if scale * np.quantile(largest, 0.9) <= room]
    return max(legible, default=SCALES[0])


def first_seen(run: Run, times: Timeline) -> np.ndarray:
    """(N,) int64: instant at which each landmark of the map was first seen; 0 if none recorded."""
    seen: dict[int, int] = {}
    for row, step in enumerate(run.steps):
        for frame in step.frames:
            for landmark in frame.landmarks.tolist():
                seen.setdefault(landmark, row)
    return np.array([seen.get(i, 0) for i in run.landmarks.ids.tolist()], np.int64) // times.every


def roots(covariances: np.ndarray) -> np.ndarray:
    """Symmetric square roots (n, d, d) of positive semi-definite (n, d, d), times `SIGMAS`."""
    values, vectors = np.linalg.eigh(covariances)
    scaled = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return SIGMAS * scaled @ vectors.transpose(0, 2, 1)


def _full_roots(landmarks: LandmarkMap) -> np.ndarray:
    return roots(stereo.unpack(landmarks.covariances))


def _robot_frames(run: Run, name: str, times: Timeline, row_of: dict[int, int]) -> dict:
    estimates = [e for step in run.steps for e in step.estimates if e.robot == name]
    rows = newest_rows(np.array([e.stamp_ns for e in estimates], np.int64), times.stamps_ns)
    poses, means, spreads = (np.full((len(estimates), 3), np.nan) for _ in range(3))
    if estimates:
        poses = np.array([e.pose for e in estimates])
        means = np.array([e.pose if e.mean is None else e.mean for e in estimates])
        flat = roots(np.array([e.covariance[:2, :2] for e in estimates]))
        spreads = flat[:, [0, 0, 1], [0, 1, 1]]
    robot, newest = run.robots[name], _newest_frames(run, name, times)
    mount = run.config.mount_of(run.config.robots.index(name))
    seen = [_rows_seen(frame, row_of) if frame else [] for frame in newest]
    met = [frame.others[~frame.is_other_rejected].tolist() if frame else [] for frame in newest]
    seen_starts, all_seen = _listed(seen)
    met_starts, all_met = _listed(met)
    return {
        "camera_m": mount.up_m,
        "poses": packed(_at(poses, rows), "f4"),
        "means": packed(_at(means, rows), "f4"),
        "roots": packed(_at(spreads, rows), "f4"),
        "truth": None if robot.truth is None else packed(_true(robot.truth, times), "f4"),
        "seen": all_seen,
        "seen_starts": seen_starts,
        "met": all_met,
        "met_starts": met_starts,
    }


def _true(truth: Trajectory, times: Timeline) -> np.ndarray:
    return _at(truth.poses, newest_rows(truth.stamps_ns, times.stamps_ns))


def _at(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """`values[rows]`, NaN where a row is -1."""
    return np.concatenate([values, np.full((1, 3), np.nan)])[rows]


def _rows_seen(frame: FrameRecord, row_of: dict[int, int]) -> list[int]:
    """Rows of the shown landmarks in a frame, `MOST_SIGHT_LINES` at most."""
    found = [row_of[i] for i in frame.landmarks.tolist() if i in row_of]
    return found[:: max(1, -(-len(found) // MOST_SIGHT_LINES))]


def _newest_frames(run: Run, name: str, times: Timeline) -> list[FrameRecord | None]:
    """The newest frame of a robot at each instant, None before the first."""
    own = [(s.stamp_ns, f) for s in run.steps for f in s.frames if f.robot == name]
    newest = newest_rows(np.array([stamp for stamp, _ in own], np.int64), times.stamps_ns)
    return [own[row][1] if row >= 0 else None for row in newest.tolist()]


def _listed(lists: list[list[int]]) -> tuple[dict, dict]:
    """Packed: where each list starts in all of them one after the other, and these.

    `values[starts[s]:starts[s + 1]]` belongs to instant s.
    """
    starts = np.cumsum([0, *map(len, lists)])
    return packed(starts, "i4"), packed([value for values in lists for value in values], "i4")


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
