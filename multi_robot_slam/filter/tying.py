"""Two pieces become one: where their landmarks agree on a pose, the second is turned.

In every particle it is turned by a pose drawn from what the vote says; paths, which particles
share, by its mean. In smoothing the pose counts as unknown, with `VAGUER` times the vote's
covariance: the same landmarks say it again, there with all that ties them, and the whole past of
the piece follows.
"""

from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from multi_robot_slam.filter import resampling, vote
from multi_robot_slam.filter.kernels import FAR
from multi_robot_slam.filter.pieces import MAP, Pieces
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.filter.settled import Settled
from multi_robot_slam.filter.state import Optimum, State, best_particle
from multi_robot_slam.filter.vote import Points, Vote
from multi_robot_slam.models.frames import Start
from multi_robot_slam.models.motion import composed, move
from multi_robot_slam.models.symmetric import pack, root, unpack
from multi_robot_slam.smoothing.prior import Prior

AGREEING = 3
"""Votes in a row that must say the same: a step may mislead for a moment, and be put right by the
next ones. Of the same landmarks they are no more evidence than one."""

VAGUER = 1000.0
"""What the pairs say twice then counts for a thousandth more than once."""

EIGHT = 8
"""Landmarks that both pieces have, from which on the time to the tie is told."""


class Tie(NamedTuple):
    """Two pieces that have become one."""

    robots: tuple[int, ...]
    """Of the piece that was turned."""
    into: int
    """The piece that they belong to now."""
    vote: Vote
    seconds: float
    """Since both had eight landmarks, or all, of those that agree, as far as is remembered [s]."""

    @property
    def is_in_map(self) -> bool:
        """The robots' place in `map` is known from now on."""
        return self.into == MAP


def tie(state: State, settings: FilterSettings, rng: np.random.Generator) -> Tie | None:
    """Vote on the two pieces whose turn it is; if they agree for long enough, make them one.

    `state` is changed in place.
    """
    if not state.pieces.are_many:
        return None
    pairs = list(combinations(state.pieces.numbers, 2))
    first, second = pairs[state.steps % len(pairs)]
    found, ids = _voted(state, first, second, settings)
    state.pieces = state.pieces.with_vote(first, second, found)
    state.pieces, agreed = _noted(state.pieces, first, second, found)
    return join(state, first, second, found, ids, settings, rng) if agreed and found else None


def join(
    state: State,
    first: int,
    second: int,
    found: Vote,
    ids: np.ndarray,
    settings: FilterSettings,
    rng: np.random.Generator,
) -> Tie:
    """Make two pieces one as a vote says, by which landmarks `ids` (n, 2) are the same."""
    robots = np.flatnonzero(state.pieces.of_robots == second)
    seconds = _seconds_since(state, ids)
    turn(state, second, found, rng)
    of_robots = np.where(state.pieces.of_robots == second, first, state.pieces.of_robots)
    kept, last = (
        tuple(own for own in votes if second not in own[:2])
        for votes in (state.pieces.votes, state.pieces.last)
    )
    pairs = np.vstack([state.pieces.pairs, np.sort(ids, axis=1)])
    state.pieces = Pieces(of_robots, state.pieces.team, kept, pairs, last)
    _join_landmarks(state, first, second, settings)
    return Tie(tuple(robots.tolist()), first, found, seconds)


def _join_landmarks(state: State, first: int, second: int, settings: FilterSettings) -> None:
    """Landmarks of piece `second` are those of `first` from now on.

    Where `map` must not change they are forgotten: they were there to vote.
    """
    landmarks = state.landmarks
    if first == MAP and not settings.mapping:
        alive = landmarks.alive()
        landmarks.forget(landmarks.ids[alive[landmarks.pieces[alive] == second]])
        state.pieces = state.pieces.when_joined()
    landmarks.pieces[landmarks.pieces == second] = first
    landmarks.bound(landmarks.alive(), settings.gate)


def _voted(
    state: State, first: int, second: int, settings: FilterSettings
) -> tuple[Vote | None, np.ndarray]:
    """What the landmarks of two pieces say, and the ids (n, 2) of those that agree."""
    landmarks = state.landmarks
    held, _ = landmarks.of_particle(best_particle(state))
    ours, theirs = (held[landmarks.pieces[held] == piece] for piece in (first, second))
    return vote_of(state, ours, theirs, settings)


def vote_of(
    state: State,
    ours: np.ndarray,
    theirs: np.ndarray,
    settings: FilterSettings,
    thing_m: float = vote.THING_M,
) -> tuple[Vote | None, np.ndarray]:
    """What the landmarks in the columns `ours` (n,) and `theirs` (m,), of two pieces, say.

    And the ids (k, 2) of those that agree; `thing_m` as of `vote.vote`.
    """
    landmarks, nothing = state.landmarks, np.empty((0, 2), np.int64)
    looks = landmarks.descriptors[ours], landmarks.descriptors[theirs]
    alike = vote.pairs_alike(*looks, settings.descriptor_gate)[: vote.MOST_PAIRS]
    if len(alike) < 2:
        return None, nothing
    columns, rows = [], []
    for own, paired in zip((ours, theirs), alike.T, strict=True):
        used = np.union1d(paired, vote.spread(len(own)))
        columns.append(own[used])
        rows.append(np.searchsorted(used, paired))
    weights = resampling.normalise(state.log_weights)
    points = [Points(*np.split(landmarks.mixture(own, weights), [3], axis=1)) for own in columns]
    found = vote.vote(points[0], points[1], np.column_stack(rows), thing_m)
    if found is None:
        return None, nothing
    a, b = found.pairs.T
    return found, np.column_stack([landmarks.ids[columns[0][a]], landmarks.ids[columns[1][b]]])


def _noted(pieces: Pieces, first: int, second: int, found: Vote | None) -> tuple[Pieces, bool]:
    """The votes in a row with this one, and whether they are enough."""
    others = tuple(own for own in pieces.votes if own[:2] != (first, second))
    if found is None or not found.is_believed:
        return pieces._replace(votes=others), False
    row = [own for own in pieces.votes if own[:2] == (first, second)]
    row = [own for own in row if _say_the_same(own[2], found)]
    row = [*row, (first, second, found)]
    return pieces._replace(votes=(*others, *row)), len(row) >= AGREEING


def _say_the_same(one: Vote, other: Vote) -> bool:
    """They differ by less than a thing's width where the second's pairs are, and beside that."""
    middle = np.array([[0.0, vote.THING_M], [0.0, 0.0], [0.0, 0.0]])
    middle[:2] += other.middle[:, None]
    x, y, _ = composed_of(one.pose[:, None], middle) - composed_of(other.pose[:, None], middle)
    return bool(np.hypot(x, y).max() < vote.THING_M)


def _seconds_since(state: State, ids: np.ndarray) -> float:
    """Since the eighth of the pairs `ids` (n, 2) was complete; or the last."""
    records = state.history.records
    stamps = np.array([record.stamp_ns for record in records for _ in record.new_ids], np.int64)
    new_ids = np.concatenate([np.empty(0, int), *(record.new_ids for record in records)])
    order = np.argsort(new_ids)
    both = np.sort(ids.max(axis=1))[:EIGHT][-1]
    row = np.searchsorted(new_ids[order], both).clip(max=len(order) - 1)
    return float(records[-1].stamp_ns - stamps[order[row]]) / 1e9


def turn(state: State, piece: int, found: Vote, rng: np.random.Generator) -> None:
    """Turn all of `piece` by the pose that was found."""
    drawn = found.pose[:, None] + root(found.covariance) @ rng.standard_normal(
        (3, len(state.log_weights))
    )
    is_own = state.pieces.of_robots == piece
    for robot in np.flatnonzero(is_own):
        state.poses[robot] = composed_of(drawn, state.poses[robot])
    turn_landmarks(state, piece, drawn)
    known = found.pose[:, None]
    state.optimum = _turned_optimum(state, is_own, known)
    for record in state.history.records:
        if is_own[record.robot]:
            record.poses = composed_of(known, record.poses)
            if record.start is not None:
                record.start = _turned_start(record.start, found)
    state.history.settled = _turned_settled(state.history.settled, is_own, found)
    state.prior = _turned_prior(state, piece, found)
    anchors = state.existence.anchors.copy()
    has_been = is_own & (anchors[:, 0] < FAR / 2)
    anchors[has_been] = composed_of(known, anchors[has_been].T).T
    state.existence = replace(state.existence, anchors=anchors)


def turn_landmarks(state: State, piece: int, drawn: np.ndarray) -> None:
    """Means and covariances of the landmarks of a piece, by the poses (3, M)."""
    landmarks = state.landmarks
    columns = landmarks.alive()
    columns = columns[landmarks.pieces[columns] == piece]
    landmarks.bring_up_to_date(columns)
    for column in columns:
        planes = landmarks.planes[column]
        is_held = planes[0] < FAR / 2
        planes[:, is_held] = turned(planes[:, is_held], drawn[:, is_held])


def turned(planes: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Means and covariances (9, n) of landmarks in a frame that lies at `poses` (3, n)."""
    x, y, z, xx, xy, xz, yy, yz, zz = planes.astype(float)
    cos, sin = np.cos(poses[2]), np.sin(poses[2])
    mixed = cos * sin * (xx - yy)
    return np.stack(
        [
            poses[0] + cos * x - sin * y,
            poses[1] + sin * x + cos * y,
            z,
            cos**2 * xx - 2 * cos * sin * xy + sin**2 * yy,
            mixed + (cos**2 - sin**2) * xy,
            cos * xz - sin * yz,
            sin**2 * xx + 2 * cos * sin * xy + cos**2 * yy,
            sin * xz + cos * yz,
            zz,
        ]
    )


def _turned_optimum(state: State, is_own: np.ndarray, pose: np.ndarray) -> Optimum | None:
    if state.optimum is None:
        return None
    poses = state.optimum.poses.copy()
    robots = np.array([r.robot for r in state.history.records[: len(poses)]], int)
    own = is_own[robots]
    poses[own] = composed_of(pose, poses[own].T).T
    return Optimum(poses, None)


def _turned_start(start: Start, found: Vote) -> Start:
    """The start, which where it lies tells nothing of any more."""
    return Start(*composed(found.pose, VAGUER * found.covariance, start.mean, start.covariance))


def _turned_settled(settled: Settled, is_own: np.ndarray, found: Vote) -> Settled:
    pose = found.pose[:, None]
    parts = []
    for robots, stamps, poses in settled.parts:
        own, moved = is_own[robots], poses.copy()
        moved[own] = composed_of(pose, poses[own].T).T
        parts.append((robots, stamps, moved))
    frames = []
    for frame in settled.frames:
        if is_own[frame.robot]:
            frame = frame.with_rows(composed_of(pose, frame.poses), frame.matches, frame.parents)
            if frame.start is not None:
                frame.start = _turned_start(frame.start, found)
        frames.append(frame)
    return Settled(settled.keeps_frames, tuple(parts), settled.seen, tuple(frames))


def _turned_prior(state: State, piece: int, found: Vote) -> Prior:
    """The prior with the piece where the vote says, next to unknown, as a whole."""
    landmarks = state.landmarks
    alive = landmarks.alive()
    gone = np.setdiff1d(state.prior.ids, landmarks.ids[alive])
    prior = state.prior.forget(gone) if len(gone) else state.prior
    is_own = np.isin(prior.ids, landmarks.ids[alive[landmarks.pieces[alive] == piece]])
    robots, centres = np.flatnonzero(state.pieces.of_robots == piece), np.flatnonzero(is_own)
    poses, places = prior.poses.copy(), prior.centres.copy()
    poses[robots] = composed_of(found.pose[:, None], poses[robots].T).T
    turn = _turn_of(found.pose)
    places[centres] = places[centres] @ turn.T + [*found.pose[:2], 0]
    information = prior.information.copy()
    information[centres] = pack(turn @ unpack(information[centres]) @ turn.T)
    whole, by_pose = np.eye(len(prior.covariance)), np.zeros((len(prior.covariance), 3))
    for robot in robots:
        rows = 3 * robot + np.arange(3)
        whole[np.ix_(rows, rows)] = turn
        by_pose[rows] = _by_pose(poses[robot], found.pose)
    for centre in centres:
        rows = poses.size + 2 * centre + np.arange(2)
        whole[np.ix_(rows, rows)] = turn[:2, :2]
        by_pose[rows] = _by_pose(places[centre], found.pose)[:2]
    covariance = whole @ prior.covariance @ whole.T
    covariance += by_pose @ (VAGUER * found.covariance) @ by_pose.T
    return Prior(poses, prior.ids, places, information, covariance)


def _by_pose(moved: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(3, 3): derivative of what was moved to (3,), by the pose that moved it."""
    x, y = moved[:2] - pose[:2]
    return np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])


def _turn_of(pose: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def composed_of(poses: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Poses (3, n) of what is `seen` (3, n) from `poses` (3, n or 1)."""
    seen = seen if seen.ndim == 2 else seen[:, None]
    result = np.repeat(poses, seen.shape[1], axis=1) if poses.shape[1] == 1 else poses.copy()
    move(result, seen)
    return result
