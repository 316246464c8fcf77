"""What the slider shows at each instant: where robots are, and what they see."""

import base64

import numpy as np

from msg_defs.types import FrameRecord, Trajectory
from multi_robot_slam.models.symmetric import pack
from multi_robot_slam.report.size import extent, full_roots, roots
from multi_robot_slam.report.timeline import Timeline, newest_rows
from multi_robot_slam.runs import Run

MOST_LANDMARKS = 6000
"""Shown in the scene; of more, those observed most often."""
MOST_SIGHT_LINES = 40
"""Shown of one robot at one instant; of more, every n-th."""


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
    spatial = pack(full_roots(run.landmarks))
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


def first_seen(run: Run, times: Timeline) -> np.ndarray:
    """(N,) int64: instant at which each landmark of the map was first seen; 0 if none recorded."""
    seen: dict[int, int] = {}
    for row, step in enumerate(run.steps):
        for frame in step.frames:
            for landmark in frame.landmarks.tolist():
                seen.setdefault(landmark, row)
    return np.array([seen.get(i, 0) for i in run.landmarks.ids.tolist()], np.int64) // times.every


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
