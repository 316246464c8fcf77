"""The compiled sums over what ties two poses, and the gradient by poses and centres.

`links` are `linearised.Links`.
"""

import numpy as np

from multi_robot_slam.models.compiled import kernel
from multi_robot_slam.smoothing.kernels.landmarks import difference, weighted_jacobian


@kernel
def odometry_jacobians(before, sigmas, poses, jacobians):
    """Derivatives of the residuals by pose before and pose, (P, 3, 6), whitened."""
    for p in range(len(jacobians)):
        c, s = np.cos(before[p, 2]), np.sin(before[p, 2])
        d_x, d_y = poses[p, 0] - before[p, 0], poses[p, 1] - before[p, 1]
        jacobians[p, 0] = (-c, -s, c * d_y - s * d_x, c, s, 0.0)
        jacobians[p, 1] = (s, -c, -c * d_x - s * d_y, -s, c, 0.0)
        jacobians[p, 2] = (0.0, 0.0, -1.0, 0.0, 0.0, 1.0)
        for i in range(3):
            jacobians[p, i] /= sigmas[p, i]


@kernel
def link_sightings(sightings, poses, residuals, jacobians):
    """Residuals (S, 3), and their derivatives (S, 3, 6) by pose that sees and pose seen, whitened.

    In the frame of the robot that sees; the third row stays zero.
    """
    seen_from, seen, positions, information = sightings
    for o in range(len(seen)):
        pose, other = poses[seen_from[o]], poses[seen[o]]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        q_x, q_y = other[0] - pose[0], other[1] - pose[1]
        x, y = c * q_x + s * q_y, c * q_y - s * q_x
        jacobians[o, 0] = (-c, -s, y, c, s, 0.0)
        jacobians[o, 1] = (s, -c, -x, -s, c, 0.0)
        residuals[o, 0], residuals[o, 1] = x - positions[o, 0], y - positions[o, 1]
        whiten(information[o], jacobians[o], residuals[o])


@kernel
def whiten(information, jacobian, residual):
    """Multiply both, in place, with the upper root (2, 2) of the information `xx xy yy`."""
    xx = np.sqrt(information[0])
    xy = information[1] / xx
    yy = np.sqrt(information[2] - xy * xy)
    jacobian[0] = xx * jacobian[0] + xy * jacobian[1]
    jacobian[1] *= yy
    residual[0] = xx * residual[0] + xy * residual[1]
    residual[1] *= yy


@kernel
def add_link_gradient(links, gradient):
    """Add J^T r of the links."""
    ends, residuals, jacobians = links
    for i in range(len(ends)):
        for j in range(6):
            at = 3 * ends[i, j // 3] + j % 3
            gradient[at] += np.sum(jacobians[i, :, j] * residuals[i])


@kernel
def add_observation_gradient(observations, views, columns, landmarks, gradient):
    """Add J^T W e of the observations."""
    starts, seen_from, positions, information = observations
    own = np.empty((3, 3))
    for n in range(len(landmarks)):
        for o in range(starts[n], starts[n + 1]):
            view, row = views[seen_from[o]], columns[seen_from[o]]
            q_x, q_y, e_x, e_y, e_z = difference(view, landmarks[n], positions[o])
            weighted_jacobian(information[o], view, q_x, q_y, own)
            for i in range(columns[seen_from[o] + 1] - row):
                gradient[row + i] += own[i, 0] * e_x + own[i, 1] * e_y + own[i, 2] * e_z
