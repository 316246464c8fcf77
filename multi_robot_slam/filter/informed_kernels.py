"""The informed proposal: each particle's new pose is drawn knowing what the robot sees.

After FastSLAM 2.0 (Montemerlo, Thrun, Koller, Wegbreit, 2003). Given the particle's last pose, the
motion model (7) is exactly Gaussian: N(x_bar, P), P = diag(Rz diag(s_f^2, s_l^2) Rz^T, s_yaw^2)
with the yaw before the motion.
A matched observation says that

    nu(x) = g^-1(x, v) - mu  is  N(0, Sigma + Rz R Rz^T),    nu(x_bar + d) = nu(x_bar) + H d,

so each match in turn is a Kalman update of the belief about the pose, with

    S = H P H^T + Sigma + Rz R Rz^T,  K = P H^T S^-1,  x <- x - K nu,  P <- P - K H P,

and N(nu; 0, S) its factor of the weight. The gate (18) uses S in place of Z. The pose is then drawn
from the belief, and the landmarks are updated or created as seen from the drawn pose.
"""

import numpy as np

from multi_robot_slam.filter.kernels import (
    BLOCK,
    COS,
    DETERMINANT,
    DISTANCE,
    SIN,
    TAKEN,
    UNMATCHED,
    X,
    Y,
    copy,
    count_equal,
    create,
    fetch,
    inverted,
    put,
    replace,
    set_taken_aside,
    turned,
    update,
    weigh_new,
)
from multi_robot_slam.models.compiled import kernel

YAW, P_XX, P_XY, P_XT, P_YY, P_YT, P_TT = range(6, 13)
"""Rows of a block beside those of `kernels`: change of yaw so far, covariance of the pose."""

NO_GATE = 1e30
"""Lets every distance through: the match is already known."""


@kernel
def associate_and_believe(
    first, last, planes, candidates, poses, prior, observed, gate, exclusive, beliefs, matches
):
    """Match each observation to a landmark and update each particle's belief about the pose.

    Parameters
    ----------
    first, last : the particles to handle, multiples of BLOCK or the number of particles.
    poses : (4, M) cos yaw, sin yaw, x, y of the predicted pose x_bar.
    prior : (6, M) covariance xx xy xt yy yt tt of the predicted pose, in `map`.
    beliefs : (9, M), out: change of x, y, yaw against x_bar; covariance xx xy xt yy yt tt.
    matches : `kernels.Matches`, out: UNMATCHED where no landmark was found, else D (18) and |S|.
    Others as in `kernels.associate_and_update`; `planes` stay as they are. The arithmetic is done
    in the dtype of `prior`.
    """
    v, noise = observed
    starts, columns, _ = candidates
    matched, mahalanobis_sq, determinants = matches
    local = np.zeros((13, BLOCK), prior.dtype)
    found = np.empty(BLOCK, np.int32)
    for low in range(first, last, BLOCK):
        high = min(low + BLOCK, last)
        count = high - low
        load(poses[:, low:high], prior[:, low:high], local)
        for b in range(len(v)):
            found[:count] = UNMATCHED
            for i in range(starts[b], starts[b + 1]):
                column = columns[i]
                if column < 0:
                    continue
                if exclusive:
                    set_taken_aside(column, column, candidates, b, matched, low, count, found)
                believe(planes[column], low, high, column, local, found, v[b], noise[b], gate)
                if exclusive:
                    replace(found, count, TAKEN, UNMATCHED)
                if count_equal(found, count, UNMATCHED) == 0:
                    break
            copy(found[:count], matched[b, low:high])
            copy(local[DISTANCE, :count], mahalanobis_sq[b, low:high])
            copy(local[DETERMINANT, :count], determinants[b, low:high])
        subtract(local[X, :count], poses[2, low:high], beliefs[0, low:high])
        subtract(local[Y, :count], poses[3, low:high], beliefs[1, low:high])
        for row in range(YAW, P_TT + 1):
            copy(local[row, :count], beliefs[row - YAW + 2, low:high])


LEAST_SHARE = 2.0**-12
"""Of a prior's variance, what single precision may be asked to leave.

The inverse of S by cofactors errs by up to the 2^-24 of a float32 times the square of the ratio
between the variance that the pose's prior has at an observed point and the observation's least
own one. Up to 2^12 that is at most as much as D itself, and in a camera's directions far less.
"""


@kernel
def needs_double(prior, v, noise):
    """Some observation is so precise beside the prior that its update needs float64.

    Parameters
    ----------
    prior : (2,) largest variance of a position xx + yy [m^2] and of a yaw [rad^2].
    v, noise : (B, 3), (B, 6) observations and R in `base_link`, float64.
    """
    for b in range(len(v)):
        spread = prior[0] + (v[b, 0] * v[b, 0] + v[b, 1] * v[b, 1]) * prior[1]
        xx, xy, xz, yy, yz, zz, _ = inverted(
            1.0, noise[b, 0], noise[b, 1], noise[b, 2], noise[b, 3], noise[b, 4], noise[b, 5]
        )
        # The Frobenius norm of R^-1 is at least one over R's least eigenvalue.
        norm_sq = xx * xx + yy * yy + zz * zz + 2 * (xy * xy + xz * xz + yz * yz)
        if LEAST_SHARE * spread * np.sqrt(norm_sq) > 1:
            return True
    return False


@kernel
def subtract(a, b, difference):
    """Row a - row b."""
    for m in range(a.size):
        difference[m] = a[m] - b[m]


@kernel
def load(poses, prior, local):
    """Start a block's beliefs at the prediction."""
    for row in range(4):
        copy(poses[row], local[row])
    local[YAW] = 0
    for row in range(6):
        copy(prior[row], local[P_XX + row])


@kernel
def spread_in_map(poses, spread, prior):
    """Covariance (6, M) xx xy xt yy yt tt of the motion, into `prior`.

    Parameters
    ----------
    poses : (4, M) cos yaw, sin yaw, x, y of the predicted pose.
    spread : (4,) covariance xx xy yy of the motion and variance of its yaw, in the predicted body.
    """
    n_xx, n_xy, n_yy, yaw = spread[0], spread[1], spread[2], spread[3]
    for m in range(poses.shape[1]):
        c, s = poses[0, m], poses[1, m]
        cc, ss, cs = c * c, s * s, c * s
        prior[0, m] = cc * n_xx - (cs + cs) * n_xy + ss * n_yy
        prior[1, m] = cs * (n_xx - n_yy) + (cc - ss) * n_xy
        prior[2, m] = 0
        prior[3, m] = ss * n_xx + (cs + cs) * n_xy + cc * n_yy
        prior[4, m] = 0
        prior[5, m] = yaw


@kernel(inline="always")
def believe(landmark, low, high, column, local, found, v, noise, gate):
    """Update the beliefs of a block where `landmark` lies inside the gate and nothing else did."""
    mean_x, mean_y, mean_z = landmark[0, low:high], landmark[1, low:high], landmark[2, low:high]
    cov_xx, cov_xy, cov_xz = landmark[3, low:high], landmark[4, low:high], landmark[5, low:high]
    cov_yy, cov_yz, cov_zz = landmark[6, low:high], landmark[7, low:high], landmark[8, low:high]
    number = local.dtype.type
    one, half, sixth = number(1), number(1 / 2), number(1 / 6)
    twentieth, twelfth = number(1 / 20), number(1 / 12)
    index = np.int32(column)
    elements = noise[0], noise[1], noise[2], noise[3], noise[4], noise[5]
    r_zz = noise[5]
    for m in range(mean_x.size):
        c, s = local[COS, m], local[SIN, m]
        r_xx, r_xy, r_xz, r_yy, r_yz = turned(elements, c, s)

        w_x, w_y = c * v[0] - s * v[1], s * v[0] + c * v[1]
        nu_x = local[X, m] + w_x - mean_x[m]
        nu_y = local[Y, m] + w_y - mean_y[m]
        nu_z = v[2] - mean_z[m]
        p_xx, p_xy, p_xt = local[P_XX, m], local[P_XY, m], local[P_XT, m]
        p_yy, p_yt, p_tt = local[P_YY, m], local[P_YT, m], local[P_TT, m]
        a_xx, a_xy = p_xx - w_y * p_xt, p_xy + w_x * p_xt  # A = P H^T, H = [1 0 -w_y; 0 1 w_x; 0]
        a_yx, a_yy = p_xy - w_y * p_yt, p_yy + w_x * p_yt
        a_tx, a_ty = p_xt - w_y * p_tt, p_yt + w_x * p_tt
        s_xx = a_xx - w_y * a_tx + cov_xx[m] + r_xx
        s_xy = a_xy - w_y * a_ty + cov_xy[m] + r_xy
        s_yy = a_yy + w_x * a_ty + cov_yy[m] + r_yy
        s_xz, s_yz, s_zz = cov_xz[m] + r_xz, cov_yz[m] + r_yz, cov_zz[m] + r_zz

        i_xx, i_xy, i_xz, i_yy, i_yz, i_zz, det = inverted(one, s_xx, s_xy, s_xz, s_yy, s_yz, s_zz)
        e_x = i_xx * nu_x + i_xy * nu_y + i_xz * nu_z
        e_y = i_xy * nu_x + i_yy * nu_y + i_yz * nu_z
        e_z = i_xz * nu_x + i_yz * nu_y + i_zz * nu_z
        distance = nu_x * e_x + nu_y * e_y + nu_z * e_z  # (18) with S
        match = found[m]
        hit = (distance <= gate) & (distance > -one) & (det > 0) & (match == UNMATCHED)

        d_t = a_tx * e_x + a_ty * e_y
        x_new = local[X, m] - (a_xx * e_x + a_xy * e_y)
        y_new = local[Y, m] - (a_yx * e_x + a_yy * e_y)
        yaw_new = local[YAW, m] - d_t
        local[X, m] = x_new if hit else local[X, m]
        local[Y, m] = y_new if hit else local[Y, m]
        local[YAW, m] = yaw_new if hit else local[YAW, m]
        square = d_t * d_t
        cos_d = one - half * square * (one - twelfth * square)
        sin_d = d_t * (one - sixth * square * (one - twentieth * square))
        c_new, s_new = c * cos_d + s * sin_d, s * cos_d - c * sin_d
        local[COS, m] = c_new if hit else c
        local[SIN, m] = s_new if hit else s
        k_xx, k_xy = a_xx * i_xx + a_xy * i_xy, a_xx * i_xy + a_xy * i_yy
        k_yx, k_yy = a_yx * i_xx + a_yy * i_xy, a_yx * i_xy + a_yy * i_yy
        k_tx, k_ty = a_tx * i_xx + a_ty * i_xy, a_tx * i_xy + a_ty * i_yy
        xx_new, xy_new = p_xx - (k_xx * a_xx + k_xy * a_xy), p_xy - (k_xx * a_yx + k_xy * a_yy)
        xt_new, yy_new = p_xt - (k_xx * a_tx + k_xy * a_ty), p_yy - (k_yx * a_yx + k_yy * a_yy)
        yt_new, tt_new = p_yt - (k_yx * a_tx + k_yy * a_ty), p_tt - (k_tx * a_tx + k_ty * a_ty)
        local[P_XX, m] = xx_new if hit else p_xx
        local[P_XY, m] = xy_new if hit else p_xy
        local[P_XT, m] = xt_new if hit else p_xt
        local[P_YY, m] = yy_new if hit else p_yy
        local[P_YT, m] = yt_new if hit else p_yt
        local[P_TT, m] = tt_new if hit else p_tt
        local[DISTANCE, m] = distance if hit else local[DISTANCE, m]
        local[DETERMINANT, m] = det if hit else local[DETERMINANT, m]
        found[m] = index if hit else match


@kernel
def draw(poses, beliefs, normals):
    """Draw the new pose of every particle, in place.

    Parameters
    ----------
    poses : (3, M) float64, the predicted x_bar; out: the drawn pose.
    beliefs : (9, M) from `associate_and_believe`; normals : (3, M) standard normal.
    """
    for m in range(poses.shape[1]):
        l_xx = np.sqrt(max(beliefs[3, m], 0.0))
        inverse = 1 / l_xx if l_xx > 0 else 0.0
        l_yx, l_tx = beliefs[4, m] * inverse, beliefs[5, m] * inverse
        l_yy = np.sqrt(max(beliefs[6, m] - l_yx * l_yx, 0.0))
        inverse = 1 / l_yy if l_yy > 0 else 0.0
        l_ty = (beliefs[7, m] - l_tx * l_yx) * inverse
        l_tt = np.sqrt(max(beliefs[8, m] - l_tx * l_tx - l_ty * l_ty, 0.0))
        n_x, n_y, n_t = normals[0, m], normals[1, m], normals[2, m]
        poses[0, m] += beliefs[0, m] + l_xx * n_x
        poses[1, m] += beliefs[1, m] + l_yx * n_x + l_yy * n_y
        poses[2, m] += beliefs[2, m] + l_tx * n_x + l_ty * n_y + l_tt * n_t


@kernel
def update_matched(first, last, planes, candidates, new_columns, poses, observed, gate, matches):
    """Update the matched landmarks and create the new ones, as seen from the drawn poses.

    Parameters as in `kernels.associate_and_update`, `poses` being the drawn ones and `matches` what
    `associate_and_believe` found; where it found nothing they become those of the new landmark.
    """
    v, noise = observed
    starts, columns, _ = candidates
    matched, mahalanobis_sq, determinants = matches
    local = np.zeros((15, BLOCK), planes.dtype)
    found = np.empty(BLOCK, np.int32)
    for low in range(first, last, BLOCK):
        high = min(low + BLOCK, last)
        count = high - low
        for row in range(4):
            copy(poses[row, low:high], local[row])
        for b in range(len(v)):
            copy(matched[b, low:high], found)
            unmatched = count_equal(found, count, UNMATCHED)
            left = count - unmatched
            for i in range(starts[b], starts[b + 1]):
                if left == 0:
                    break
                column = columns[i]
                mine = count_equal(found, count, column)
                if mine > 0:
                    fetch(planes[column], low, count, local)
                    update(column, column, local, found, count, v[b], noise[b], NO_GATE)
                    put(planes[column], low, count, local)
                    left -= mine
            if unmatched > 0:
                copy(mahalanobis_sq[b, low:high], local[DISTANCE])
                copy(determinants[b, low:high], local[DETERMINANT])
                create(planes[new_columns[b]], low, high, local, found, v[b], noise[b])
                weigh_new(new_columns[b], local, found, count, noise[b], gate)
                copy(found[:count], matched[b, low:high])
                copy(local[DISTANCE, :count], mahalanobis_sq[b, low:high])
                copy(local[DETERMINANT, :count], determinants[b, low:high])
