"""How far one trajectory is from another: absolute, aligned and relative errors."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from msg_defs.errors import InputError
from msg_defs.types import Trajectory

LONGEST_GAP = 5.0
"""Truth is interpolated between samples at most so many of its usual (median) periods apart."""


class PoseErrors(NamedTuple):
    """Error of one trajectory over time."""

    stamps_ns: np.ndarray
    """(T,) int64."""
    errors: np.ndarray
    """(T, 3) float64: x [m], y [m], yaw [rad] in [-pi, pi), estimate minus truth, `map` frame."""
    truth: np.ndarray
    """(T, 3) float64: x [m], y [m], yaw [rad] of the truth, `map` frame."""


def wrap(angle: np.ndarray) -> np.ndarray:
    """The same angle [rad] in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def rmse(errors: np.ndarray) -> float | None:
    """Root of the mean squared row norm of (T,) or (T, n) `errors`, in their unit."""
    if not len(errors):
        return None
    return float(np.sqrt(np.mean(np.sum(errors.reshape(len(errors), -1) ** 2, axis=1))))


def covers(truth: Trajectory, stamps_ns: np.ndarray) -> np.ndarray:
    """(T,) bool: `stamps_ns` is that of a sample of the truth, or between two without a gap."""
    known = truth.stamps_ns
    if not len(known):
        return np.zeros(len(stamps_ns), bool)
    after = np.searchsorted(known, stamps_ns)
    is_sample = known[np.minimum(after, len(known) - 1)] == stamps_ns
    if len(known) == 1:
        return is_sample
    periods = np.diff(known)
    between = (after > 0) & (after < len(known))
    period = periods[np.clip(after - 1, 0, len(periods) - 1)]
    return is_sample | (between & (period <= LONGEST_GAP * np.median(periods)))


def at(path: Trajectory, stamps_ns: np.ndarray) -> np.ndarray:
    """Poses (T, 3) of a `path` of one or more poses at `stamps_ns` (T,), held at its ends."""
    since = path.stamps_ns[0]  # absolute nanoseconds do not fit a float64
    times, known = stamps_ns - since, path.stamps_ns - since
    x, y, yaw = path.poses.T
    return np.column_stack([np.interp(times, known, f) for f in (x, y, np.unwrap(yaw))])


def sampled(truth: Trajectory, stamps_ns: np.ndarray) -> Trajectory:
    """The truth, interpolated linearly, at those of `stamps_ns` (T,) at which it is known."""
    stamps = stamps_ns[covers(truth, stamps_ns)]
    return Trajectory(stamps, at(truth, stamps) if len(stamps) else np.empty((0, 3)))


def pose_errors(estimate: Trajectory, truth: Trajectory, name: str = "estimate") -> PoseErrors:
    """`estimate` minus `truth`, interpolated linearly at the estimate's stamps.

    Poses whose truth is not known are left out (`truth_coverage` of `evaluate` tells how many are
    not); `InputError` if these are all.
    """
    known = sampled(truth, estimate.stamps_ns)
    if len(estimate.stamps_ns) and not len(known.stamps_ns):
        raise InputError(
            f"{name}: the ground truth covers none of {len(estimate.stamps_ns)} poses; "
            "record it during the run, with the same clock"
        )
    difference = estimate.poses[np.isin(estimate.stamps_ns, known.stamps_ns)] - known.poses
    difference[:, 2] = wrap(difference[:, 2])
    return PoseErrors(known.stamps_ns, difference, known.poses)


def alignment(points: np.ndarray, truth: np.ndarray) -> tuple[float, np.ndarray]:
    """The rotation [rad] and shift (2,) [m] that bring `points` (n, 2) closest to `truth` (n, 2).

    Least squares: truth = R points + shift. Umeyama, Least-squares estimation of transformation
    parameters between two point patterns, IEEE PAMI 13 (1991), without scale; in the plane its
    rotation is an arctangent. Points all in one place give no rotation.
    """
    if not len(points):
        return 0.0, np.zeros(2)
    centre, true_centre = points.mean(axis=0), truth.mean(axis=0)
    (x, y), (true_x, true_y) = (points - centre).T, (truth - true_centre).T
    angle = float(np.arctan2(x @ true_y - y @ true_x, x @ true_x + y @ true_y))
    return angle, true_centre - rotation(angle) @ centre


def rotation(angle: float) -> np.ndarray:
    """(2, 2): turns by `angle` [rad], counter-clockwise."""
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def aligned(paths: Sequence[PoseErrors]) -> list[PoseErrors]:
    """The errors left when one rotation and shift has brought all `paths` closest to the truth."""
    errors = np.concatenate([np.empty((0, 3)), *(path.errors for path in paths)])
    truth = np.concatenate([np.empty((0, 3)), *(path.truth for path in paths)])
    angle, shift = alignment((truth + errors)[:, :2], truth[:, :2])
    return [_moved(path, angle, shift) for path in paths]


def _moved(path: PoseErrors, angle: float, shift: np.ndarray) -> PoseErrors:
    estimate = path.truth + path.errors
    places = estimate[:, :2] @ rotation(angle).T + shift
    errors = np.column_stack([places - path.truth[:, :2], wrap(path.errors[:, 2] + angle)])
    return path._replace(errors=errors)


def relative_errors(path: PoseErrors, distance_m: float) -> np.ndarray:
    """How wrong the motion over each `distance_m` of the path is: (n, 3), x, y [m], yaw [rad].

    Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012:
    E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), seen from the true pose j, Q the truth and P the estimate. As
    in `evo_rpe`, the pairs follow each other: j is the first pose that the estimate has travelled
    `distance_m` to since i. No rotation and shift of the estimate changes anything.
    """
    estimate = path.truth + path.errors
    ends = _each(distance_m, estimate[:, :2])
    true_motion, motion = _motions(path.truth[ends]), _motions(estimate[ends])
    errors = motion - true_motion
    cos, sin = np.cos(true_motion[:, 2]), np.sin(true_motion[:, 2])
    dx, dy, dyaw = errors.T
    return np.column_stack([cos * dx + sin * dy, cos * dy - sin * dx, wrap(dyaw)])


def _each(distance_m: float, places: np.ndarray) -> list[int]:
    """Rows of `places` (T, 2), from the first on, that the path has travelled so far between."""
    travelled = np.cumsum(np.hypot(*np.diff(places, axis=0, prepend=places[:1]).T))
    rows, row = [], 0
    while row < len(places):
        rows.append(row)
        row = int(np.searchsorted(travelled, travelled[row] + distance_m))
    return rows


def _motions(poses: np.ndarray) -> np.ndarray:
    """(n, 3) poses -> (n - 1, 3): each seen from the one before."""
    dx, dy, dyaw = np.diff(poses, axis=0).T
    cos, sin = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    return np.column_stack([cos * dx + sin * dy, cos * dy - sin * dx, dyaw])
