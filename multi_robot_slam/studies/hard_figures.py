"""What a run in a world that differs comes to, beside the run of the same team in the exact one."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from msg_defs.topics import MAP_FRAME
from msg_defs.types import WRONG, ObservationSet, Trajectory
from multi_robot_slam import runs
from multi_robot_slam.runs.associations import Origins, associations, origins
from multi_robot_slam.runs.consistency import nees, published_means
from multi_robot_slam.runs.map_errors import attributed, place_errors
from multi_robot_slam.runs.trajectory_errors import alignment, at, rmse, rotation, wrap
from multi_robot_slam.studies.hard_changes import Loaded, Told
from multi_robot_slam.studies.hard_table import Row
from multi_robot_slam.studies.hard_worlds import EXACTS, WORLDS
from sim_world.robot import START_NS

CONSISTENT = "consistent"
LATER_S = 10.0
"""So long after a difference can be noticed, poses are good again, or it has been said."""
KNOWN_LANDMARKS = 2
"""Landmarks known before that a frame must see to be one that can tell where a robot is."""
IN_COMMON = 8
"""Landmarks that two pieces must have in common to be tied soon."""
PLACED_M = 1.0
"""A robot whose place becomes known is no further from it."""
STILL_THERE_M = 0.5
"""A landmark of the map that is so near to where a true one was before it moved is an old place."""


class Outcome(NamedTuple):
    """A run, and what was told and is true."""

    told: Told
    run: runs.Run
    optimum: Mapping[str, Trajectory] | None
    """What a filter could have published (`filtering_optimum.poses`); None if nobody asked."""
    factors: np.ndarray
    """(K, 2) estimated factors of odometry and camera noise at the end."""


class Published(NamedTuple):
    """Poses of a robot as published, at steps and between."""

    stamps_ns: np.ndarray
    """(T,) int64."""
    poses: np.ndarray
    """(T, 3)."""
    covariances: np.ndarray
    """(T, 3, 3)."""
    truth: np.ndarray
    """(T, 3)."""

    @property
    def errors(self) -> np.ndarray:
        """(T, 3) x, y [m], yaw [rad]."""
        errors = self.poses - self.truth
        errors[:, 2] = wrap(errors[:, 2])
        return errors

    def since(self, stamp_ns: int) -> "Published":
        """Those from `stamp_ns` on."""
        rows = self.stamps_ns >= stamp_ns
        return Published(*(part[rows] for part in self))


Team = dict[str, Published]


def row(name: str, outcome: Outcome, exact: Outcome) -> Row:
    """The figures of a run in the world `name`; `exact` is that of its team in the exact world."""
    told, run = outcome.told, outcome.run
    own, reference = published(run), published(exact.run)
    is_tied = WORLDS[name].judged == "tied"
    known_ns = told.known_ns
    if known_ns is None:
        known_ns = all_in_common(told) if is_tied else first_meeting(told)
    if is_tied:
        reference = {robot: reference[robot].since(own[robot].stamps_ns[0]) for robot in own}
    later_ns = known_ns + int(LATER_S * 1e9)
    others = [robot for robot in told.names if robot not in told.culprits]
    figures, exact_figures = runs.evaluate(run), runs.evaluate(exact.run)
    map_m, exact_map_m = figures["map_rmse_m"], exact_figures["map_rmse_m"]
    if told.loaded is not None:
        map_m, exact_map_m = map_errors(run, told.loaded)
    later, exact_later = since(own, later_ns), since(reference, later_ns)
    noticed = said(run, told.begins_ns)
    noticed_ns = min((stamp for stamp, _, _ in noticed), default=None)
    found_ns = (known_ns if noticed_ns is None else noticed_ns) + int(LATER_S * 1e9)
    found, exact_found = since(own, found_ns), since(reference, found_ns)
    judged = {
        "published": own,
        "later": later,
        "later, aligned": aligned(later),
        "tied": own,
        "found": found,
        "found, aligned": aligned(found),
    }[WORLDS[name].judged]
    if is_tied:
        noticed_ns = all_placed(own, told)
    own_optimum, exact_optimum = (
        (None, None)
        if outcome.optimum is None
        else (_error_of(outcome.optimum, told), _error_of(exact.optimum or {}, exact.told))
    )
    factors = outcome.factors
    return Row(
        world=name,
        robots=len(told.names),
        seed=run.config.seed,
        published_m=error(own),
        exact_published_m=error(reference),
        aligned_m=error(aligned(own)),
        exact_aligned_m=error(aligned(reference)),
        later_m=error(later),
        exact_later_m=error(exact_later),
        later_aligned_m=error(aligned(later)),
        exact_later_aligned_m=error(aligned(exact_later)),
        others_m=error(own, others, told.begins_ns),
        exact_others_m=error(reference, others, told.begins_ns),
        nees=_nees(judged),
        map_m=map_m,
        exact_map_m=exact_map_m,
        landmark_nees=figures["landmark_nees"],
        duplicates=figures["duplicates"],
        exact_duplicates=exact_figures["duplicates"],
        old_places=old_places(outcome) if told.old_places else None,
        optimum_m=own_optimum,
        exact_optimum_m=exact_optimum,
        odometry_factor=float(factors[:, 0].mean()),
        camera_factor=float(factors[:, 1].mean()),
        factor_off=factor_off(factors, told.factors),
        known_s=(known_ns - START_NS) / 1e9,
        noticed_s=None if noticed_ns is None else max(0.0, (noticed_ns - known_ns) / 1e9),
        noticed_frames=None if noticed_ns is None else telling_frames(told, known_ns, noticed_ns),
        away_s=away_s(run),
        found_m=error(found),
        exact_found_m=error(exact_found),
        found_aligned_m=error(aligned(found)),
        exact_found_aligned_m=error(aligned(exact_found)),
        false_alarm=int(is_false_alarm(run, told, name)),
        said="; ".join(
            f"{robot} {level} {(stamp - START_NS) / 1e9:.1f}" for stamp, robot, level in noticed
        )
        or None,
        lost=sum(count for reason, count in run.dropped.items() if reason.startswith("lost ")),
        refused=sum(
            count for reason, count in run.dropped.items() if not reason.startswith("lost ")
        ),
    )


def published(run: runs.Run) -> Team:
    """Of each robot that published anything."""
    found = {}
    for name, robot in run.robots.items():
        stamps, poses, covariances = published_means(run, name)
        if len(stamps) and robot.truth is not None:
            found[name] = Published(stamps, poses, covariances, at(robot.truth, stamps))
    return found


def since(team: Team, stamp_ns: int) -> Team:
    """What is published from `stamp_ns` on."""
    return {name: one.since(stamp_ns) for name, one in team.items()}


def aligned(team: Team) -> Team:
    """The team turned and shifted as one, so that its places lie closest to the truth."""
    if not team:
        return team
    angle, shift = alignment(
        np.concatenate([one.poses[:, :2] for one in team.values()]),
        np.concatenate([one.truth[:, :2] for one in team.values()]),
    )
    turn = np.eye(3)
    turn[:2, :2] = rotation(angle)
    return {
        name: one._replace(
            poses=one.poses @ turn.T + np.array([*shift, angle]),
            covariances=turn @ one.covariances @ turn.T,
        )
        for name, one in team.items()
    }


def error(team: Team, names: Iterable[str] | None = None, since_ns: int = 0) -> float | None:
    """RMS of the errors of position of the robots `names` (all) from a stamp on [m]."""
    wanted = team.keys() if names is None else team.keys() & set(names)
    pooled = [np.empty((0, 3)), *(team[name].since(since_ns).errors for name in sorted(wanted))]
    return rmse(np.concatenate(pooled)[:, :2])


def first_meeting(told: Told) -> int:
    """When first a robot sees a landmark that another one has seen, one of them a culprit [ns].

    By what is sent to the fusion.
    """
    seen_by: dict[int, set[str]] = {}
    sent = {(e.robot, e.stamp_ns) for e in told.events if isinstance(e, ObservationSet)}
    frames = sorted(
        (stamp, robot) for robot, stamp in told.recorded.observation_truth if (robot, stamp) in sent
    )
    for stamp, robot in frames:
        for landmark in told.recorded.observation_truth[robot, stamp].tolist():
            others = seen_by.setdefault(landmark, set()) - {robot}
            if others & set(told.culprits) or (others and robot in told.culprits):
                return stamp
            seen_by[landmark].add(robot)
    return told.end_ns


def all_in_common(told: Told) -> int:
    """When each culprit had eight landmarks in common with robots tied by these before it [ns].

    Robots that are not culprits are together to begin with, and what is in a loaded map is theirs.
    """
    truth = told.recorded.observation_truth
    seen: dict[str, set[int]] = {name: set() for name in told.names}
    placed = set(told.names) - set(told.culprits)
    if told.loaded is not None:
        seen[MAP_FRAME] = set(told.loaded.sources.values())
        placed.add(MAP_FRAME)
    groups = {name: {name} for name in told.culprits}
    for name in placed:
        groups[name] = placed
    for stamp, robot in sorted((stamp, robot) for robot, stamp in truth):
        seen[robot] |= set(truth[robot, stamp].tolist())
        for other in seen:
            if other not in groups[robot] and _have_in_common(seen, groups[robot], groups[other]):
                together = groups[robot] | groups[other]
                groups |= dict.fromkeys(together, together)
        if len(groups[robot]) == len(seen):
            return stamp
    return told.end_ns


def _have_in_common(seen: Mapping[str, set[int]], one: set[str], other: set[str]) -> bool:
    ours, theirs = (set().union(*(seen[name] for name in group)) for group in (one, other))
    return len(ours & theirs) >= IN_COMMON


def all_placed(team: Team, told: Told) -> int | None:
    """When the last culprit was published first [ns]; None if one never was, or elsewhere."""
    culprits = [team.get(name) for name in told.culprits]
    if any(own is None or np.hypot(*own.errors[0, :2]) > PLACED_M for own in culprits):
        return None
    return int(max(own.stamps_ns[0] for own in culprits if own is not None))


def said(run: runs.Run, since_ns: int) -> list[tuple[int, str, str]]:
    """When (stamp) which level but `consistent` was first said of which robot, in this order."""
    first: dict[tuple[str, str], int] = {}
    for step in run.steps:
        for verdict in step.verdicts:
            if verdict.level != CONSISTENT and step.stamp_ns >= since_ns:
                first.setdefault((verdict.robot, verdict.level), step.stamp_ns)
    return sorted((stamp, robot, level) for (robot, level), stamp in first.items())


def away_s(run: runs.Run) -> float | None:
    """Longest time from when a robot was lost to its next published pose, or the run's end [s]."""
    since_ns: dict[str, int] = {}
    longest: list[float] = []
    for step in run.steps:
        for verdict in step.verdicts:
            if verdict.level in WRONG:
                since_ns.setdefault(verdict.robot, step.stamp_ns)
        for estimate in step.estimates:
            if estimate.robot in since_ns:
                longest.append((step.stamp_ns - since_ns.pop(estimate.robot)) / 1e9)
    longest += [(run.steps[-1].stamp_ns - stamp) / 1e9 for stamp in since_ns.values()]
    return max(longest, default=None)


def is_false_alarm(run: runs.Run, told: Told, name: str) -> bool:
    """Something was said that is not so: before the difference, or in an exact world at all."""
    first = min((stamp for stamp, _, _ in said(run, 0)), default=None)
    return first is not None and (name in EXACTS or first < told.begins_ns)


def telling_frames(told: Told, since_ns: int, until_ns: int) -> int:
    """Frames of culprits in this time that see landmarks which somebody had seen before it."""
    truth = told.recorded.observation_truth
    sent = {(e.robot, e.stamp_ns) for e in told.events}
    before = {
        landmark
        for key, rows in truth.items()
        if key in sent and key[1] <= since_ns
        for landmark in rows.tolist()
    }
    return sum(
        len(before.intersection(rows.tolist())) >= KNOWN_LANDMARKS
        for key, rows in truth.items()
        if key in sent and key[0] in told.culprits and since_ns < key[1] <= until_ns
    )


def map_errors(run: runs.Run, loaded: Loaded) -> tuple[float | None, float | None]:
    """RMS errors of the map and of that of the day before [m], of true landmarks in both."""
    assert run.true_landmarks is not None
    origin = Origins(origins(associations(run)).landmarks | loaded.sources, frozenset())
    errors = []
    for landmarks in (run.landmarks, loaded.kept.landmark_map()):
        found = attributed(landmarks, origin)
        rows = place_errors(landmarks, run.true_landmarks, found)[found.is_first]
        errors.append(dict(zip(found.sources[found.is_first].tolist(), rows, strict=True)))
    now, then = errors
    common = sorted(now.keys() & then.keys())
    return rmse(_rows(now, common)), rmse(_rows(then, common))


def _rows(errors: Mapping[int, np.ndarray], of: Iterable[int]) -> np.ndarray:
    return np.array([errors[source] for source in of]).reshape(-1, 3)


def old_places(outcome: Outcome) -> int:
    """How many landmarks that moved are still in the map where they were."""
    run, old = outcome.run, outcome.told.old_places
    found = attributed(run.landmarks, origins(associations(run)))
    places = run.landmarks.positions[found.rows].astype(float)
    return len(
        {
            source
            for place, source in zip(places, found.sources.tolist(), strict=True)
            if source in old and np.linalg.norm(place - old[source]) < STILL_THERE_M
        }
    )


def factor_off(factors: np.ndarray, true: tuple[float, float]) -> float:
    """Root mean square over the robots of how far, in shares, the factor that is not 1 is missed.

    Where both are 1, of both.
    """
    off = factors / np.array(true) - 1
    changed = np.array(true) != 1
    return float(np.sqrt(np.mean((off[:, changed] if changed.any() else off) ** 2)))


def _nees(team: Team) -> float | None:
    if not team:
        return None
    return nees(
        np.concatenate([one.errors for one in team.values()]),
        np.concatenate([one.covariances for one in team.values()]),
    )


def _error_of(paths: Mapping[str, Trajectory], told: Told) -> float | None:
    """RMS error of position of `paths` [m]."""
    errors = [
        path.poses[:, :2] - at(told.recorded.truth[name], path.stamps_ns)[:, :2]
        for name, path in paths.items()
        if len(path.stamps_ns)
    ]
    return rmse(np.concatenate(errors)) if errors else None
