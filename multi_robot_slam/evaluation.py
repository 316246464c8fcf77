"""How good a run is: trajectory and map errors, association quality, each with its unit.

Errors are estimate minus truth in `map`, unaligned: the start poses are given, so nothing is left
to align. The truth is looked up at the estimate's stamps. A figure that needs truth the run does
not have is None.
"""

from collections import Counter
from typing import NamedTuple

import numpy as np
from rich.table import Table
from rich.text import Text

from msg_defs.errors import InputError
from msg_defs.types import LandmarkMap, Trajectory
from multi_robot_slam.runs import RobotRun, Run

MIN_OVERLAP = 0.5
"""Share of an estimate's poses that must lie within the time span of the truth."""


COLUMNS = {
    "odometry_path_rmse_m": "path [m]\nodometry",
    "path_rmse_m": "path [m]\nestimate",
    "mean_path_rmse_m": "path [m]\nmean",
    "refined_path_rmse_m": "path [m]\nrefined",
    "batch_path_rmse_m": "path [m]\nyardstick",
    "odometry_heading_rmse_rad": "heading [rad]\nodometry",
    "heading_rmse_rad": "heading [rad]\nestimate",
    "map_rmse_m": "map [m]\nestimate",
    "refined_map_rmse_m": "map [m]\nrefined",
}
"""Figures in the table, and the heads of their columns."""

ALWAYS_SHOWN = {
    "odometry_path_rmse_m",
    "path_rmse_m",
    "odometry_heading_rmse_rad",
    "heading_rmse_rad",
    "map_rmse_m",
}
"""The others are shown where the run has them."""


class PoseErrors(NamedTuple):
    """Error of one trajectory over time."""

    stamps_ns: np.ndarray
    """(T,) int64."""
    errors: np.ndarray
    """(T, 3) float64: x [m], y [m], yaw [rad] in [-pi, pi), estimate minus truth, `map` frame."""


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


class Origins(NamedTuple):
    """From which true landmark each estimated one came."""

    landmarks: dict[int, int]
    """Estimated id -> row in the true map."""
    by_majority: frozenset[int]
    """Ids whose creation no step record shows, attributed by the majority of their matches."""


def wrap(angle: np.ndarray) -> np.ndarray:
    """The same angle [rad] in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


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
    if robot.truth is not None and _covers(robot.truth, start_ns).all():
        start = _at(robot.truth, start_ns)[0]
    origin = _at(robot.odometry, start_ns)[0]
    turn = start[2] - origin[2]
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    places = start[:2] + (poses[:, :2] - origin[:2]) @ rotation.T
    return Trajectory(stamps, np.column_stack([places, poses[:, 2] + turn]))


def pose_errors(estimate: Trajectory, truth: Trajectory, name: str = "estimate") -> PoseErrors:
    """`estimate` minus `truth`, interpolated linearly at the estimate's stamps.

    Poses outside the truth's time span are left out; `InputError` if these are too many.
    """
    if not len(estimate.stamps_ns):
        return PoseErrors(estimate.stamps_ns, np.empty((0, 3)))
    inside = _covers(truth, estimate.stamps_ns)
    if inside.sum() < MIN_OVERLAP * len(inside):
        raise InputError(
            f"{name}: the ground truth covers {inside.sum()} of {len(inside)} poses; "
            "record it from the start to the end of the run, with the same clock"
        )
    stamps = estimate.stamps_ns[inside]
    difference = estimate.poses[inside] - _at(truth, stamps)
    difference[:, 2] = wrap(difference[:, 2])
    return PoseErrors(stamps, difference)


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
    rows = [np.empty((0, 4), np.int64)]
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
            steps = np.full(len(truth), index)
            rows.append(np.column_stack([steps, frame.landmarks, frame.is_new, truth]))
    steps, ids, is_new, truth = np.concatenate(rows).astype(np.int64).T
    return Associations(steps, ids, is_new.astype(bool), truth)


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
    observed: Associations, origin: Origins
) -> tuple[float | None, float | None]:
    """Precision and recall of the association, 0 to 1; None where there is nothing to count.

    A match is right if its landmark came (`origins`) from the true landmark the observation came
    from. Precision: the share of right ones among the matched (not new) observations. Recall: the
    share of rightly matched ones among the observations of a true landmark that any robot of the
    team had observed in an earlier step.
    """
    source = np.array([origin.landmarks[i] for i in observed.ids.tolist()], np.int64)
    right = ~observed.is_new & (source == observed.truth)
    _, first, row = np.unique(observed.truth, return_index=True, return_inverse=True)
    known = observed.steps[first][row] < observed.steps
    return _share(right, ~observed.is_new), _share(right, known)


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


def pose_nees(run: Run) -> float | None:
    """NEES of the particles' mean and covariance at each step, all robots pooled."""
    errors, covariances = [np.empty((0, 3))], [np.empty((0, 3, 3))]
    for step in run.steps:
        for estimate in step.estimates:
            truth, stamps = run.robots[estimate.robot].truth, np.array([estimate.stamp_ns])
            if truth is None or estimate.mean is None or not _covers(truth, stamps)[0]:
                continue
            error = estimate.mean - _at(truth, stamps)
            error[:, 2] = wrap(error[:, 2])
            errors.append(error)
            covariances.append(estimate.covariance[None])
    return nees(np.concatenate(errors), np.concatenate(covariances))


def rmse(errors: np.ndarray) -> float | None:
    """Root of the mean squared row norm of (T,) or (T, n) `errors`, in their unit."""
    if not len(errors):
        return None
    return float(np.sqrt(np.mean(np.sum(errors.reshape(len(errors), -1) ** 2, axis=1))))


def evaluate(run: Run) -> dict:
    """Every figure of merit of a run, ready for `result.json`.

    `path_rmse_m`, `heading_rmse_rad`: of the best particle's whole path at the end, over all poses
    of all robots pooled; `odometry_...` of the odometry, `online_...` of the poses as published,
    `online_mean_...` of the means as published, `mean_...` of the mean of all particles' paths,
    `refined_...` of the path smoothed over the best particle's associations, `batch_...` of the
    yardstick, the path smoothed over the true ones.
    `pose_nees`: normalised error of mean and covariance as published; 3 is consistent.
    `map_rmse_m`: of the final map's landmarks against the true place of their origin; `refined_...`
    after smoothing; `landmark_nees`: their normalised error, given the best particle's path.
    `duplicates`: landmarks of the final map beyond the first of each true landmark.
    `landmarks_by_majority`, `landmarks_unattributed`: how many of the final map's landmarks have an
    origin by majority, or none, and then no part in map error and duplicates (see `origins`).
    """
    errors = robot_errors(run)
    durations = [step.duration_ms for step in run.steps]
    return {
        **_pose_figures(list(errors.values())),
        "pose_nees": pose_nees(run),
        **_map_figures(run),
        "step_ms_mean": float(np.mean(durations)) if durations else None,
        "step_ms_p99": float(np.percentile(durations, 99)) if durations else None,
        "steps": len(run.steps),
        "particles": run.config.filter.particles,
        "seed": run.config.seed,
        "dropped": dict(run.dropped),
        "robots": {
            name: _pose_figures([errors[name]] if name in errors else []) for name in run.robots
        },
    }


def table(result: dict) -> Table:
    """The errors in `result` (from `evaluate`), a row per robot and one for the team."""
    columns = [
        (key, title)
        for key, title in COLUMNS.items()
        if key in ALWAYS_SHOWN or result[key] is not None
    ]
    shown = Table(title="RMS error", title_justify="left")
    shown.add_column("")
    for _, title in columns:
        shown.add_column(Text(title), justify="right")
    for name, figures in result["robots"].items():
        shown.add_row(name, *(_cell(figures, key) for key, _ in columns))
    shown.add_section()
    shown.add_row("team", *(_cell(result, key) for key, _ in columns), style="bold")
    return shown


def _covers(truth: Trajectory, stamps_ns: np.ndarray) -> np.ndarray:
    """(T,) bool: `stamps_ns` lies within the time span of the truth."""
    if not len(truth.stamps_ns):
        return np.zeros(len(stamps_ns), bool)
    return (stamps_ns >= truth.stamps_ns[0]) & (stamps_ns <= truth.stamps_ns[-1])


def _at(path: Trajectory, stamps_ns: np.ndarray) -> np.ndarray:
    """Poses (T, 3) of a `path` of one or more poses at `stamps_ns` (T,), held at its ends."""
    since = path.stamps_ns[0]  # absolute nanoseconds do not fit a float64
    times, known = stamps_ns - since, path.stamps_ns - since
    x, y, yaw = path.poses.T
    return np.column_stack([np.interp(times, known, f) for f in (x, y, np.unwrap(yaw))])


def _full(covariances: np.ndarray) -> np.ndarray:
    """(n, 6) `xx xy xz yy yz zz` -> (n, 3, 3) float64."""
    return covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].astype(float).reshape(-1, 3, 3)


def _winner(count: Counter) -> int:
    return min(count, key=lambda truth: (-count[truth], truth))


def _share(hits: np.ndarray, among: np.ndarray) -> float | None:
    return float(hits[among].mean()) if among.any() else None


def _pose_figures(errors: list[RobotErrors]) -> dict:
    def pooled(name: str) -> np.ndarray:
        return np.concatenate([np.empty((0, 3)), *(getattr(e, name).errors for e in errors)])

    path, odometry = pooled("path"), pooled("odometry")
    others = ("online", "online_mean", "mean", "refined", "batch")
    return {
        "path_rmse_m": rmse(path[:, :2]),
        "heading_rmse_rad": rmse(path[:, 2]),
        "odometry_path_rmse_m": rmse(odometry[:, :2]),
        "odometry_heading_rmse_rad": rmse(odometry[:, 2]),
        **{f"{name}_path_rmse_m": rmse(pooled(name)[:, :2]) for name in others},
    }


def _map_figures(run: Run) -> dict:
    observed = associations(run)
    origin = origins(observed)
    precision, recall = association_quality(observed, origin)
    in_map = run.landmarks.ids.tolist()
    sources = [origin.landmarks[i] for i in in_map if i in origin.landmarks]
    has_truth = bool(len(observed.ids))
    figures = {
        "landmarks_seen": len(np.unique(observed.truth)),
        "duplicates": len(sources) - len(set(sources)),
        "landmarks_by_majority": sum(i in origin.by_majority for i in in_map),
        "landmarks_unattributed": len(in_map) - len(sources),
    }
    return {
        **_place_figures(run, origin),
        "landmarks": len(in_map),
        **{name: value if has_truth else None for name, value in figures.items()},
        "association_precision": precision,
        "association_recall": recall,
    }


def _place_figures(run: Run, origin: Origins) -> dict:
    if run.true_landmarks is None:
        return dict.fromkeys(("map_rmse_m", "refined_map_rmse_m", "landmark_nees"))
    rows, errors = map_errors(run.landmarks, run.true_landmarks, origin)
    refined = np.empty((0, 3))
    if run.refined_landmarks is not None:
        _, refined = map_errors(run.refined_landmarks, run.true_landmarks, origin)
    return {
        "map_rmse_m": rmse(errors),
        "refined_map_rmse_m": rmse(refined),
        "landmark_nees": nees(errors, _full(run.landmarks.covariances[rows])),
    }


def _cell(figures: dict, key: str) -> str:
    """A robot has no map of its own."""
    if key not in figures:
        return ""
    return "-" if figures[key] is None else f"{figures[key]:.3f}"
