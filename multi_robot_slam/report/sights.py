"""What the page shows of the cameras: pictures with the landmarks in them."""

import base64

import numpy as np

from msg_defs.errors import InputError
from msg_defs.types import FrameRecord
from multi_robot_slam.report.slider import packed
from multi_robot_slam.report.timeline import Timeline
from multi_robot_slam.runs import Run, View

MOST_BYTES = 1_800_000
"""Of the pictures of all robots together; of more, every other one is left out."""

MATCHED, NEW, REJECTED = range(3)
"""What became of an observation."""


def sights(run: Run, times: Timeline) -> dict[str, dict]:
    """The pictures of each robot that has any, and the points to draw in them.

    `instants` are the slider's at which each picture becomes the newest; `starts` is where the
    points of each begin in `points` (column, row [px]) and `kinds`.
    """
    found = {robot: _usable(run, robot) for robot in run.views if robot in run.robots}
    while sum(len(picture) for own in found.values() for *_, picture in own) > MOST_BYTES:
        found = {robot: own[::2] for robot, own in found.items()}
        if all(len(own) <= 1 for own in found.values()):
            break
    return {robot: _packed(robot, own, times) for robot, own in found.items() if own}


_Usable = tuple[View, np.ndarray, np.ndarray, bytes]
"""A view, its points (B, 2), what became of them (B,), and the JPEG."""


def _usable(run: Run, robot: str) -> list[_Usable]:
    """The views that belong to a frame of the run, and are not damaged."""
    frames = {s.stamp_ns: f for s in run.steps for f in s.frames if f.robot == robot}
    found = []
    for view in run.views[robot]:
        if view.stamp_ns not in frames:
            continue
        try:
            points, picture = view.points_px(robot), view.jpeg()
        except InputError:
            continue
        points = points[run.config.plausible.used(len(points))]
        kinds = _kinds(frames[view.stamp_ns])
        if len(kinds) == len(points):
            found.append((view, points, kinds, picture))
    return found


def _kinds(frame: FrameRecord) -> np.ndarray:
    """(B,) what became of each observation of a frame."""
    return np.where(frame.is_new, np.where(frame.is_rejected, REJECTED, NEW), MATCHED)


def _packed(robot: str, own: list[_Usable], times: Timeline) -> dict:
    stamps = np.array([view.stamp_ns for view, *_ in own], np.int64)
    points = [points for _, points, *_ in own]
    width_px, height_px = own[0][0].size_px()
    return {
        "size": [width_px, height_px],
        "instants": packed(np.searchsorted(times.stamps_ns, stamps), "i4"),
        "taken": packed(times.seconds(stamps), "f4"),
        "pictures": [base64.b64encode(picture).decode() for *_, picture in own],
        "starts": packed(np.cumsum([0, *map(len, points)]), "i4"),
        "points": packed(np.concatenate(points), "f4"),
        "kinds": packed(np.concatenate([kinds for _, _, kinds, _ in own]), "i4"),
    }
