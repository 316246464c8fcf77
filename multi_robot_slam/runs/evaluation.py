"""How good a run is: trajectory and map errors, association quality, each with its unit.

Errors are estimate minus truth in `map`. Unaligned ones come first: the start poses are given.
Aligned ones judge the shape alone, for runs whose truth lives in another frame. The truth is looked
up at the estimate's stamps. A figure that needs truth the run does not have is None.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from msg_defs.errors import InputError
from msg_defs.types import LandmarkMap, Trajectory
from multi_robot_slam.runs.run import RobotRun, Run
from multi_robot_slam.runs.trajectory_errors import (
    PoseErrors,
    aligned,
    alignment,
    at,
    covers,
    pose_errors,
    relative_errors,
    rmse,
    rotation,
    wrap,
)

RELATIVE_TO_M = (1, 10)
"""Distances over which the relative error is taken [m]."""


class RobotErrors(NamedTuple):
    """Errors of everything that claims to know where one robot was."""

    path: PoseErrors
    """Of the best particle's whole path at the end."""
    odometry: PoseErrors
    """Of the odometry alone, composed onto the start pose."""
    online: PoseErrors
    """Of the poses as published at each step."""
    online_mean: PoseErrors
    """Of the particles' means as published at each step."""
    mean: PoseErrors
    """Of the mean of all particles' whole paths at the end."""
    refined: PoseErrors
    """Of the path smoothed over the best particle's associations."""
    batch: PoseErrors
    """Of the yardstick: the path smoothed over the true associations."""


class Associations(NamedTuple):
    """All observations with known truth, in the order of the steps; C of them."""

    steps: np.ndarray
    """(C,) int64: index of the step in the run."""
    ids: np.ndarray
    """(C,) int64: landmark the observation updated or created."""
    is_new: np.ndarray
    """(C,) bool: it created the landmark."""
    truth: np.ndarray
    """(C,) int64: row of the observed landmark in the true map."""
    robots: np.ndarray
    """(C,) int64: index in the team of the robot that observed it."""


class Origins(NamedTuple):
    """From which true landmark each estimated one came."""

    landmarks: dict[int, int]
    """Estimated id -> row in the true map."""
    by_majority: frozenset[int]
    """Ids whose creation no step record shows, attributed by the majority of their matches."""


def odometry_in_map(robot: RobotRun) -> Trajectory:
    """Odometry composed onto the robot's start: T_map(t) = T_start T_odom(start)^-1 T_odom(t).

    The start is the path's first stamp, where the filter begins. T_start is the true pose there, or
    the configured one if the truth does not cover it.
    """
    stamps, poses = robot.odometry.stamps_ns, robot.odometry.poses
    if not len(stamps):
        return robot.odometry
    start_ns = (robot.path.stamps_ns if len(robot.path.stamps_ns) else stamps)[:1]
    start = robot.start_pose
    if robot.truth is not None and covers(robot.truth, start_ns).all():
        start = at(robot.truth, start_ns)[0]
    origin = at(robot.odometry, start_ns)[0]
    turn = start[2] - origin[2]
    places = start[:2] + (poses[:, :2] - origin[:2]) @ rotation(turn).T
    return Trajectory(stamps, np.column_stack([places, poses[:, 2] + turn]))


def robot_errors(run: Run) -> dict[str, RobotErrors]:
    """Errors of each robot whose truth is known, in the team's order."""
    return {
        name: RobotErrors(
            path=pose_errors(robot.path, robot.truth, f"path of {name}"),
            odometry=pose_errors(odometry_in_map(robot), robot.truth, f"odometry of {name}"),
            online=pose_errors(robot.online, robot.truth, f"published poses of {name}"),
            online_mean=pose_errors(robot.online_mean, robot.truth, f"published means of {name}"),
            mean=pose_errors(robot.mean, robot.truth, f"mean path of {name}"),
            refined=pose_errors(robot.refined, robot.truth, f"refined path of {name}"),
            batch=pose_errors(robot.batch, robot.truth, f"yardstick of {name}"),
        )
        for name, robot in run.robots.items()
        if robot.truth is not None
    }


def associations(run: Run) -> Associations:
    """Join the step records of the best particle with the truth of each observation."""
    rows = [np.empty((0, 5), np.int64)]
    team = list(run.robots)
    for index, step in enumerate(run.steps):
        for frame in step.frames:
            truth = run.observation_truth.get((frame.robot, step.stamp_ns))
            if truth is None:
                continue
            if len(truth) != len(frame.landmarks):
                raise InputError(
                    f"{frame.robot} at {step.stamp_ns} ns: {len(frame.landmarks)} observations "
                    f"but truth for {len(truth)}; evaluate against the truth of the same run"
                )
            steps, robots = np.full((2, len(truth)), [[index], [team.index(frame.robot)]])
            rows.append(np.column_stack([steps, frame.landmarks, frame.is_new, truth, robots]))
    steps, ids, is_new, truth, robots = np.concatenate(rows).astype(np.int64).T
    return Associations(steps, ids, is_new.astype(bool), truth, robots)


def origins(observed: Associations) -> Origins:
    """The true landmark each estimated one came from: that of the observation that created it.

    One observation creates a landmark, the same in all particles; but the step records show the
    best particle of their step, which need not be an ancestor of the final one and may have matched
    where its ancestor created. A landmark created unseen counts for the true landmark most of its
    recorded matches came from (the lowest row in a tie).
    """
    ids, truths = observed.ids[observed.is_new], observed.truth[observed.is_new]
    created = dict(zip(ids.tolist(), truths.tolist(), strict=True))
    votes: dict[int, Counter] = {}
    for landmark, truth in zip(observed.ids.tolist(), observed.truth.tolist(), strict=True):
        if landmark not in created:
            votes.setdefault(landmark, Counter())[truth] += 1
    elected = {landmark: _winner(count) for landmark, count in votes.items()}
    return Origins(created | elected, frozenset(elected))


def association_quality(
    observed: Associations, origin: Origins, among: np.ndarray | bool = True
) -> tuple[float | None, float | None]:
    """Precision and recall of the association, 0 to 1; None where there is nothing to count.

    A match is right if its landmark came (`origins`) from the true landmark the observation came
    from. Precision: the share of right ones among the matched (not new) observations. Recall: the
    share of rightly matched ones among the observations of a true landmark that any robot of the
    team had observed in an earlier step. `among` (C,) limits which observations count.
    """
    source = np.array([origin.landmarks[i] for i in observed.ids.tolist()], np.int64)
    right = ~observed.is_new & (source == observed.truth)
    _, first, row = np.unique(observed.truth, return_index=True, return_inverse=True)
    known = observed.steps[first][row] < observed.steps
    return _share(right, ~observed.is_new & among), _share(right, known & among)


def map_errors(
    landmarks: LandmarkMap, true_landmarks: LandmarkMap, origin: Origins
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (A,) of the attributed landmarks, and how far (A, 3) each is from its true place [m]."""
    ids = landmarks.ids.tolist()
    attributed = [row for row, landmark in enumerate(ids) if landmark in origin.landmarks]
    sources = [origin.landmarks[ids[row]] for row in attributed]
    errors = landmarks.positions[attributed].astype(float) - true_landmarks.positions[sources]
    return np.array(attributed, int), errors


def nees(errors: np.ndarray, covariances: np.ndarray) -> float | None:
    """Average normalised estimation error squared of (n, 3) `errors`, 3 if (n, 3, 3) are right.

    A singular covariance claims certainty, which no error can be held to: it is left out. So is
    the known start, and the spread of three particles or fewer. None if nothing is left.
    """
    regular = np.linalg.matrix_rank(covariances, hermitian=True) == errors.shape[1]
    if not regular.any():
        return None
    errors, covariances = errors[regular], covariances[regular]
    whitened = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    return float(np.mean(np.sum(errors * whitened, axis=1)))


def published_errors(run: Run) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Errors (T, 3) and covariances (T, 3, 3) of the means as published, where the truth is known.

    Of each robot; T counts the steps after which its mean was published.
    """
    found = {}
    for name, robot in run.robots.items():
        estimates = [
            estimate
            for step in run.steps
            for estimate in step.estimates
            if estimate.robot == name and estimate.mean is not None
        ]
        stamps = np.array([estimate.stamp_ns for estimate in estimates], np.int64)
        means = np.array([estimate.mean for estimate in estimates]).reshape(-1, 3)
        covariances = np.array([e.covariance for e in estimates]).reshape(-1, 3, 3)
        known = np.zeros(len(stamps), bool) if robot.truth is None else covers(robot.truth, stamps)
        errors = means[known] - at(robot.truth, stamps[known]) if known.any() else np.empty((0, 3))
        errors[:, 2] = wrap(errors[:, 2])
        found[name] = errors, covariances[known]
    return found


def evaluate(run: Run) -> dict:
    """Every figure of merit of a run, ready for `result.json`; None where there is no truth.

    Of the team and, under `robots`, of each robot, whose poses the team's figures pool:

    `path_rmse_m`, `heading_rmse_rad`: of the best particle's whole path at the end, unaligned.
    `path_aligned_rmse_m`, `heading_aligned_rmse_rad`: after each robot's path was brought closest
    to its truth; `path_team_aligned_rmse_m`, `heading_team_aligned_rmse_rad`: after all together
    were, by one rotation and shift. `rte_1m_rmse_m`, `rte_1m_rmse_rad`, `rte_10m_...`: of the
    motion over so many metres (`relative_errors`), which is the same aligned or not.
    These ten also of other paths: `odometry_...`; `online_...`, the poses as published;
    `online_mean_...`, the means as published; `mean_...`, the mean of all particles' paths;
    `refined_...`, smoothed over the best particle's associations; `batch_...`, the yardstick,
    smoothed over the true ones.
    `pose_nees`: normalised error of mean and covariance as published; 3 is consistent.
    `association_precision`, `association_recall`: see `association_quality`.

    Of the team alone:

    `map_rmse_m`: of the final map's landmarks against the true place of their origin;
    `map_aligned_rmse_m`: after the map was turned and shifted in the plane to lie closest to it;
    `landmark_nees`: normalised error, given the best particle's path; `refined_...` of the refined
    map. `landmarks`: in the map; `landmarks_seen`: true ones observed; `misses`: of these, how many
    no landmark of the map comes from; `duplicates`: landmarks of the map beyond the first of each
    true landmark; `landmarks_by_majority`, `landmarks_unattributed`: how many have an origin by
    majority, or none, and then no part in map error, duplicates and misses (see `origins`).
    `bag`: where the recording is.
    """
    team, robots = _pose_figures(run)
    observed = associations(run)
    origin = origins(observed)
    durations = [step.duration_ms for step in run.steps]
    for index, figures in enumerate(robots.values()):
        figures |= _association_figures(observed, origin, observed.robots == index)
    return {
        **team,
        **_map_figures(run, observed, origin),
        **_association_figures(observed, origin, True),
        "step_ms_mean": float(np.mean(durations)) if durations else None,
        "step_ms_p99": float(np.percentile(durations, 99)) if durations else None,
        "step_ms_max": float(np.max(durations)) if durations else None,
        "steps": len(run.steps),
        "particles": run.config.filter.particles,
        "seed": run.config.seed,
        "bag": None if run.bag is None else str(run.bag),
        "dropped": dict(run.dropped),
        "robots": robots,
    }


def _full(covariances: np.ndarray) -> np.ndarray:
    """(n, 6) `xx xy xz yy yz zz` -> (n, 3, 3) float64."""
    return covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].astype(float).reshape(-1, 3, 3)


def _winner(count: Counter) -> int:
    return min(count, key=lambda truth: (-count[truth], truth))


def _share(hits: np.ndarray, among: np.ndarray) -> float | None:
    return float(hits[among].mean()) if among.any() else None


def _pose_figures(run: Run) -> tuple[dict, dict[str, dict]]:
    """The team's figures of all paths and poses, and those of each robot."""
    errors = robot_errors(run)
    published = published_errors(run)
    team, robots = {}, {name: {} for name in run.robots}
    for kind in RobotErrors._fields:
        plain = {name: getattr(robot, kind) for name, robot in errors.items()}
        alone = {name: aligned([path])[0] for name, path in plain.items()}
        together = dict(zip(plain, aligned(list(plain.values())), strict=True))
        prefix = "" if kind == "path" else f"{kind}_"
        team |= _path_figures(prefix, errors, plain, alone, together)
        for name, figures in robots.items():
            figures |= _path_figures(prefix, errors.keys() & {name}, plain, alone, together)
    team["pose_nees"] = nees(*map(np.concatenate, zip(*published.values(), strict=True)))
    for name, figures in robots.items():
        figures["pose_nees"] = nees(*published[name])
    return team, robots


def _path_figures(
    prefix: str,
    names: Iterable[str],
    plain: Mapping[str, PoseErrors],
    alone: Mapping[str, PoseErrors],
    together: Mapping[str, PoseErrors],
) -> dict:
    """Of one kind of path of the robots `names`: unaligned, aligned one by one, or all together."""
    names = list(names)
    figures = {}
    for words, paths in (("", plain), ("aligned_", alone), ("team_aligned_", together)):
        pooled = _pooled(paths[name].errors for name in names)
        figures[f"{prefix}path_{words}rmse_m"] = rmse(pooled[:, :2])
        figures[f"{prefix}heading_{words}rmse_rad"] = rmse(pooled[:, 2])
    for distance in RELATIVE_TO_M:
        pooled = _pooled(relative_errors(plain[name], distance) for name in names)
        figures[f"{prefix}rte_{distance}m_rmse_m"] = rmse(pooled[:, :2])
        figures[f"{prefix}rte_{distance}m_rmse_rad"] = rmse(pooled[:, 2])
    return figures


def _pooled(errors: Iterable[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.empty((0, 3)), *errors])


def _association_figures(observed: Associations, origin: Origins, among: np.ndarray | bool) -> dict:
    precision, recall = association_quality(observed, origin, among)
    return {"association_precision": precision, "association_recall": recall}


def _map_figures(run: Run, observed: Associations, origin: Origins) -> dict:
    in_map = run.landmarks.ids.tolist()
    sources = [origin.landmarks[i] for i in in_map if i in origin.landmarks]
    has_truth = bool(len(observed.ids))
    seen = len(np.unique(observed.truth))
    figures = {
        "landmarks_seen": seen,
        "misses": seen - len(set(sources)),
        "duplicates": len(sources) - len(set(sources)),
        "landmarks_by_majority": sum(i in origin.by_majority for i in in_map),
        "landmarks_unattributed": len(in_map) - len(sources),
    }
    return {
        **_place_figures("", run.landmarks, run, origin),
        **_place_figures("refined_", run.refined_landmarks, run, origin),
        "landmarks": len(in_map),
        **{name: value if has_truth else None for name, value in figures.items()},
    }


def _place_figures(prefix: str, landmarks: LandmarkMap | None, run: Run, origin: Origins) -> dict:
    names = (f"{prefix}map_rmse_m", f"{prefix}map_aligned_rmse_m", f"{prefix}landmark_nees")
    if landmarks is None or run.true_landmarks is None:
        return dict.fromkeys(names)
    rows, errors = map_errors(landmarks, run.true_landmarks, origin)
    places = landmarks.positions[rows].astype(float)
    truth = places - errors
    angle, shift = alignment(places[:, :2], truth[:, :2])
    moved = np.column_stack([places[:, :2] @ rotation(angle).T + shift, places[:, 2]])
    consistency = nees(errors, _full(landmarks.covariances[rows]))
    return dict(zip(names, (rmse(errors), rmse(moved - truth), consistency), strict=True))
