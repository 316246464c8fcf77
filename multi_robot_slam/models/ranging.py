"""The covariance of a stereo observation at the distance where the landmark is, not where it seems.

A stereo camera measures column, row and disparity (u, v, d) with noise that is the same at any
distance; the covariance (15) of the point grows with its distance, r^2 across the line of sight and
r^4 along it. Taken at the measured point it depends on the very error that it describes: a point
that seems too near counts for more than one that seems too far, and the average of many is too
near, by 4 (sigma_d / d)^2 of the distance. With 15 points a frame that is lost in their noise, with
a hundred it is not.

So the covariance is taken at a landmark that is known already (as decorrelated unbiased converted
measurements do: Bordonaro, Willett, Bar-Shalom 2014). At s times the distance, on the same line of
sight, with a the share of the disparity, of which alone the depth Z depends,

    R(s) = s^2 (R - a a^T) + s^4 a a^T,    a = sigma_Z / Z * (v - c)                          (N1)
"""

from typing import NamedTuple

import numpy as np

from msg_defs.types import CameraMount
from multi_robot_slam.models.compiled import kernel
from multi_robot_slam.models.stereo import CAMERA_TO_BODY, rotation

FARTHEST_SIGMA = 5.0
"""A landmark so many standard deviations nearer or farther is another one."""


class Ranging(NamedTuple):
    """How a stereo camera found B points."""

    rays: np.ndarray
    """(B, 3) float64: v - c, from the camera to each point, in `base_link` axes [m]."""
    relative: np.ndarray
    """(B,) float64: standard deviation of each point's depth over that depth, sigma_Z / Z."""

    @classmethod
    def of(cls, positions: np.ndarray, covariances: np.ndarray, mount: CameraMount) -> "Ranging":
        """Of points (B, 3) and covariances (B, 6) in the camera frame [m, m^2]."""
        turned = rotation(mount) @ CAMERA_TO_BODY
        depth = positions[:, 2].astype(float)
        return cls(positions @ turned.T, np.sqrt(covariances[:, 5].astype(float)) / depth)


@kernel
def ratio(ray: np.ndarray, relative: float, offset: np.ndarray) -> float:
    """The factor s of (N1) for a landmark at `offset` (3,) from the measured point.

    1 where the landmark is too far off to be the one that was seen, or is none (NaN).
    """
    squared = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]
    along = (offset[0] * ray[0] + offset[1] * ray[1] + offset[2] * ray[2]) / squared
    return 1.0 + along if abs(along) <= FARTHEST_SIGMA * relative else 1.0


@kernel
def at_ratio(covariance: np.ndarray, ray: np.ndarray, relative: float, s: float) -> np.ndarray:
    """(N1): a covariance (6,) at s times its distance."""
    result = np.empty(6)
    if s == 1.0:
        return covariance.copy()
    near, far = s * s, (s * s - 1.0) * s * s * relative * relative
    element = 0
    for i in range(3):
        for j in range(i, 3):
            result[element] = near * covariance[element] + far * ray[i] * ray[j]
            element += 1
    return result


@kernel
def at_landmarks(
    covariances: np.ndarray, rays: np.ndarray, relative: np.ndarray, offsets: np.ndarray
) -> np.ndarray:
    """(N1): `covariances` (B, 6) at landmarks that lie `offsets` (B, 3) from where they seemed.

    All in `base_link` [m, m^2]; an offset of NaN stands for no landmark.
    """
    result = np.empty_like(covariances)
    for b in range(len(covariances)):
        s = ratio(rays[b], relative[b], offsets[b])
        result[b] = at_ratio(covariances[b], rays[b], relative[b], s)
    return result
