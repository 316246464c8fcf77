"""The informed proposal: each particle's new pose is drawn knowing what the robot sees.

After FastSLAM 2.0 (Montemerlo, Thrun, Koller, Wegbreit, 2003), for a pose that is exactly Gaussian
before the frame. Given the particle's last pose, the motion model (7) is N(x_bar, P) with
P = diag(Rz diag(s_f^2, s_l^2) Rz^T, s_yaw^2). A matched observation says that

    nu(x) = g^-1(x, v) - mu  is  N(0, Sigma + Rz R Rz^T),    nu(x_bar + d) = nu(x_bar) + H d,

so every match in turn is a Kalman update of the pose with

    S = H P H^T + Sigma + Rz R Rz^T,  K = P H^T S^-1,  x <- x - K nu,  P <- P - K H P,

and N(nu; 0, S) is its factor of the weight. The pose is then drawn from what results, and the
landmarks are updated or created with the drawn pose.
"""

import numpy as np
from numba import njit

from multi_robot_slam.filter.kernels import FLOAT_RULES, create_column, update_column

BLOCK = 256
"""Particles handled together: their beliefs stay in the first-level cache."""

ROWS = 11
"""Numbers of a belief: mean x, y, cos yaw, sin yaw, change of yaw, covariance 6."""

ANY_DISTANCE = 1e30
"""A gate that lets everything through."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FLOAT_RULES)
def associate_and_believe(
    planes, starts, columns, poses, sigma, v, noise, gate, beliefs, matches, squared, determinants
):
    """Match each observation and update each particle's belief about the robot's new pose.

    Parameters
    ----------
    poses : (4, M) cos yaw, sin yaw, x, y of the predicted pose x_bar.
    sigma : (2, M)
    """


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FLOAT_RULES)
def believe(landmark, column, belief, v, noise, gate, matches, squared, determinants):
    """Update a block of beliefs with one landmark where it lies inside the gate."""
    mean_x, mean_y, mean_z = landmark[0], landmark[1], landmark[2]
    cov_xx, cov_xy, cov_xz = landmark[3], landmark[4], landmark[5]
    cov_yy, cov_yz, cov_zz = landmark[6], landmark[7], landmark[8]
