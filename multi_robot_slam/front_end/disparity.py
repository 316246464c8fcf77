"""Where the right camera sees points of the left image: disparities, and how exact they are.

By correlation along the row, not by keypoints of both images. On two recordings, in a room and in a
street, 0.3 and 0.7 % of the disparities were wrong by more than a pixel, of SIFT in both images
within the epipolar band 4.7 and 9.5 %, at a quarter to a third fewer points and twice the time.
Below a pixel least squares beat a parabola through three correlations: on planes with noise its
bias is 0.005 px instead of 0.008, its spread 0.023 instead of 0.064.
"""

from dataclasses import dataclass

import numpy as np

from multi_robot_slam.front_end import kernels

LEAST_PX = 1
"""Smallest disparity searched [px]."""

UNIQUENESS = 0.8
"""What the best place lacks to a correlation of 1 over what the second best lacks, at most."""

STEADY_PX = 0.3
"""What windows of two sizes may differ by. On a smooth surface it is less; of those that differ by
more, every tenth is wrong by over 0.6 px in a room, and every fifth in a street."""


@dataclass(frozen=True)
class Search:
    """What is searched along a row."""

    most_px: int
    """Largest disparity."""
    correlation: float
    """Least normalised cross-correlation."""


def searched(
    left: np.ndarray, right: np.ndarray, points: np.ndarray, search: Search
) -> tuple[np.ndarray, np.ndarray]:
    """Disparity [px] of each of `points` (n, 2), column and row, and its fate.

    Parameters
    ----------
    left, right : rectified images (H, W) uint8.

    Returns
    -------
    (n,) float64 and (n,) int64: fates as in `kernels`; the disparity of one not FOUND is 0.

    """
    disparities, fates = np.zeros(len(points)), np.zeros(len(points), np.int64)
    kernels.match_rows(
        np.ascontiguousarray(left),
        np.ascontiguousarray(right),
        points,
        LEAST_PX,
        max(search.most_px, LEAST_PX + 2),
        search.correlation,
        UNIQUENESS,
        disparities,
        fates,
    )
    return disparities, fates


def refined(
    left: np.ndarray, right: np.ndarray, points: np.ndarray, disparities: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Disparities (n,) [px] to a fraction of a pixel, and the information of each [1 / px^2].

    The information is 0 where the refinement came to no end, or to one that a smaller window
    contradicts.
    """
    result, information = np.zeros(len(points)), np.zeros(len(points))
    kernels.refine_rows(
        np.ascontiguousarray(left),
        np.ascontiguousarray(right),
        points,
        disparities,
        result,
        information,
    )
    information[np.abs(result - disparities) > STEADY_PX] = 0.0
    return result, information
