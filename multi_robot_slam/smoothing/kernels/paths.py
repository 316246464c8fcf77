"""The compiled pass over all observations: landmarks along many paths, and the paths' densities.

Blocks of particles are handled together, see `draws._blocks`.
"""

import numpy as np

from multi_robot_slam.models.compiled import kernel
from multi_robot_slam.models.parallel import BLOCK
from multi_robot_slam.models.symmetric import inverse

COS, SIN, X, Y = range(4)
"""Rows of a block of poses."""

HALF_DIFF, XY, XZ, YZ, H_X, H_Y, H_Z, QUADRATIC, CENTRE_X, CENTRE_Y = range(10)
"""Rows of a block of sums: of W (xx - yy) / 2, xy, xz, yz; of h; of e^T W e; and the centre.

The rest of Lambda does not depend on the path.
"""

LOGARITHM_EVERY = 16
"""Landmarks whose determinants are multiplied before a logarithm is taken."""


@kernel
def weigh(first, last, paths, blocks, odometry, sightings, observations, planes, neg2_log_density):
    """Landmarks (N, 9, M) and -2 log p (M,) of particles first .. last - 1, whole blocks."""
    for low in range(first, last, BLOCK):
        high = min(low + BLOCK, last)
        add_odometry(odometry, paths, blocks[low // BLOCK], low, neg2_log_density[low:high])
        add_sightings(sightings, paths, blocks[low // BLOCK], low, neg2_log_density[low:high])
        add_landmarks(observations, blocks[low // BLOCK], low, planes, neg2_log_density[low:high])


@kernel
def add_odometry(odometry, paths, block, low, neg2_log_density):
    """Add the squared residuals of the odometry of the last poses."""
    previous, motions, sigmas = odometry
    anchors = len(paths) - len(previous)
    for i in range(len(previous)):
        p, q = anchors + i, previous[i]
        (u_x, u_y, u_yaw), (s_x, s_y, s_yaw) = motions[i], 1 / sigmas[i]
        for m in range(len(neg2_log_density)):
            cos, sin = np.float64(block[q, COS, m]), np.float64(block[q, SIN, m])
            d_x = paths[p, 0, low + m] - paths[q, 0, low + m]
            d_y = paths[p, 1, low + m] - paths[q, 1, low + m]
            turn = paths[p, 2, low + m] - paths[q, 2, low + m] - u_yaw
            turn -= 2 * np.pi * np.rint(turn / (2 * np.pi))
            e_x = (cos * d_x + sin * d_y - u_x) * s_x
            e_y = (cos * d_y - sin * d_x - u_y) * s_y
            neg2_log_density[m] += e_x * e_x + e_y * e_y + (turn * s_yaw) * (turn * s_yaw)


@kernel
def add_sightings(sightings, paths, block, low, neg2_log_density):
    """Add D of the sightings."""
    seen_from, seen, positions, information = sightings
    for o in range(len(seen)):
        p, q, (v_x, v_y), (xx, xy, yy) = seen_from[o], seen[o], positions[o], information[o]
        for m in range(len(neg2_log_density)):
            cos, sin = np.float64(block[p, COS, m]), np.float64(block[p, SIN, m])
            d_x = paths[q, 0, low + m] - paths[p, 0, low + m]
            d_y = paths[q, 1, low + m] - paths[p, 1, low + m]
            e_x, e_y = cos * d_x + sin * d_y - v_x, cos * d_y - sin * d_x - v_y
            neg2_log_density[m] += xx * e_x * e_x + 2 * xy * e_x * e_y + yy * e_y * e_y


@kernel
def add_landmarks(observations, block, low, planes, neg2_log_density):
    """Landmarks of one block of particles; add D_n + log det Lambda_n of each."""
    starts, seen_from, positions, information = observations
    local = np.empty((10, BLOCK), planes.dtype)
    determinants = np.ones(len(neg2_log_density))
    for n in range(len(planes)):
        centre = most_certain(information, starts[n], starts[n + 1])
        height = positions[centre, 2]
        local[:CENTRE_X] = 0
        place(block[seen_from[centre]], positions[centre], local)
        total_half_sum, total_zz = local.dtype.type(0), local.dtype.type(0)
        for o in range(starts[n], starts[n + 1]):
            v, own = positions[o], information[o]
            half_sum = (own[0] + own[3]) * local.dtype.type(0.5)
            add_observation(block[seen_from[o]], v[0], v[1], v[2] - height, own, half_sum, local)
            total_half_sum += half_sum
            total_zz += own[5]
        finish(
            local, total_half_sum, total_zz, height, low, planes[n], neg2_log_density, determinants
        )
        if n % LOGARITHM_EVERY == 0 or n == len(planes) - 1:
            neg2_log_density += np.log(determinants)
            determinants[:] = 1


@kernel
def most_certain(information, first, last):
    """The observation whose information has the largest determinant, off its diagonal aside."""
    best, largest = first, -1.0
    for o in range(first, last):
        size = float(information[o, 0]) * float(information[o, 3]) * float(information[o, 5])
        if size > largest:
            best, largest = o, size
    return best


@kernel
def place(pose, v, local):
    """Where each particle sees v: the centre."""
    for m in range(BLOCK):
        local[CENTRE_X, m] = pose[X, m] + (pose[COS, m] * v[0] - pose[SIN, m] * v[1])
        local[CENTRE_Y, m] = pose[Y, m] + (pose[SIN, m] * v[0] + pose[COS, m] * v[1])


@kernel
def add_observation(pose, v_x, v_y, e_z, own, half_sum, local):
    """Add one observation to the sums; its information is turned by twice the yaw.

    In the map frame xx and yy are half_sum +- half_diff: a third of the multiplications is saved.
    """
    own_half_diff = (own[0] - own[3]) * local.dtype.type(0.5)
    for m in range(BLOCK):
        c, s = pose[COS, m], pose[SIN, m]
        e_x = pose[X, m] + (c * v_x - s * v_y) - local[CENTRE_X, m]
        e_y = pose[Y, m] + (s * v_x + c * v_y) - local[CENTRE_Y, m]
        cos_twice, sin_twice = c * c - s * s, c * s + c * s
        half_diff = own_half_diff * cos_twice - own[1] * sin_twice
        xy = own_half_diff * sin_twice + own[1] * cos_twice
        xz, yz = c * own[2] - s * own[4], s * own[2] + c * own[4]
        h_x = (half_sum + half_diff) * e_x + xy * e_y + xz * e_z
        h_y = xy * e_x + (half_sum - half_diff) * e_y + yz * e_z
        h_z = xz * e_x + yz * e_y + own[5] * e_z
        local[HALF_DIFF, m] += half_diff
        local[XY, m] += xy
        local[XZ, m] += xz
        local[YZ, m] += yz
        local[H_X, m] += h_x
        local[H_Y, m] += h_y
        local[H_Z, m] += h_z
        local[QUADRATIC, m] += h_x * e_x + h_y * e_y + h_z * e_z


@kernel
def finish(local, half_sum, zz, height, low, plane, neg2_log_density, determinants):
    """Sums -> mean and covariance `plane` (9, M), D_n, det Lambda_n over a power of its trace."""
    scale = 1 / (float(half_sum) * float(half_sum) * float(zz))
    for m in range(len(neg2_log_density)):
        covariance, determinant = inverse(
            half_sum + local[HALF_DIFF, m],
            local[XY, m],
            local[XZ, m],
            half_sum - local[HALF_DIFF, m],
            local[YZ, m],
            zz,
        )
        c_xx, c_xy, c_xz, c_yy, c_yz, c_zz = covariance
        h_x, h_y, h_z = local[H_X, m], local[H_Y, m], local[H_Z, m]
        x, y = c_xx * h_x + c_xy * h_y + c_xz * h_z, c_xy * h_x + c_yy * h_y + c_yz * h_z
        z = c_xz * h_x + c_yz * h_y + c_zz * h_z
        plane[0, low + m] = local[CENTRE_X, m] + x
        plane[1, low + m] = local[CENTRE_Y, m] + y
        plane[2, low + m] = height + z
        plane[3, low + m], plane[4, low + m], plane[5, low + m] = c_xx, c_xy, c_xz
        plane[6, low + m], plane[7, low + m], plane[8, low + m] = c_yy, c_yz, c_zz
        neg2_log_density[m] += local[QUADRATIC, m] - (h_x * x + h_y * y + h_z * z)
        determinants[m] *= determinant * scale
