"""The compiled sums over the observations of each landmark, for one path and its centres.

`views` (V, 3) are poses, then centres with yaw 0. `observations` are `problem.Observations`,
`sightings` `problem.PoseSightings`.
"""

import numpy as np

from multi_robot_slam.models.compiled import kernel
from multi_robot_slam.models.symmetric import inverse


@kernel
def turned(information, c, s):
    """Rz R^-1 Rz^T: (5,) xx xy xz yy yz; zz stays."""
    xx, xy, xz = information[0], information[1], information[2]
    yy, yz = information[3], information[4]
    cc, ss, cs = c * c, s * s, c * s
    return (
        cc * xx - 2 * cs * xy + ss * yy,
        cs * (xx - yy) + (cc - ss) * xy,
        c * xz - s * yz,
        ss * xx + 2 * cs * xy + cc * yy,
        s * xz + c * yz,
    )


@kernel
def difference(pose, landmark, v):
    """Landmark minus pose and e = l - p - Rz v: (q_x, q_y, e_x, e_y, e_z)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    q_x, q_y = landmark[0] - pose[0], landmark[1] - pose[1]
    return q_x, q_y, q_x - c * v[0] + s * v[1], q_y - s * v[0] - c * v[1], landmark[2] - v[2]


@kernel
def fit_landmarks(observations, views, landmarks):
    """Mean and covariance (N, 9) of the landmarks: sums of information, as the EKFs hold them."""
    starts, seen_from, positions, information = observations
    for n in range(len(landmarks)):
        h_x = h_y = h_z = xx = xy = xz = yy = yz = zz = 0.0
        for o in range(starts[n], starts[n + 1]):
            view, v = views[seen_from[o]], positions[o]
            c, s = np.cos(view[2]), np.sin(view[2])
            w_xx, w_xy, w_xz, w_yy, w_yz = turned(information[o], c, s)
            w_zz = information[o, 5]
            at_x, at_y = view[0] + c * v[0] - s * v[1], view[1] + s * v[0] + c * v[1]
            h_x += w_xx * at_x + w_xy * at_y + w_xz * v[2]
            h_y += w_xy * at_x + w_yy * at_y + w_yz * v[2]
            h_z += w_xz * at_x + w_yz * at_y + w_zz * v[2]
            xx, xy, xz = xx + w_xx, xy + w_xy, xz + w_xz
            yy, yz, zz = yy + w_yy, yz + w_yz, zz + w_zz
        (xx, xy, xz, yy, yz, zz), _ = inverse(xx, xy, xz, yy, yz, zz)
        landmarks[n, 0] = xx * h_x + xy * h_y + xz * h_z
        landmarks[n, 1] = xy * h_x + yy * h_y + yz * h_z
        landmarks[n, 2] = xz * h_x + yz * h_y + zz * h_z
        landmarks[n, 3], landmarks[n, 4], landmarks[n, 5] = xx, xy, xz
        landmarks[n, 6], landmarks[n, 7], landmarks[n, 8] = yy, yz, zz


@kernel
def mahalanobis_sq(observations, views, landmarks, result):
    """D (O,) of each observation: e^T W e."""
    starts, seen_from, positions, information = observations
    for n in range(len(landmarks)):
        for o in range(starts[n], starts[n + 1]):
            view = views[seen_from[o]]
            _, _, x, y, z = difference(view, landmarks[n], positions[o])
            xx, xy, xz, yy, yz = turned(information[o], np.cos(view[2]), np.sin(view[2]))
            result[o] = xx * x * x + yy * y * y + information[o, 5] * z * z
            result[o] += 2 * (xy * x * y + xz * x * z + yz * y * z)


@kernel
def sighting_mahalanobis_sq(sightings, poses, result):
    """D (S,) of each sighting."""
    seen_from, seen, positions, information = sightings
    for o in range(len(seen)):
        pose, other = poses[seen_from[o]], poses[seen[o]]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        q_x, q_y = other[0] - pose[0], other[1] - pose[1]
        x, y = c * q_x + s * q_y - positions[o, 0], c * q_y - s * q_x - positions[o, 1]
        xx, xy, yy = information[o]
        result[o] = xx * x * x + 2 * xy * x * y + yy * y * y


@kernel
def weighted_jacobian(information, pose, q_x, q_y, result):
    """J^T W (3, 3) of one observation."""
    xx, xy, xz, yy, yz = turned(information, np.cos(pose[2]), np.sin(pose[2]))
    result[0, 0], result[0, 1], result[0, 2] = -xx, -xy, -xz
    result[1, 0], result[1, 1], result[1, 2] = -xy, -yy, -yz
    result[2, 0] = q_y * xx - q_x * xy
    result[2, 1] = q_y * xy - q_x * yy
    result[2, 2] = q_y * xz - q_x * yz


@kernel
def covariance_root(landmark):
    """Lower Cholesky factor (3, 3) of the covariance in `landmark` (9,)."""
    root = np.zeros((3, 3))
    root[0, 0] = np.sqrt(landmark[3])
    root[1, 0], root[2, 0] = landmark[4] / root[0, 0], landmark[5] / root[0, 0]
    root[1, 1] = np.sqrt(landmark[6] - root[1, 0] ** 2)
    root[2, 1] = (landmark[7] - root[2, 0] * root[1, 0]) / root[1, 1]
    root[2, 2] = np.sqrt(landmark[8] - root[2, 0] ** 2 - root[2, 1] ** 2)
    return root


@kernel
def add_landmark_jacobians(wanted, observations, views, columns, landmarks, jacobians):
    """Add dl/dx = -Lambda^-1 sum W J, by poses and centres, of the landmarks `wanted`."""
    starts, seen_from, _, information = observations
    own = np.empty((3, 3))
    covariance = np.empty((3, 3))
    for a, n in enumerate(wanted):
        root = covariance_root(landmarks[n])
        covariance[:] = root @ root.T
        for o in range(starts[n], starts[n + 1]):
            view = views[seen_from[o]]
            first, last = columns[seen_from[o]], columns[seen_from[o] + 1]
            q_x, q_y = landmarks[n, 0] - view[0], landmarks[n, 1] - view[1]
            weighted_jacobian(information[o], view, q_x, q_y, own)
            jacobians[3 * a : 3 * a + 3, first:last] -= covariance @ own[: last - first].T
