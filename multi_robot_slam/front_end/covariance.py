"""How exact a point of a stereo pair is: from pixels to metres, through (14)."""

import numpy as np

from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.front_end.settings import FeatureSettings
from multi_robot_slam.models.symmetric import pack

PER_SIZE = 0.03
"""Standard deviation of row and column for each pixel of the keypoint's diameter."""

CORRELATED = 2.0
"""A disparity's standard deviation over what its window's information tells: the differences of
neighbouring pixels are not independent."""


def pixel_sigmas(
    sizes: np.ndarray, information: np.ndarray, settings: FeatureSettings
) -> np.ndarray:
    """Standard deviations (n, 3) of column, row and disparity [px].

    Parameters
    ----------
    sizes : (n,) diameters of the keypoints [px].
    information : (n,) of the disparities, by their windows (`disparity.refined`) [1 / px^2].

    """
    place = np.hypot(settings.sigma_px / settings.scale, PER_SIZE * sizes)
    disparity = np.sqrt(settings.sigma_disparity_px**2 + CORRELATED**2 / information)
    return np.column_stack([place, place, disparity])


def jacobian(rig: StereoRig, pixels: np.ndarray) -> np.ndarray:
    """d(X, Y, Z) / d(column, row, disparity) of (14) at `pixels` (n, 3): (n, 3, 3) [m / px]."""
    column, row, disparity = pixels.T
    scale = rig.baseline_m / disparity
    result = np.zeros((len(pixels), 3, 3))
    result[:, 0, 0] = scale
    result[:, 1, 1] = -scale
    result[:, 0, 2] = -scale * (column - rig.centre_px[0]) / disparity
    result[:, 1, 2] = -scale * (rig.centre_px[1] - row) / disparity
    result[:, 2, 2] = -scale * rig.focal_px / disparity
    return result


def propagated(rig: StereoRig, pixels: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """Covariances (n, 6) `xx xy xz yy yz zz` [m^2] of the points at `pixels` (n, 3).

    `sigmas` (n, 3) are those of column, row and disparity [px], which are independent. (15) is the
    diagonal of this.
    """
    lever = jacobian(rig, pixels) * sigmas[:, None, :]
    return pack(lever @ np.swapaxes(lever, 1, 2))
