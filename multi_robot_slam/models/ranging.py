"""The covariance of a stereo observation at the distance where the landmark is, not where it seems.

A stereo camera measures column, row and disparity (u, v, d) with noise that is the same at any
distance; the covariance (15) of the point grows with its distance, r^2 across the line of sight and
r^4 along it. Taken at the measured point it depends on the very error that it describes: a point
that seems too near counts for more than one that seems too far, and the average of many is too
near, by 4 (sigma_d / d)^2 of the distance. With 15 points a frame that is lost in their noise, with
a hundred it is not.

So the covariance is taken at a landmark that is known already (as decorrelated unbiased converted
measurements do: Bordonaro, Willett, Bar-Shalom 2014). At s times the distance, on the same line of
sight, with a the share of the disparity, on which alone the depth Z depends,

    R(s) = s^2 (R - a a^T) + s^4 a a^T,    a = R e_Z / sigma_Z                                (N1)

For a stereo camera at c that is sigma_Z / Z (v - c), along the line of sight. R(s) is positive
definite whatever R is: a^T R^-1 a = 1.
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
    along: np.ndarray
    """(B, 3) float64: a of (N1), in `base_link` axes [m]."""

    @classmethod
    def of(cls, positions: np.ndarray, covariances: np.ndarray, mount: CameraMount) -> "Ranging":
        """Of points (B, 3) and covariances (B, 6) in the camera frame [m, m^2]."""
        turned = rotation(mount) @ CAMERA_TO_BODY
        of_depth = covariances[:, [2, 4, 5]].astype(float)
        along = of_depth / np.sqrt(of_depth[:, 2:])
        return cls(positions @ turned.T, along @ turned.T)

    def only(self, points: np.ndarray) -> "Ranging":
        """Of some of the points, by index or as booleans."""
        return Ranging(self.rays[points], self.along[points])


@kernel
def ratio(ray: np.ndarray, along: np.ndarray, offset: np.ndarray) -> float:
    """The factor s of (N1) for a landmark at `offset` (3,) from the measured point.

    1 where the landmark is too far off to be the one that was seen, or is none (NaN).
    """
    squared = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]
    sigma_sq = along[0] * along[0] + along[1] * along[1] + along[2] * along[2]
    farther = (offset[0] * ray[0] + offset[1] * ray[1] + offset[2] * ray[2]) / squared
    is_it = farther * farther <= FARTHEST_SIGMA * FARTHEST_SIGMA * sigma_sq / squared
    return 1.0 + farther if is_it and farther > -1 else 1.0


@kernel
def at_landmarks(
    covariances: np.ndarray, rays: np.ndarray, along: np.ndarray, offsets: np.ndarray
) -> np.ndarray:
    """(N1): `covariances` (B, 6) at landmarks that lie `offsets` (B, 3) from where they seemed.

    All in `base_link` [m, m^2]; an offset of NaN stands for no landmark.
    """
    result = covariances.copy()
    for b in range(len(covariances)):
        s = ratio(rays[b], along[b], offsets[b])
        if s == 1.0:
            continue
        near, far = s * s, (s * s - 1.0) * s * s
        element = 0
        for i in range(3):
            for j in range(i, 3):
                own = far * along[b, i] * along[b, j]
                result[b, element] = near * covariances[b, element] + own
                element += 1
    return result
