"""Where the right camera sees the left image's keypoints."""

import numpy as np

from multi_robot_slam.front_end import kernels
from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.front_end.settings import FeatureSettings

LEAST_PX = 1
"""Smallest disparity searched [px]."""

UNIQUENESS = 0.8
"""What the best place lacks to a correlation of 1 over what the second best does, at most."""


def disparities(
    left: np.ndarray,
    right: np.ndarray,
    points: np.ndarray,
    settings: FeatureSettings,
    rig: StereoRig,
) -> tuple[np.ndarray, np.ndarray]:
    """Disparity (n,) float64 [px] of `points` (n, 2) of the left image, and their fates (n,).

    Fates are those of `kernels`; of a point that was not FOUND the disparity is 0.
    """
    most_px = int(np.ceil(rig.focal_px * rig.baseline_m / settings.nearest_m))
    found, fates = np.zeros(len(points)), np.zeros(len(points), np.int64)
    kernels.match_rows(
        left,
        right,
        points,
        LEAST_PX,
        max(most_px, LEAST_PX + 2),
        settings.correlation,
        UNIQUENESS,
        found,
        fates,
    )
    return found, fates
