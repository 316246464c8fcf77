"""How exact a point of a stereo pair is, by propagation through (14)."""

import numpy as np

from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.models.symmetric import pack


def jacobian(rig: StereoRig, pixels: np.ndarray) -> np.ndarray:
    """d(X, Y, Z) / d(u, v, d) of (14) at `pixels` (n, 3): (n, 3, 3) [m / px]."""
    u, v, d = pixels.T
    scale = rig.baseline_m / d
    result = np.zeros((len(pixels), 3, 3))
    result[:, 0, 0] = scale
    result[:, 1, 1] = -scale
    result[:, 0, 2] = -scale * (u - rig.centre_px[0]) / d
    result[:, 1, 2] = -scale * (rig.centre_px[1] - v) / d
    result[:, 2, 2] = -scale * rig.focal_px / d
    return result


def propagated(rig: StereoRig, pixels: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """Covariances (n, 6) `xx xy xz yy yz zz` [m^2] of the points at `pixels` (n, 3).

    `sigmas` (n, 3) are the standard deviations of column, row and disparity [px].
    """
    lever = jacobian(rig, pixels) * sigmas[:, None, :]
    return pack(lever @ np.swapaxes(lever, 1, 2))
