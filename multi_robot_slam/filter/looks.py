"""Every look at a landmark: a frame in which it should be found, whether it was or not.

A look is a frame from a new place of its robot in which the landmark is in view (`views`). If it
was not found, the look counts only where its view was free, for something known was found behind it
in nearly the same direction, and where the robot was where it believes to be, for it found others
that were known when the landmark was last seen.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from multi_robot_slam.filter.settled import MOST_ROBOTS
from multi_robot_slam.filter.views import BEARING_RAD, Views, is_in_view
from multi_robot_slam.models.compiled import kernel
from multi_robot_slam.models.frames import Record

NEARLY_RAD = np.radians(3.0)
"""Directions nearly the same; in simulated rooms 96 % of the views so found free are."""

WITNESSES = 2
"""Known landmarks that a robot has to find to be where it believes; one may be a wrong match."""


class Frames(NamedTuple):
    """F frames in their order, with O observations in all."""

    robots: np.ndarray
    """(F,) int64."""
    poses: np.ndarray
    """(F, 3) float64."""
    eyes: np.ndarray
    """(F, 3) float64: the camera in `base_link` [m]."""
    newest: np.ndarray
    """(F,) int64: the largest id there was; -1 where nothing was seen."""
    starts: np.ndarray
    """(F + 1,) int64: frame f has observations starts[f] .. starts[f + 1] - 1."""
    ids: np.ndarray
    """(O,) int64: landmark of each observation."""
    is_known: np.ndarray
    """(O,) bool: it was there before."""
    rays: np.ndarray
    """(O, 3) float64: from the camera, in `base_link` axes [m]."""


def frames_of(
    records: Sequence[Record], poses: np.ndarray, identities: Sequence[np.ndarray]
) -> Frames:
    """The `records` with their `poses` (F, 3) and `identities` (B,) each."""
    none, counts = np.empty(0), [len(own) for own in identities]
    seen = [r for r in records if len(r.positions)]
    rays = [r.positions if r.ranging is None else r.ranging.rays for r in seen]
    eyes = np.zeros((len(records), 3))
    eyes[np.array(counts, int) > 0] = np.reshape(
        [r.positions[0] - own[0] for r, own in zip(seen, rays, strict=True)], (-1, 3)
    )
    new_ids = np.concatenate([none, *(r.new_ids for r in records)]).astype(np.int64)
    ids = np.concatenate([none, *identities]).astype(np.int64)
    return Frames(
        np.array([r.robot for r in records], np.int64),
        np.asarray(poses, float).reshape(-1, 3),
        eyes,
        np.array([r.new_ids[-1] if len(r.new_ids) else -1 for r in records], np.int64),
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        ids,
        ids != new_ids,
        np.concatenate([np.empty((0, 3)), *rays]),
    )


@kernel
def go_through(
    frames: Frames,
    rows: np.ndarray,
    places: np.ndarray,
    sigmas: np.ndarray,
    views: Views,
    apart: tuple[float, float],
    anchors: np.ndarray,
    visits: np.ndarray,
    counts: tuple[np.ndarray, ...],
) -> None:
    """Take the evidence of all frames, in their order.

    Parameters
    ----------
    rows : (O,) of the landmark of each observation; -1: it is none of these.
    places, sigmas : (n, 3), (n,) as in `Placed`.
    apart : how far apart places are [m], [rad].
    anchors, visits : as in `Existence`, changed in place.
    counts : the arrays of `Evidence` after the ids, changed in place.
    """
    seen_from, last_place, horizon, found, failed, in_a_row = counts
    is_seen, ray = np.zeros(len(places), np.bool_), np.empty(3)
    for f in range(len(frames.robots)):
        robot, first, last = frames.robots[f], frames.starts[f], frames.starts[f + 1]
        is_new_place = _arrive(frames.poses[f], robot, apart, anchors, visits)
        for o in range(first, last):
            if rows[o] >= 0:
                is_seen[rows[o]] = True
        if is_new_place:
            turn = np.array([np.cos(frames.poses[f, 2]), np.sin(frames.poses[f, 2])])
            witness = _witness(frames, f)
            reach = _reach(frames, f)
            bearings = np.arctan2(frames.rays[first:last, 1], frames.rays[first:last, 0])
            for n in range(len(places)):
                if seen_from[n] == 0 or (witness > horizon[n] and not is_seen[n]):
                    continue
                distance = _point(frames, f, turn, places[n], ray)
                if 4 * sigmas[n] > BEARING_RAD * distance:
                    continue
                if not is_seen[n] and (
                    distance > reach or not _is_free(frames, f, rows, n, ray, bearings)
                ):
                    continue
                if not is_in_view(views, robot, ray):
                    continue
                if is_seen[n]:
                    found[n] += 1
                else:
                    failed[n] += 1
                    in_a_row[n] += 1
        place = visits[robot] * MOST_ROBOTS + robot
        for o in range(first, last):
            n = rows[o]
            if n < 0:
                continue
            is_seen[n] = False
            if seen_from[n] == 0 or last_place[n] != place:
                seen_from[n] += 1
                last_place[n] = place
            horizon[n] = frames.newest[f]
            in_a_row[n] = 0


@kernel
def _arrive(
    pose: np.ndarray,
    robot: int,
    apart: tuple[float, float],
    anchors: np.ndarray,
    visits: np.ndarray,
) -> bool:
    """Whether `pose` is a new place of the robot, which begins there."""
    anchor = anchors[robot]
    turn = abs((pose[2] - anchor[2] + np.pi) % (2 * np.pi) - np.pi)
    if np.hypot(pose[0] - anchor[0], pose[1] - anchor[1]) < apart[0] and turn < apart[1]:
        return False
    anchors[robot] = pose
    visits[robot] += 1
    return True


@kernel
def _witness(frames: Frames, f: int) -> int:
    """The largest id of the `WITNESSES` oldest landmarks that frame f found again."""
    least = np.full(WITNESSES, np.iinfo(np.int64).max)
    for o in range(frames.starts[f], frames.starts[f + 1]):
        if frames.is_known[o] and frames.ids[o] < least[-1]:
            least[-1] = frames.ids[o]
            least.sort()
    return least[-1]


@kernel
def _reach(frames: Frames, f: int) -> float:
    """Distance of the farthest known landmark that frame f found [m]."""
    farthest = 0.0
    for o in range(frames.starts[f], frames.starts[f + 1]):
        if frames.is_known[o]:
            ray = frames.rays[o]
            farthest = max(farthest, np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2))
    return farthest


@kernel
def _point(frames: Frames, f: int, turn: np.ndarray, place: np.ndarray, ray: np.ndarray) -> float:
    """Distance from the camera in frame f to `place` (3,) [m]; writes the `ray` (3,) to it.

    `turn` (2,): cosine and sine of the frame's yaw.
    """
    x, y = place[0] - frames.poses[f, 0], place[1] - frames.poses[f, 1]
    ray[0] = turn[0] * x + turn[1] * y - frames.eyes[f, 0]
    ray[1] = turn[0] * y - turn[1] * x - frames.eyes[f, 1]
    ray[2] = place[2] - frames.eyes[f, 2]
    return np.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])


@kernel
def _is_free(
    frames: Frames, f: int, rows: np.ndarray, n: int, ray: np.ndarray, bearings: np.ndarray
) -> bool:
    """Whether frame f found something known behind landmark n at `ray` (3,).

    `bearings` are those of the frame's observations.
    """
    squared = ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2
    bearing, first = np.arctan2(ray[1], ray[0]), frames.starts[f]
    for o in range(first, frames.starts[f + 1]):
        if not frames.is_known[o] or rows[o] == n:
            continue
        other = frames.rays[o]
        apart = abs((bearings[o - first] - bearing + np.pi) % (2 * np.pi) - np.pi)
        is_behind = other[0] ** 2 + other[1] ** 2 + other[2] ** 2 >= squared
        if is_behind and apart <= NEARLY_RAD:
            return True
    return False
