"""Whether the filter knows how wrong it is: normalised estimation errors (NEES)."""

import numpy as np

from msg_defs.wire import Estimates
from multi_robot_slam.runs.run import Run
from multi_robot_slam.runs.trajectory_errors import at, covers, wrap

ROUNDING_SQ = 1e-18
"""Variances up to that of a nanometre or nanoradian come from rounding, not from a spread."""


def nees(errors: np.ndarray, covariances: np.ndarray) -> float | None:
    """Average normalised estimation error squared of (n, 3) `errors`, 3 if (n, 3, 3) are right.

    None if nothing of what `normalised` takes is left.
    """
    found = normalised(errors, covariances)
    return float(np.mean(found)) if len(found) else None


def normalised(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Each normalised estimation error squared.

    A singular covariance claims certainty, which no error can be held to: it is left out. So is
    the known start, and the spread of three particles or fewer.
    """
    largest = np.linalg.norm(covariances, ord=2, axis=(1, 2))
    least = np.maximum(ROUNDING_SQ, largest * errors.shape[1] * np.finfo(float).eps)
    regular = np.linalg.matrix_rank(covariances, tol=least, hermitian=True) == errors.shape[1]
    errors, covariances = errors[regular], covariances[regular]
    whitened = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    return np.sum(errors * whitened, axis=1)


def published_errors(run: Run) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Errors (T, 3) and covariances (T, 3, 3) of the means as published, where the truth is known.

    Of each robot, at its steps, and between them where the pose that is predicted is the mean.
    """
    found = {}
    for name, robot in run.robots.items():
        stamps, means, covariances = published_means(run, name)
        if robot.truth is None:
            found[name] = means[:0], covariances[:0]
            continue
        known = covers(robot.truth, stamps)
        errors = means[known] - at(robot.truth, stamps[known]) if known.any() else means[:0]
        errors[:, 2] = wrap(errors[:, 2])
        found[name] = errors, covariances[known]
    return found


def published_means(run: Run, name: str) -> Estimates:
    """The means of the robot `name` as published: at its steps, and between where they are.

    In no order; of one stamp there is one.
    """
    estimates = [
        estimate
        for step in run.steps
        for estimate in step.estimates
        if estimate.robot == name and estimate.mean is not None
    ]
    at_steps = Estimates(
        np.array([estimate.stamp_ns for estimate in estimates], np.int64),
        np.array([estimate.mean for estimate in estimates]).reshape(-1, 3),
        np.array([e.covariance for e in estimates]).reshape(-1, 3, 3),
    )
    if not run.config.publishes_mean:
        return at_steps
    predicted = run.robots[name].predicted
    is_last = ~np.isin(predicted.stamps_ns, at_steps.stamps_ns)
    return Estimates(
        *(np.concatenate([a, b[is_last]]) for a, b in zip(at_steps, predicted, strict=True))
    )
