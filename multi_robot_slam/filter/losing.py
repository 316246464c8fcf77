"""A robot is lost: from where its odometry misled it on it is another one, in a piece of its own.

It was carried away, or its wheels slipped, or it never started where it was told. What it has seen
since is right by itself, and wrong in `map`. So the frames since are taken out of the old piece,
with the landmarks that nobody else has seen, and go on in a frame of their own, in which they lie
as before. What they matched of older landmarks was by chance, and is forgotten. A tie (`tying`)
brings the new piece to where it belongs: at once where wheels slipped, and the robot still sees
what it saw a moment before.
"""

from typing import NamedTuple

import numpy as np

from multi_robot_slam.filter import resampling, tying
from multi_robot_slam.filter.pieces import MAP
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.filter.settled import MOST_ROBOTS
from multi_robot_slam.filter.state import Optimum, State, best_particle
from multi_robot_slam.filter.tying import Tie
from multi_robot_slam.models.frames import NOBODY, BodySightings, Record, Start
from multi_robot_slam.models.motion import NO_EXTRA
from multi_robot_slam.smoothing.prior import Prior

SOON_S = 3.0
"""In so short a time nobody is carried from one thing to a copy of it: what looks alike is one,
each point by itself. So points are counted, and not things."""

FALSE_RATE = 1e-4
"""Largest (Q1) at which that is believed. It is asked once a loss, and not with every step."""

POINT_M = 0.2
"""Points that are nearer together count as one: an edge or a corner may be found twice."""


class Misled(NamedTuple):
    """What of a robot's way its odometry did not tell."""

    first_ns: int
    """Stamp of the first frame that was elsewhere."""
    since_ns: int
    """Of the first one since which the odometry is right again; those between are of no use."""


class Lost(NamedTuple):
    """A robot that went on as another one."""

    robot: int
    another: int
    """The same where it was lost from its start on."""
    first_id: int
    """Landmarks that it has made since have ids from here on."""
    tie: Tie | None
    """By which it was found at once."""


def lose(
    state: State,
    robot: int,
    misled: Misled | None,
    settings: FilterSettings,
    rng: np.random.Generator,
) -> Lost | None:
    """Take `robot` out of its piece, from where its odometry misled it on: `state` is changed.

    `misled` None: no frame ever was where it seemed. None is returned where there is no room for
    another robot.
    """
    if misled is None:
        _never_known(state, robot)
        return Lost(robot, robot, 0, None)
    if len(state.poses) == MOST_ROBOTS:
        return None
    own = [record for record in state.history.records if record.robot == robot]
    since = [record for record in own if record.stamp_ns >= misled.since_ns] or own[-1:]
    _forget(state, robot, [r for r in own[: -len(since)] if r.stamp_ns >= misled.first_ns])
    another = len(state.poses)
    start = _go_on_as(state, robot, another, since)
    _apart(state, another, since, are_all=False)
    _begin_alike(state, another, since, start.mean)
    tie = _slipped(state, another, misled.first_ns, settings, rng)
    return Lost(robot, another, _first_id(since[0], state.landmarks.next_id), tie)


def _forget(state: State, robot: int, frames: list[Record]) -> None:
    """Forget what `robot` saw in these frames, who saw it, and landmarks that nobody else saw."""
    ids = _seen_by_them_alone(state, frames, np.empty(0, np.int64))
    steps = {frame.step for frame in frames}
    for record in state.history.records:
        if record.step in steps:
            record.sightings = _without(record.sightings, robot)
    for frame in frames:
        frame.sightings = NOBODY
        _leave(frame, np.zeros(len(frame.positions), bool))
    state.landmarks.forget(ids)


def _without(seen: BodySightings, robot: int) -> BodySightings:
    return BodySightings(*(values[seen.others != robot] for values in seen))


def _slipped(
    state: State, another: int, first_ns: int, settings: FilterSettings, rng: np.random.Generator
) -> Tie | None:
    """Tie the robot at once to what it has seen, more than once, a moment before `first_ns`."""
    landmarks, pieces = state.landmarks, state.pieces
    seen = [
        np.unique(record.matches)
        for record in state.history.records
        if pieces.team[record.robot] == pieces.team[another]
        and first_ns - SOON_S * 1e9 <= record.stamp_ns < first_ns
    ]
    ids, counts = np.unique(np.concatenate([np.empty(0, int), *seen]), return_counts=True)
    held, _ = landmarks.of_particle(best_particle(state))
    own = int(pieces.of_robots[another])
    theirs = held[landmarks.pieces[held] == own]
    ours = held[np.isin(landmarks.ids[held], ids[counts > 1])]
    for piece in np.unique(landmarks.pieces[ours]).tolist():
        of_piece = ours[landmarks.pieces[ours] == piece]
        found, pairs = tying.vote_of(state, of_piece, theirs, settings, POINT_M)
        if found is not None and found.chance <= FALSE_RATE:
            return tying.join(state, piece, own, found, pairs, settings, rng)
    return None


def _never_known(state: State, robot: int) -> None:
    """All that the robot has done is in a frame of its own, where it starts as it was told."""
    frames = [record for record in state.history.records if record.robot == robot]
    _apart(state, robot, frames, are_all=True)
    for frame in frames:
        if frame.start is not None:
            frame.start = frame.start._replace(covariance=np.zeros((3, 3)))
            state.prior = state.prior.starting(robot, frame.start)


def _first_id(record: Record, following: int) -> int:
    """That of the first landmark that this frame or a later one may have created."""
    return int(record.new_ids[0]) if len(record.new_ids) else following


def _go_on_as(state: State, robot: int, another: int, frames: list[Record]) -> Start:
    """Make `frames`, the last ones of `robot`, those of a robot that starts with the first.

    Where it starts: at the mean pose of all particles, which is certain.
    """
    first = frames[0]
    state.poses = np.concatenate([state.poses, state.poses[robot : robot + 1]])
    state.pieces = state.pieces.with_another(robot)
    start = Start(_mean_of(state, first), np.zeros((3, 3)))
    for record in state.history.records:
        if record.step >= first.step:
            record.sightings = _renamed(record.sightings, robot, another)
    for frame in frames:
        frame.robot = another
    first.motion, first.seconds, first.extra, first.start = np.zeros(3), 0.0, NO_EXTRA, start
    state.scales = state.scales.with_another(robot)
    state.bias = state.bias.with_another(robot)
    state.noise = state.noise.with_another(robot)
    state.prior = state.prior.with_another(start)
    state.existence = state.existence.with_another(robot)
    return start


def _mean_of(state: State, frame: Record) -> np.ndarray:
    """The mean pose (3,) of all particles at a frame."""
    weights = np.bincount(
        _rows_of(state, frame), resampling.normalise(state.log_weights), len(frame.parents)
    )
    return frame.poses @ weights


def _rows_of(state: State, frame: Record) -> np.ndarray:
    """(M,): the row of each particle in the record."""
    return next(rows for record, rows in state.history.lineage(slice(None)) if record is frame)


def _renamed(seen: BodySightings, robot: int, another: int) -> BodySightings:
    return seen._replace(others=np.where(seen.others == robot, another, seen.others))


def _apart(state: State, robot: int, frames: list[Record], are_all: bool) -> None:
    """Put `robot`, which `frames` are of, and what it alone has seen into a piece of its own.

    `are_all`: those of its frames that have settled are also meant.
    """
    landmarks, of_robots = state.landmarks, state.pieces.of_robots.copy()
    piece = 1 + max(of_robots.max(), landmarks.pieces[landmarks.alive()].max(initial=MAP))
    of_robots[robot] = piece
    state.pieces = state.pieces._replace(of_robots=of_robots)
    seen = state.history.settled.seen
    settled = seen.ids[seen.robots == 1 << robot] if are_all else seen.ids[:0]
    ids = _seen_by_them_alone(state, frames, settled)
    for frame in frames:
        _leave(frame, np.asarray(np.isin(frame.matches, ids).all(axis=1)))
    landmarks.pieces[np.isin(landmarks.ids, ids)] = piece
    state.prior = _untied(state, robot, ids)
    if state.optimum is not None:
        state.optimum = Optimum(state.optimum.poses, None)


def _begin_alike(state: State, another: int, frames: list[Record], mean: np.ndarray) -> None:
    """Shift and turn the piece in each particle so that in all it begins at `mean` (3,)."""
    first = frames[0]
    turns = tying.composed_of(mean[:, None], _inverses(first.poses))
    rows = _rows_of(state, first)
    own, ancestors = {id(frame) for frame in frames}, np.arange(len(first.parents))
    records = state.history.records
    for record in records[next(i for i, r in enumerate(records) if r is first) :]:
        ancestors = ancestors if record is first else ancestors[record.parents]
        if id(record) in own:
            record.poses = tying.composed_of(turns[:, ancestors], record.poses)
    state.poses[another] = tying.composed_of(turns[:, rows], state.poses[another])
    tying.turn_landmarks(state, int(state.pieces.of_robots[another]), turns[:, rows])


def _inverses(poses: np.ndarray) -> np.ndarray:
    """(3, n): the origin seen from each of the `poses` (3, n)."""
    x, y, yaw = poses
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.stack([-cos * x - sin * y, sin * x - cos * y, -yaw])


def _seen_by_them_alone(state: State, frames: list[Record], settled: np.ndarray) -> np.ndarray:
    """Ids of landmarks that only these frames have seen, and frames that saw those `settled`."""
    are_meant = {id(frame) for frame in frames}
    seen: tuple[list[np.ndarray], list[np.ndarray]] = ([], [settled])
    for record in state.history.records:
        seen[id(record) in are_meant].append(np.unique(record.matches))
    others = np.setdiff1d(state.history.settled.seen.ids, settled)
    return np.setdiff1d(np.concatenate(seen[1]), np.concatenate([others, *seen[0]]))


def _leave(frame: Record, kept: np.ndarray) -> None:
    """Of the frame's observations those that are `kept` (B,)."""
    if kept.all():
        return
    frame.positions, frame.covariances = frame.positions[kept], frame.covariances[kept]
    frame.matches, frame.new_ids = frame.matches[kept], frame.new_ids[kept]
    if frame.ranging is not None:
        frame.ranging = frame.ranging.only(kept)


def _untied(state: State, robot: int, ids: np.ndarray) -> Prior:
    """The prior in which `robot` and landmarks `ids` have nothing to do with the others."""
    prior = state.prior
    centres = np.flatnonzero(np.isin(prior.ids, ids))
    is_own = np.zeros(len(prior.covariance), bool)
    is_own[prior.rows(np.array([robot]), centres)] = True
    covariance = np.where(is_own[:, None] == is_own, prior.covariance, 0.0)
    return prior._replace(covariance=covariance)
