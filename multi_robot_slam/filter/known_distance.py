"""Observations of landmarks that are known: covariances at the known distance (N1)."""

from dataclasses import replace

import numpy as np

from multi_robot_slam.filter.association import Candidates
from multi_robot_slam.filter.kernels import FAR
from multi_robot_slam.filter.landmarks import Landmarks
from multi_robot_slam.models.compiled import kernel
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.models.ranging import at_landmarks


def at_known(
    frame: RobotFrame,
    landmarks: Landmarks,
    candidates: Candidates,
    touched: np.ndarray,
    poses: np.ndarray,
) -> RobotFrame:
    """The frame with covariances that do not depend on their own errors.

    Distances are those of the particles' mean, the same for all: of the candidates the one that is
    nearest to the line of sight.

    Parameters
    ----------
    touched : the landmarks' columns among the candidates, ascending, up to date.
    poses : (3, M) of the robot.

    """
    if frame.ranging is None or not len(touched):
        return frame
    means = mean_places(landmarks.planes, touched)
    offsets = offsets_of(candidates, touched, means, poses, frame.positions, frame.ranging.rays)
    covariances = at_landmarks(frame.covariances, *frame.ranging, offsets)
    return replace(frame, covariances=covariances)


@kernel
def mean_places(planes: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """(n, 3): mean of `columns` (n,) over the particles that have the landmark [m]."""
    result = np.empty((len(columns), 3))
    for n in range(len(columns)):
        x = y = z = 0.0
        count = 0
        own = planes[columns[n]]
        for m in range(own.shape[1]):
            has = own[0, m] < FAR / 2
            x += own[0, m] if has else 0.0
            y += own[1, m] if has else 0.0
            z += own[2, m] if has else 0.0
            count += has
        result[n, 0], result[n, 1], result[n, 2] = x / count, y / count, z / count
    return result


@kernel
def offsets_of(
    candidates: Candidates,
    touched: np.ndarray,
    means: np.ndarray,
    poses: np.ndarray,
    positions: np.ndarray,
    rays: np.ndarray,
) -> np.ndarray:
    """(B, 3): from each observation to its likeliest candidate in `base_link` [m]; NaN: none.

    Parameters
    ----------
    touched, means : (n,) columns, ascending, and (n, 3) where they are.
    positions, rays : (B, 3) of the observations in `base_link`, seen from the mean of `poses`.

    """
    x, y, yaw = poses[0].mean(), poses[1].mean(), poses[2].mean()
    cos, sin = np.cos(yaw), np.sin(yaw)
    result = np.full(positions.shape, np.nan)
    offset = np.empty(3)
    for b in range(len(positions)):
        ray = rays[b]
        squared = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]
        nearest = np.inf
        for c in range(candidates.starts[b], candidates.starts[b + 1]):
            if candidates.columns[c] < 0:
                continue
            place = means[np.searchsorted(touched, candidates.columns[c])]
            dx, dy = place[0] - x, place[1] - y
            offset[0] = cos * dx + sin * dy - positions[b, 0]
            offset[1] = cos * dy - sin * dx - positions[b, 1]
            offset[2] = place[2] - positions[b, 2]
            along = offset[0] * ray[0] + offset[1] * ray[1] + offset[2] * ray[2]
            apart = offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2 - along * along / squared
            if apart < nearest:
                nearest = apart
                result[b] = offset
    return result
