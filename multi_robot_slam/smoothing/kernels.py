"""The compiled sums of the smoothing along one path: landmarks, information of the poses, gradient.

`poses` here have one row more than the problem has poses: zeros, the pose that MAP stands for. The
system is an `Envelope`: `rows` give the row of each pose's x, `hubs` that of each landmark's x, -1
if it is eliminated, `origins` where a row is in `system`.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def difference(pose, landmark, v):
    """Landmark minus pose and e = l - p - Rz v: (q_x, q_y, e_x, e_y, e_z)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    q_x, q_y = landmark[0] - pose[0], landmark[1] - pose[1]
    return q_x, q_y, q_x - c * v[0] + s * v[1], q_y - s * v[0] - c * v[1], landmark[2] - v[2]


@njit(cache=True, nogil=True, error_model="numpy")
def inverse(xx, xy, xz, yy, yz, zz):
    """Inverse of a symmetric matrix and its determinant: (c_xx c_xy c_xz c_yy c_yz c_zz), det."""
    c_xx, c_xy, c_xz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    det = xx * c_xx + xy * c_xy + xz * c_xz
    scale = 1 / det
    c_yy = (xx * zz - xz * xz) * scale
    c_yz = (xy * xz - xx * yz) * scale
    c_zz = (xx * yy - xy * xy) * scale
    return (c_xx * scale, c_xy * scale, c_xz * scale, c_yy, c_yz, c_zz), det


@njit(cache=True, nogil=True, error_model="numpy")
def inverses(matrices):
    """Inverses (n, 6) of symmetric `matrices` (n, 6) `xx xy xz yy yz zz`."""
    result = np.empty(matrices.shape)
    for i in range(len(matrices)):
        xx, xy, xz, yy, yz, zz = matrices[i]
        result[i], _ = inverse(xx, xy, xz, yy, yz, zz)
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def fit_landmarks(starts, seen_from, positions, information, poses, landmarks):
    """Mean and covariance (N, 9) of the landmarks: sums of information, as the EKFs hold them."""
    for n in range(len(landmarks)):
        h_x = h_y = h_z = xx = xy = xz = yy = yz = zz = 0.0
        for o in range(starts[n], starts[n + 1]):
            pose, v = poses[seen_from[o]], positions[o]
            c, s = np.cos(pose[2]), np.sin(pose[2])
            w_xx, w_xy, w_xz, w_yy, w_yz = turned(information[o], c, s)
            w_zz = information[o, 5]
            at_x, at_y = pose[0] + c * v[0] - s * v[1], pose[1] + s * v[0] + c * v[1]
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


@njit(cache=True, nogil=True, error_model="numpy")
def distances(starts, seen_from, positions, information, poses, landmarks, squared):
    """D (O,) of each observation: e^T W e."""
    for n in range(len(landmarks)):
        for o in range(starts[n], starts[n + 1]):
            pose = poses[seen_from[o]]
            _, _, x, y, z = difference(pose, landmarks[n], positions[o])
            xx, xy, xz, yy, yz = turned(information[o], np.cos(pose[2]), np.sin(pose[2]))
            squared[o] = xx * x * x + yy * y * y + information[o, 5] * z * z
            squared[o] += 2 * (xy * x * y + xz * x * z + yz * y * z)


@njit(cache=True, nogil=True, error_model="numpy")
def sighting_distances(seen_from, seen, positions, information, poses, squared):
    """D (S,) of each sighting."""
    for o in range(len(seen)):
        pose, other = poses[seen_from[o]], poses[seen[o]]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        q_x, q_y = other[0] - pose[0], other[1] - pose[1]
        x, y = c * q_x + s * q_y - positions[o, 0], c * q_y - s * q_x - positions[o, 1]
        xx, xy, yy = information[o]
        squared[o] = xx * x * x + 2 * xy * x * y + yy * y * y


@njit(cache=True, nogil=True, error_model="numpy")
def lean(information, pose, q_x, q_y, result):
    """J^T W (3, 3) of one observation."""
    xx, xy, xz, yy, yz = turned(information, np.cos(pose[2]), np.sin(pose[2]))
    result[0, 0], result[0, 1], result[0, 2] = -xx, -xy, -xz
    result[1, 0], result[1, 1], result[1, 2] = -xy, -yy, -yz
    result[2, 0] = q_y * xx - q_x * xy
    result[2, 1] = q_y * xy - q_x * yy
    result[2, 2] = q_y * xz - q_x * yz


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
def link_sightings(seen_from, seen, positions, information, poses, jacobians, residuals):
    """Residuals (S, 3), and their derivatives (S, 3, 6) by pose that sees and pose seen, whitened.

    In the frame of the robot that sees; the third row stays zero.
    """
    for o in range(len(seen)):
        pose, other = poses[seen_from[o]], poses[seen[o]]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        q_x, q_y = other[0] - pose[0], other[1] - pose[1]
        x, y = c * q_x + s * q_y, c * q_y - s * q_x
        jacobians[o, 0] = (-c, -s, y, c, s, 0.0)
        jacobians[o, 1] = (s, -c, -x, -s, c, 0.0)
        residuals[o, 0], residuals[o, 1] = x - positions[o, 0], y - positions[o, 1]
        whiten(information[o], jacobians[o], residuals[o])


@njit(cache=True, nogil=True, error_model="numpy")
def link_gradient(ends, jacobians, residuals, gradient):
    """Add J^T r of residuals between the two poses `ends` (L, 2); below 0: no pose."""
    for i in range(len(ends)):
        for j in range(6):
            if ends[i, j // 3] >= 0:
                at = 3 * ends[i, j // 3] + j % 3
                gradient[at] += np.sum(jacobians[i, :, j] * residuals[i])


@njit(cache=True, nogil=True, error_model="numpy")
def add_links(ends, jacobians, rows, origins, system):
    """Add J^T J (lower triangle) of residuals between the two poses `ends` (L, 2)."""
    for link in range(len(ends)):
        jacobian = jacobians[link]
        for i in range(0 if ends[link, 0] >= 0 else 3, 6):
            row = rows[ends[link, i // 3]] + i % 3
            for j in range(0 if ends[link, 0] >= 0 else 3, 6):
                column = rows[ends[link, j // 3]] + j % 3
                if column <= row:
                    system[origins[row] + column] += np.sum(jacobian[:, i] * jacobian[:, j])


@njit(cache=True, nogil=True, error_model="numpy")
def whiten(information, jacobian, residual):
    """Multiply both, in place, with the upper root (2, 2) of the information `xx xy yy`."""
    xx = np.sqrt(information[0])
    xy = information[1] / xx
    yy = np.sqrt(information[2] - xy * xy)
    jacobian[0] = xx * jacobian[0] + xy * jacobian[1]
    jacobian[1] *= yy
    residual[0] = xx * residual[0] + xy * residual[1]
    residual[1] *= yy


@njit(cache=True, nogil=True, error_model="numpy")
def observation_gradient(starts, seen_from, positions, information, poses, landmarks, gradient):
    """Add J^T W e of the observations."""
    own = np.empty((3, 3))
    for n in range(len(landmarks)):
        for o in range(starts[n], starts[n + 1]):
            pose, row = poses[seen_from[o]], 3 * seen_from[o]
            if row >= 0:
                q_x, q_y, e_x, e_y, e_z = difference(pose, landmarks[n], positions[o])
                lean(information[o], pose, q_x, q_y, own)
                for i in range(3):
                    gradient[row + i] += own[i, 0] * e_x + own[i, 1] * e_y + own[i, 2] * e_z


@njit(cache=True, nogil=True, error_model="numpy")
def add_observations(starts, seen_from, information, poses, landmarks, hubs, rows, origins, system):
    """Add the observations' part of H (lower triangle), landmarks out that are no hubs."""
    roots = np.empty((len(seen_from), 3, 3))
    own = np.empty((3, 3))
    for n in range(len(landmarks)):
        root = covariance_root(landmarks[n])
        first = starts[n]
        while first < starts[n + 1] and seen_from[first] < 0:
            first += 1
        for o in range(first, starts[n + 1]):
            pose, row = poses[seen_from[o]], rows[seen_from[o]]
            q_x, q_y = landmarks[n, 0] - pose[0], landmarks[n, 1] - pose[1]
            lean(information[o], pose, q_x, q_y, own)
            for i in range(3):
                at = origins[row + i] + row
                system[at] -= own[i, 0]
                system[at + 1] -= own[i, 1]
                system[at + 2] += own[i, 0] * q_y - own[i, 1] * q_x
            if hubs[n] >= 0:
                add_transposed(own, hubs[n], row, origins, system)
            else:
                multiply(own, root, roots[o])
        if hubs[n] >= 0:
            add_hub(landmarks[n], hubs[n], origins, system)
        else:
            subtract_pairs(roots, first, starts[n + 1], seen_from, rows, origins, system)


@njit(cache=True, nogil=True, error_model="numpy")
def multiply(a, lower, result):
    """A (3, 3) times a lower triangle."""
    for i in range(3):
        for j in range(3):
            result[i, j] = 0
            for k in range(j, 3):
                result[i, j] += a[i, k] * lower[k, j]


@njit(cache=True, nogil=True, error_model="numpy")
def add_transposed(own, row, column, origins, system):
    """Add own^T (3, 3) to the block of `system` at `row`, `column`."""
    for i in range(3):
        for j in range(3):
            system[origins[row + i] + column + j] += own[j, i]


@njit(cache=True, nogil=True, error_model="numpy")
def add_hub(landmark, row, origins, system):
    """Add a hub's own information."""
    (xx, xy, xz, yy, yz, zz), _ = inverse(
        landmark[3], landmark[4], landmark[5], landmark[6], landmark[7], landmark[8]
    )
    system[origins[row] + row] += xx
    system[origins[row + 1] + row] += xy
    system[origins[row + 1] + row + 1] += yy
    system[origins[row + 2] + row] += xz
    system[origins[row + 2] + row + 1] += yz
    system[origins[row + 2] + row + 2] += zz


@njit(cache=True, nogil=True, error_model="numpy")
def subtract_pairs(roots, first, last, seen_from, rows, origins, system):
    """Eliminate a landmark: subtract the product of the `roots` of any two of its observations."""
    for o in range(first, last):
        for other in range(first, o + 1):
            row, column = rows[seen_from[o]], rows[seen_from[other]]
            if row < column:
                subtract_product(roots[other], roots[o], column, row, origins, system)
            else:
                subtract_product(roots[o], roots[other], row, column, origins, system)
            if row == column and other < o:
                subtract_product(roots[other], roots[o], row, row, origins, system)


@njit(cache=True, nogil=True, error_model="numpy")
def subtract_product(a, b, row, column, origins, system):
    """Subtract a b^T (3, 3) from the block of `system` at `row`, `column`."""
    for i in range(3):
        at = origins[row + i] + column
        for j in range(3):
            system[at + j] -= a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]


@njit(cache=True, nogil=True, error_model="numpy")
def covariance_root(landmark):
    """Lower Cholesky factor (3, 3) of the covariance in `landmark` (9,)."""
    root = np.zeros((3, 3))
    root[0, 0] = np.sqrt(landmark[3])
    root[1, 0], root[2, 0] = landmark[4] / root[0, 0], landmark[5] / root[0, 0]
    root[1, 1] = np.sqrt(landmark[6] - root[1, 0] ** 2)
    root[2, 1] = (landmark[7] - root[2, 0] * root[1, 0]) / root[1, 1]
    root[2, 2] = np.sqrt(landmark[8] - root[2, 0] ** 2 - root[2, 1] ** 2)
    return root


@njit(cache=True, nogil=True, error_model="numpy")
def add_leans(wanted, starts, seen_from, information, poses, landmarks, leans):
    """Add dl/dx = -Lambda^-1 sum W J of the landmarks `wanted` (A,) to `leans` (3 A, 3 P)."""
    own = np.empty((3, 3))
    covariance = np.empty((3, 3))
    for a, n in enumerate(wanted):
        root = covariance_root(landmarks[n])
        covariance[:] = root @ root.T
        for o in range(starts[n], starts[n + 1]):
            if seen_from[o] < 0:
                continue
            pose, first = poses[seen_from[o]], 3 * seen_from[o]
            q_x, q_y = landmarks[n, 0] - pose[0], landmarks[n, 1] - pose[1]
            lean(information[o], pose, q_x, q_y, own)
            leans[3 * a : 3 * a + 3, first : first + 3] -= covariance @ own.T
