"""The compiled loops over particles: match, update and create landmarks, weigh.

Arithmetic runs in the dtype of the landmark planes (float32; float64 in tests). Particles are
handled in blocks: what a loop keeps per particle sits in one small local array of fixed row length,
so that it stays in the first-level cache and the compiler sees that rows do not overlap. The loops
have no branch, a mask multiplies instead, and so become SIMD code.
"""

import numpy as np
from numba import njit

BLOCK = 256
"""Particles handled together."""

PLANES = 9
"""Numbers of a landmark per particle: mean x y z, covariance xx xy xz yy yz zz."""

FAR = 1e9
"""Mean x of a landmark that a particle does not have: finite, and outside any gate [m]."""

UNMATCHED = -1
"""Match of an observation that has found no landmark yet."""

FLOAT_RULES = {"contract", "reassoc", "arcp", "nsz", "afn"}
"""What the compiler may reorder. NaN and infinity keep their meaning."""

COS, SIN, X, Y, SQUARED, DETERMINANT = range(6)
"""Rows of a block: pose of the robot, D (18) and |Z| (16) of the match."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FLOAT_RULES)
def associate_and_update(
    planes,
    starts,
    columns,
    new_columns,
    poses,
    v,
    noise,
    gate,
    matches,
    squared,
    determinants,
    created,
):
    """Algorithm 1, lines 15-38, for one robot's frame and every particle.

    Parameters
    ----------
    planes : (N, 9, M) landmarks, updated in place.
    starts, columns : candidates of each observation, see `association.Candidates`.
    new_columns : (B,) column to create where no candidate lies inside the gate.
    poses : (4, M) cos yaw, sin yaw, x, y of the robot.
    v, noise : (B, 3), (B, 6) observations and their covariance R in `base_link`.
    gate : D_0.
    matches : (B, M) int32, out: column that was updated or created.
    squared : (B, M), out: D (18) of the match; D_0 for a new landmark.
    determinants : (B, M), out: |Z| (16) of the match; |R| for a new landmark.
    created : (B,) int32, out: in how many particles observation b created its column.
    """
    created[:] = 0
    local = np.zeros((6, BLOCK), planes.dtype)
    found = np.empty(BLOCK, np.int32)
    is_new = np.empty(len(v), np.bool_)
    for low in range(0, planes.shape[2], BLOCK):
        high = min(low + BLOCK, planes.shape[2])
        count = high - low
        for row in range(4):
            for m in range(count):
                local[row, m] = poses[row, low + m]
        for b in range(len(v)):
            found[:count] = UNMATCHED
            unmatched = count
            for i in range(starts[b], starts[b + 1]):
                column = columns[i]
                if column < 0:
                    if not is_new[-1 - column]:
                        continue
                    column = new_columns[-1 - column]
                landmark = planes[column, :, low:high]
                update(landmark, UNMATCHED, column, local, found, v[b], noise[b], gate)
                unmatched = np.sum(found[:count] == UNMATCHED)
                if unmatched == 0:
                    break
            is_new[b] = unmatched > 0
            if is_new[b]:
                create(planes[new_columns[b], :, low:high], local, v[b], noise[b])
                weigh_new(new_columns[b], local, found, count, noise[b], gate)
                make_absent(planes[new_columns[b], :, low:high], found, new_columns[b])
            created[b] += unmatched
            for m in range(count):
                matches[b, low + m] = found[m]
                squared[b, low + m] = local[SQUARED, m]
                determinants[b, low + m] = local[DETERMINANT, m]
    for b in range(len(v)):  # also in the blocks that did not create it
        if created[b] > 0:
            make_absent(planes[new_columns[b]], matches[b], new_columns[b])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FLOAT_RULES)
def update(landmark, wanted, column, local, found, v, noise, gate):
    """Update one landmark in the particles whose match is `wanted` and that find it in the gate.

    Kalman update (8)-(13) in the map frame, where G = I:  K = Sigma Z^-1,  mu += K nu,  and (13)
    as (I - K) Sigma = K (Z - Sigma) = K R, which loses no digits where R is small.

    Parameters
    ----------
    landmark : (9, count) planes of the block; column : its number, written to `found`.
    local : (6, BLOCK) rows COS .. DETERMINANT; the last two are written where it is updated.
    found : (BLOCK,) int32 match of each particle.
    """
    mean_x, mean_y, mean_z = landmark[0], landmark[1], landmark[2]
    cov_xx, cov_xy, cov_xz = landmark[3], landmark[4], landmark[5]
    cov_yy, cov_yz, cov_zz = landmark[6], landmark[7], landmark[8]
    number = landmark.dtype.type
    one = number(1)
    index = np.int32(column)
    n_xx, n_xy, n_xz, n_yy, n_yz, r_zz = noise[0], noise[1], noise[2], noise[3], noise[4], noise[5]
    for m in range(landmark.shape[1]):
        c, s = local[COS, m], local[SIN, m]
        cc, ss, cs = c * c, s * s, c * s
        r_xx = cc * n_xx - (cs + cs) * n_xy + ss * n_yy
        r_xy = cs * (n_xx - n_yy) + (cc - ss) * n_xy
        r_xz = c * n_xz - s * n_yz
        r_yy = ss * n_xx + (cs + cs) * n_xy + cc * n_yy
        r_yz = s * n_xz + c * n_yz

        x, y, z = mean_x[m], mean_y[m], mean_z[m]
        nu_x = local[X, m] + c * v[0] - s * v[1] - x  # (8), (12)
        nu_y = local[Y, m] + s * v[0] + c * v[1] - y
        nu_z = v[2] - z
        p_xx, p_xy, p_xz = cov_xx[m], cov_xy[m], cov_xz[m]
        p_yy, p_yz, p_zz = cov_yy[m], cov_yz[m], cov_zz[m]
        z_xx, z_xy, z_xz = p_xx + r_xx, p_xy + r_xy, p_xz + r_xz  # (10)
        z_yy, z_yz, z_zz = p_yy + r_yy, p_yz + r_yz, p_zz + r_zz

        i_xx = z_yy * z_zz - z_yz * z_yz
        i_xy = z_xz * z_yz - z_xy * z_zz
        i_xz = z_xy * z_yz - z_xz * z_yy
        det = z_xx * i_xx + z_xy * i_xy + z_xz * i_xz
        scale = one / det
        i_xx, i_xy, i_xz = i_xx * scale, i_xy * scale, i_xz * scale
        i_yy = (z_xx * z_zz - z_xz * z_xz) * scale
        i_yz = (z_xy * z_xz - z_xx * z_yz) * scale
        i_zz = (z_xx * z_yy - z_xy * z_xy) * scale

        w_x = i_xx * nu_x + i_xy * nu_y + i_xz * nu_z
        w_y = i_xy * nu_x + i_yy * nu_y + i_yz * nu_z
        w_z = i_xz * nu_x + i_yz * nu_y + i_zz * nu_z
        distance = nu_x * w_x + nu_y * w_y + nu_z * w_z  # (18)
        match = found[m]
        hit = np.int32(distance <= gate) * np.int32(match == wanted)
        keep = number(hit)
        rest = one - keep

        k_xx = p_xx * i_xx + p_xy * i_xy + p_xz * i_xz  # (11)
        k_xy = p_xx * i_xy + p_xy * i_yy + p_xz * i_yz
        k_xz = p_xx * i_xz + p_xy * i_yz + p_xz * i_zz
        k_yx = p_xy * i_xx + p_yy * i_xy + p_yz * i_xz
        k_yy = p_xy * i_xy + p_yy * i_yy + p_yz * i_yz
        k_yz = p_xy * i_xz + p_yy * i_yz + p_yz * i_zz
        k_zx = p_xz * i_xx + p_yz * i_xy + p_zz * i_xz
        k_zy = p_xz * i_xy + p_yz * i_yy + p_zz * i_yz
        k_zz = p_xz * i_xz + p_yz * i_yz + p_zz * i_zz

        mean_x[m] = x + keep * (p_xx * w_x + p_xy * w_y + p_xz * w_z)  # (12)
        mean_y[m] = y + keep * (p_xy * w_x + p_yy * w_y + p_yz * w_z)
        mean_z[m] = z + keep * (p_xz * w_x + p_yz * w_y + p_zz * w_z)
        cov_xx[m] = rest * p_xx + keep * (k_xx * r_xx + k_xy * r_xy + k_xz * r_xz)  # (13)
        cov_xy[m] = rest * p_xy + keep * (k_xx * r_xy + k_xy * r_yy + k_xz * r_yz)
        cov_xz[m] = rest * p_xz + keep * (k_xx * r_xz + k_xy * r_yz + k_xz * r_zz)
        cov_yy[m] = rest * p_yy + keep * (k_yx * r_xy + k_yy * r_yy + k_yz * r_yz)
        cov_yz[m] = rest * p_yz + keep * (k_yx * r_xz + k_yy * r_yz + k_yz * r_zz)
        cov_zz[m] = rest * p_zz + keep * (k_zx * r_xz + k_zy * r_yz + k_zz * r_zz)
        local[SQUARED, m] = rest * local[SQUARED, m] + keep * distance
        local[DETERMINANT, m] = rest * local[DETERMINANT, m] + keep * det
        found[m] = match + hit * (index - match)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FLOAT_RULES)
def create(landmark, local, v, noise):
    """Create a landmark in every particle of a block: Algorithm 1, lines 30 and 31."""
    n_xx, n_xy, n_xz, n_yy, n_yz = noise[0], noise[1], noise[2], noise[3], noise[4]
    for m in range(landmark.shape[1]):
        c, s = local[COS, m], local[SIN, m]
        cc, ss, cs = c * c, s * s, c * s
        landmark[0, m] = local[X, m] + c * v[0] - s * v[1]  # g^-1(x, v)
        landmark[1, m] = local[Y, m] + s * v[0] + c * v[1]
        landmark[2, m] = v[2]
        landmark[3, m] = cc * n_xx - (cs + cs) * n_xy + ss * n_yy  # (G^T R^-1 G)^-1
        landmark[4, m] = cs * (n_xx - n_yy) + (cc - ss) * n_xy
        landmark[5, m] = c * n_xz - s * n_yz
        landmark[6, m] = ss * n_xx + (cs + cs) * n_xy + cc * n_yy
        landmark[7, m] = s * n_xz + c * n_yz
        landmark[8, m] = noise[5]


@njit(cache=True, nogil=True)
def make_absent(landmark, matches, column):
    """Take a new landmark away from the particles that did not match `column`."""
    for m in range(landmark.shape[1]):
        if matches[m] != column:
            landmark[:, m] = 0
            landmark[0, m] = FAR
            landmark[3, m] = landmark[6, m] = landmark[8, m] = 1


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FLOAT_RULES)
def weigh_new(column, local, found, count, noise, gate):
    """Match the particles without a match to the new `column`; p_0 is the density on the gate."""
    det = (
        noise[0] * (noise[3] * noise[5] - noise[4] * noise[4])
        - noise[1] * (noise[1] * noise[5] - noise[4] * noise[2])
        + noise[2] * (noise[1] * noise[4] - noise[3] * noise[2])
    )
    for m in range(count):
        if found[m] == UNMATCHED:
            found[m] = column
            local[SQUARED, m] = gate
            local[DETERMINANT, m] = det


@njit(cache=True, nogil=True, error_model="numpy", fastmath=FLOAT_RULES)
def log_likelihood(squared, determinants):
    """Sum over B observations of the logarithm of (16), up to its constant: (M,) float64.

    Determinants are multiplied in float64 and their logarithm taken every eighth observation.
    """
    count, particles = squared.shape
    total = np.zeros(particles)
    product = np.ones(particles)
    for b in range(count):
        for m in range(particles):
            total[m] -= 0.5 * squared[b, m]
            product[m] *= determinants[b, m]
        if b % 8 == 7 or b == count - 1:
            for m in range(particles):
                total[m] -= 0.5 * np.log(product[m])
                product[m] = 1.0
    return total


@njit(cache=True, nogil=True)
def gather(planes, columns, rows, generations):
    """Bring columns up to date: in columns[i], particle m takes row rows[generations[i], m]."""
    copy = np.empty(planes.shape[2], planes.dtype)
    for i in range(columns.size):
        ancestors = rows[generations[i]]
        for k in range(PLANES):
            plane = planes[columns[i], k]
            for m in range(copy.size):
                copy[m] = plane[ancestors[m]]
            plane[:] = copy


@njit(cache=True, nogil=True)
def compose(rows, used, ancestors):
    """Let rows[g, m] of every generation g in `used` follow particle m to its ancestor, in place.

    Ancestors ascend, so rows do too: one whose ends are equal is constant and stays as it is.
    """
    copy = np.empty(ancestors.size, np.int32)
    for g in used:
        row = rows[g]
        if row[0] == row[-1]:
            continue
        for m in range(copy.size):
            copy[m] = row[ancestors[m]]
        row[:] = copy


@njit(cache=True, nogil=True)
def count_owners(planes, columns, rows, generations):
    """How many of today's particles have each landmark: (C,) int64."""
    owners = np.zeros(columns.size, np.int64)
    for i in range(columns.size):
        mean_x = planes[columns[i], 0]
        ancestors = rows[generations[i]]
        for m in range(ancestors.size):
            owners[i] += mean_x[ancestors[m]] < 0.5 * FAR
    return owners
