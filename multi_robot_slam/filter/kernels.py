"""The compiled loops over particles: match, update and create landmarks, weigh.

Arithmetic runs in the dtype of the landmark planes (float32; float64 in tests). Particles are
handled in blocks: what a loop keeps per particle sits in one small local array of fixed row length,
so that it stays in the first-level cache and the compiler sees that rows do not overlap. The loops
choose between values instead of branching, and so become SIMD code. No rule of floating point is
relaxed: the same numbers come out however wide the SIMD registers are and whatever is inlined.

What is not a number never enters a landmark: an update that yields one counts as outside the gate.
"""

from typing import NamedTuple

import numpy as np
from numba import types
from numba.extending import overload

from multi_robot_slam.models.compiled import kernel
from multi_robot_slam.models.parallel import BLOCK

PLANES = 9
"""Numbers of a landmark per particle: mean x y z, covariance xx xy xz yy yz zz."""

FAR = 1e9
"""Mean x of a landmark that a particle does not have: finite, and outside any gate [m]."""

NO_LANDMARK = np.array([FAR, 0, 0, 1, 0, 0, 1, 0, 1])
"""Planes of a landmark that a particle does not have."""

LEAST_VOLUME = np.float32(2.0**-14)
"""Of |R| over the product of the variances: below it single precision has lost 14 of 24 bits."""

LEAST_VARIANCE, LARGEST_VARIANCE = 1e-12, 1e12
"""Of an observation [m^2]: a product of three is a number of single precision."""

LONG = 16
"""Particles in a row with one ancestor, on average, from which on they are filled, not gathered."""

UNMATCHED = -1
"""Match of an observation that has found no landmark yet."""

TAKEN = -2
"""The same, while a landmark is tried that an earlier observation of the frame has claimed."""

COS, SIN, X, Y, DISTANCE, DETERMINANT = range(6)
"""Rows of a block: pose of the robot, D (18) and |Z| (16) of the match."""

MEAN_X, MEAN_Y, MEAN_Z, COV_XX, COV_XY, COV_XZ, COV_YY, COV_YZ, COV_ZZ = range(6, 15)
"""Further rows of a block: the planes of the landmark at hand."""


class Observed(NamedTuple):
    """The observations of one frame, in `base_link`."""

    v: np.ndarray
    """(B, 3) [m]."""
    noise: np.ndarray
    """(B, 6): R of each [m^2]."""


class Matches(NamedTuple):
    """What each particle makes of each observation of a frame."""

    columns: np.ndarray
    """(B, M) int32: column of the landmark that is updated or created."""
    mahalanobis_sq: np.ndarray
    """(B, M): D (18) of the match; D_0 for a new landmark."""
    determinants: np.ndarray
    """(B, M): |Z| (16) of the match; |R| for a new landmark."""


@kernel
def associate_and_update(
    first, last, planes, candidates, new_columns, poses, observed, gate, exclusive, matches
):
    """Algorithm 1, lines 15-38, for one robot's frame and particles first .. last - 1.

    `complete_new` must follow when all particles are done.

    Parameters
    ----------
    first, last : multiples of BLOCK, or the number of particles.
    planes : (N, 9, M) landmarks, updated in place.
    candidates : `association.Candidates` of each observation.
    new_columns : (B,) column to create where no candidate lies inside the gate.
    poses : (4, M) cos yaw, sin yaw, x, y of the robot.
    observed : `Observed`.
    gate : D_0.
    exclusive : whether an observation may not claim what an earlier one of the frame has claimed.
    matches : `Matches`, out.
    """
    v, noise = observed
    starts, columns, _ = candidates
    matched, mahalanobis_sq, determinants = matches
    local = np.zeros((15, BLOCK), planes.dtype)
    found = np.empty(BLOCK, np.int32)
    is_new = np.empty(len(v), np.bool_)
    for low in range(first, last, BLOCK):
        high = min(low + BLOCK, last)
        count = high - low
        for row in range(4):
            copy(poses[row, low:high], local[row])
        for b in range(len(v)):
            found[:count] = UNMATCHED
            unmatched = count
            for i in range(starts[b], starts[b + 1]):
                column = columns[i]
                if column < 0:
                    if not is_new[-1 - column]:
                        continue
                    column = new_columns[-1 - column]
                if exclusive:
                    set_taken_aside(columns[i], column, candidates, b, matched, low, count, found)
                fetch(planes[column], low, count, local)
                update(UNMATCHED, column, local, found, count, v[b], noise[b], gate)
                if exclusive:
                    replace(found, count, TAKEN, UNMATCHED)
                before = unmatched
                unmatched = count_equal(found, count, UNMATCHED)
                if unmatched < before:
                    put(planes[column], low, count, local)
                if unmatched == 0:
                    break
            is_new[b] = unmatched > 0
            if is_new[b]:
                create(planes[new_columns[b]], low, high, local, found, v[b], noise[b])
                weigh_new(new_columns[b], local, found, count, noise[b], gate)
            copy(found[:count], matched[b, low:high])
            copy(local[DISTANCE, :count], mahalanobis_sq[b, low:high])
            copy(local[DETERMINANT, :count], determinants[b, low:high])


@kernel
def count_equal(found, count, value):
    """How many of the first `count` matches are `value`."""
    total = 0
    for m in range(count):
        total += np.int32(found[m] == value)
    return total


@kernel
def replace(found, count, old, new):
    """Replace `old` by `new` among the first `count` matches."""
    for m in range(count):
        if found[m] == old:
            found[m] = new


@kernel
def set_taken_aside(candidate, column, candidates, b, matched, low, count, found):
    """Mark as TAKEN where an observation before `b` has claimed `column`.

    Only those come into question that have `candidate` on their list, or create it.
    """
    starts, columns, _ = candidates
    for earlier in range(b):
        if candidate == -1 - earlier or candidate in columns[starts[earlier] : starts[earlier + 1]]:
            for m in range(count):
                if found[m] == UNMATCHED and matched[earlier, low + m] == column:
                    found[m] = TAKEN


@kernel
def copy(source, target):
    """Copy one row. A loop over whole rows is SIMD code, one with an offset or a slice is not."""
    for m in range(source.size):
        target[m] = source[m]


@kernel
def fetch(landmark, low, count, local):
    """Copy a block of a landmark's planes (9, M) to `local`."""
    for k in range(PLANES):
        copy(landmark[k, low : low + count], local[MEAN_X + k])


@kernel
def put(landmark, low, count, local):
    """Copy a block of a landmark's planes back."""
    for k in range(PLANES):
        copy(local[MEAN_X + k, :count], landmark[k, low : low + count])


@kernel(inline="always")
def turned(noise, c, s):
    """R_m = Rz R Rz^T (A1) of `noise` xx xy xz yy yz zz: xx xy xz yy yz; zz stays."""
    cc, ss, cs = c * c, s * s, c * s
    n_xx, n_xy, n_xz, n_yy, n_yz, _ = noise
    r_xx = cc * n_xx - (cs + cs) * n_xy + ss * n_yy
    r_xy = cs * (n_xx - n_yy) + (cc - ss) * n_xy
    r_xz = c * n_xz - s * n_yz
    r_yy = ss * n_xx + (cs + cs) * n_xy + cc * n_yy
    r_yz = s * n_xz + c * n_yz
    return r_xx, r_xy, r_xz, r_yy, r_yz


@kernel(inline="always")
def inverted(one, z_xx, z_xy, z_xz, z_yy, z_yz, z_zz):
    """Inverse xx xy xz yy yz zz of a symmetric matrix by its cofactors, and its determinant."""
    i_xx = z_yy * z_zz - z_yz * z_yz
    i_xy = z_xz * z_yz - z_xy * z_zz
    i_xz = z_xy * z_yz - z_xz * z_yy
    det = z_xx * i_xx + z_xy * i_xy + z_xz * i_xz
    scale = one / det
    i_yy = (z_xx * z_zz - z_xz * z_xz) * scale
    i_yz = (z_xy * z_xz - z_xx * z_yz) * scale
    i_zz = (z_xx * z_yy - z_xy * z_xy) * scale
    return i_xx * scale, i_xy * scale, i_xz * scale, i_yy, i_yz, i_zz, det


@kernel(inline="always")
def update(wanted, column, local, found, count, v, noise, gate):
    """Update the landmark at hand where the match is `wanted` and the gate lets it through.

    Kalman update (8)-(13) in the map frame, where G = I:  K = Sigma Z^-1,  mu += K nu,  and (13)
    as (I - K) Sigma = K (Z - Sigma) = K R, which loses no digits where R is small.

    Parameters
    ----------
    column : number of the landmark, written to `found`, the (BLOCK,) int32 match of each particle.
    local : (15, BLOCK) rows COS .. COV_ZZ.
    """
    number = local.dtype.type
    one = number(1)
    index = np.int32(column)
    elements = noise[0], noise[1], noise[2], noise[3], noise[4], noise[5]
    r_zz = noise[5]
    for m in range(count):
        c, s = local[COS, m], local[SIN, m]
        r_xx, r_xy, r_xz, r_yy, r_yz = turned(elements, c, s)

        x, y, z = local[MEAN_X, m], local[MEAN_Y, m], local[MEAN_Z, m]
        nu_x = local[X, m] + c * v[0] - s * v[1] - x  # (8), (12)
        nu_y = local[Y, m] + s * v[0] + c * v[1] - y
        nu_z = v[2] - z
        p_xx, p_xy, p_xz = local[COV_XX, m], local[COV_XY, m], local[COV_XZ, m]
        p_yy, p_yz, p_zz = local[COV_YY, m], local[COV_YZ, m], local[COV_ZZ, m]
        z_xx, z_xy, z_xz = p_xx + r_xx, p_xy + r_xy, p_xz + r_xz  # (10)
        z_yy, z_yz, z_zz = p_yy + r_yy, p_yz + r_yz, p_zz + r_zz

        i_xx, i_xy, i_xz, i_yy, i_yz, i_zz, det = inverted(one, z_xx, z_xy, z_xz, z_yy, z_yz, z_zz)

        w_x = i_xx * nu_x + i_xy * nu_y + i_xz * nu_z
        w_y = i_xy * nu_x + i_yy * nu_y + i_yz * nu_z
        w_z = i_xz * nu_x + i_yz * nu_y + i_zz * nu_z
        distance = nu_x * w_x + nu_y * w_y + nu_z * w_z  # (18)
        match = found[m]
        hit = (distance <= gate) & (distance > -one) & (det > 0) & (match == wanted)

        k_xx = p_xx * i_xx + p_xy * i_xy + p_xz * i_xz  # (11)
        k_xy = p_xx * i_xy + p_xy * i_yy + p_xz * i_yz
        k_xz = p_xx * i_xz + p_xy * i_yz + p_xz * i_zz
        k_yx = p_xy * i_xx + p_yy * i_xy + p_yz * i_xz
        k_yy = p_xy * i_xy + p_yy * i_yy + p_yz * i_yz
        k_yz = p_xy * i_xz + p_yy * i_yz + p_yz * i_zz
        k_zx = p_xz * i_xx + p_yz * i_xy + p_zz * i_xz
        k_zy = p_xz * i_xy + p_yz * i_yy + p_zz * i_yz
        k_zz = p_xz * i_xz + p_yz * i_yz + p_zz * i_zz

        x_new = x + (p_xx * w_x + p_xy * w_y + p_xz * w_z)  # (12)
        y_new = y + (p_xy * w_x + p_yy * w_y + p_yz * w_z)
        z_new = z + (p_xz * w_x + p_yz * w_y + p_zz * w_z)
        local[MEAN_X, m] = x_new if hit else x
        local[MEAN_Y, m] = y_new if hit else y
        local[MEAN_Z, m] = z_new if hit else z
        xx_new = k_xx * r_xx + k_xy * r_xy + k_xz * r_xz  # (13)
        xy_new = k_xx * r_xy + k_xy * r_yy + k_xz * r_yz
        xz_new = k_xx * r_xz + k_xy * r_yz + k_xz * r_zz
        yy_new = k_yx * r_xy + k_yy * r_yy + k_yz * r_yz
        yz_new = k_yx * r_xz + k_yy * r_yz + k_yz * r_zz
        zz_new = k_zx * r_xz + k_zy * r_yz + k_zz * r_zz
        local[COV_XX, m] = xx_new if hit else p_xx
        local[COV_XY, m] = xy_new if hit else p_xy
        local[COV_XZ, m] = xz_new if hit else p_xz
        local[COV_YY, m] = yy_new if hit else p_yy
        local[COV_YZ, m] = yz_new if hit else p_yz
        local[COV_ZZ, m] = zz_new if hit else p_zz
        local[DISTANCE, m] = distance if hit else local[DISTANCE, m]
        local[DETERMINANT, m] = det if hit else local[DETERMINANT, m]
        found[m] = index if hit else match


@kernel
def create(landmark, low, high, local, found, v, noise):
    """Create a landmark in the particles without a match: Algorithm 1, lines 30 and 31.

    The others of the block get one that is FAR away.
    """
    mean_x, mean_y, mean_z = landmark[0, low:high], landmark[1, low:high], landmark[2, low:high]
    cov_xx, cov_xy, cov_xz = landmark[3, low:high], landmark[4, low:high], landmark[5, low:high]
    cov_yy, cov_yz, cov_zz = landmark[6, low:high], landmark[7, low:high], landmark[8, low:high]
    number = local.dtype.type
    elements = noise[0], noise[1], noise[2], noise[3], noise[4], noise[5]
    for m in range(mean_x.size):
        c, s = local[COS, m], local[SIN, m]
        r_xx, r_xy, r_xz, r_yy, r_yz = turned(elements, c, s)  # (G^T R^-1 G)^-1
        away = number(np.int32(found[m] != UNMATCHED)) * number(FAR)
        mean_x[m] = local[X, m] + c * v[0] - s * v[1] + away  # g^-1(x, v)
        mean_y[m] = local[Y, m] + s * v[0] + c * v[1]
        mean_z[m] = v[2]
        cov_xx[m], cov_xy[m], cov_xz[m] = r_xx, r_xy, r_xz
        cov_yy[m], cov_yz[m], cov_zz[m] = r_yy, r_yz, elements[5]


@kernel
def complete_new(planes, new_columns, matched):
    """Count the particles (B,) int32 that created each column; take it from all other blocks."""
    particles = planes.shape[2]
    created = np.zeros(new_columns.size, np.int32)
    for b in range(new_columns.size):
        column = new_columns[b]
        created[b] = count_equal(matched[b], particles, column)
        if created[b] == 0:
            continue
        landmark = planes[column]
        for low in range(0, particles, BLOCK):
            high = min(low + BLOCK, particles)
            if count_equal(matched[b, low:high], high - low, column) == 0:
                for k in range(PLANES):
                    landmark[k, low:high] = NO_LANDMARK[k]
    return created


@kernel
def determinant(one, noise):
    """|R| of `noise` xx xy xz yy yz zz, in the precision of `one`."""
    xx, xy, xz = one * noise[0], one * noise[1], one * noise[2]
    yy, yz, zz = one * noise[3], one * noise[4], one * noise[5]
    return xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)


@kernel
def weigh_new(column, local, found, count, noise, gate):
    """Match the particles without a match to the new `column`; p_0 is the density on the gate."""
    det = determinant(local.dtype.type(1), noise)
    least = LEAST_VOLUME * noise[0] * noise[3] * noise[5]
    if not det > least:
        exact = determinant(1.0, noise)
        det = local.dtype.type(exact if exact > 0 else least)
    for m in range(count):
        if found[m] == UNMATCHED:
            found[m] = column
            local[DISTANCE, m] = gate
            local[DETERMINANT, m] = det


@kernel
def log_likelihood(mahalanobis_sq, determinants):
    """Sum over B observations of the logarithm of (16), up to its constant: (M,) float64.

    Determinants are multiplied in float64 and their logarithm taken every eighth observation.
    """
    count, particles = mahalanobis_sq.shape
    totals = np.zeros(particles)
    product = np.empty(BLOCK)
    for low in range(0, particles, BLOCK):
        high = min(low + BLOCK, particles)
        total = totals[low:high]
        product[:] = 1
        for b in range(count):
            distance, determinant = mahalanobis_sq[b, low:high], determinants[b, low:high]
            for m in range(total.size):
                total[m] -= 0.5 * distance[m]
                product[m] *= determinant[m]
            if b % 8 == 7 or b == count - 1:
                for m in range(total.size):
                    total[m] -= 0.5 * np.log(product[m])
                    product[m] = 1.0
    return totals


@kernel
def name(columns, candidates, new_columns, ids):
    """The ids of matched `columns` (B, M) and of `association.Candidates.columns` (C,).

    Parameters
    ----------
    new_columns : (B,) the column that each observation may create.
    ids : (N,) int32 of all columns.
    """
    names = np.empty(columns.shape, ids.dtype)
    for b in range(len(columns)):
        own, row = columns[b], names[b]
        for m in range(row.size):
            row[m] = ids[np.uint32(own[m])]
    candidate_names = np.empty(candidates.size, ids.dtype)
    for i in range(candidates.size):
        column = candidates[i]
        candidate_names[i] = ids[column if column >= 0 else new_columns[-1 - column]]
    return names, candidate_names


@kernel
def are_usable(v, noise, limit):
    """Whether observations v, noise (B, 3), (B, 6), float64, can be used without losing a number.

    They lie within `limit`, and each R is positive definite, with variances single precision holds.
    """
    for b in range(len(v)):
        for k in range(3):
            if not abs(v[b, k]) <= limit:
                return False
        least = min(noise[b, 0], noise[b, 3], noise[b, 5])
        largest = max(noise[b, 0], noise[b, 3], noise[b, 5])
        if not (least >= LEAST_VARIANCE and largest <= LARGEST_VARIANCE):
            return False
        area = noise[b, 0] * noise[b, 3] - noise[b, 1] * noise[b, 1]
        if not (area > 0 and determinant(1.0, noise[b]) > 0):
            return False
    return True


@kernel
def all_within(values, limit):
    """Whether all of `values` (n, M), float64, are numbers of size up to `limit`."""
    lost = np.int32(0)
    for row in range(values.shape[0]):
        for m in range(values.shape[1]):
            lost += np.int32(not abs(values[row, m]) <= limit)
    return lost == 0


@kernel
def gather(first, last, planes, columns, rows, generations):
    """Bring columns[first:last] up to date.

    In columns[i] particle m takes the place of particle rows[generations[i], m]. An unsigned index
    spares the compiler the test for a negative one, which would keep it from SIMD code. Rows
    ascend: where few ancestors are left, each has a long run of particles, which are filled.
    """
    particles = planes.shape[2]
    gathered = np.empty(particles, planes.dtype)
    begins = np.empty(particles // LONG + 2, np.int32)
    runs, of_generation = 0, -1
    for i in range(first, last):
        ancestors = rows[generations[i]]
        if generations[i] != of_generation:
            of_generation = generations[i]
            runs = find_runs(ancestors, begins)
        for k in range(PLANES):
            plane = planes[columns[i], k]
            if runs:
                fill(plane, ancestors, begins[: runs + 1], gathered)
            else:
                for m in range(gathered.size):
                    gathered[m] = plane[np.uint32(ancestors[m])]
                copy(gathered, plane)


@kernel
def find_runs(ancestors, begins):
    """Where each run of equal `ancestors` (M,) begins, and M, into `begins`; how many runs.

    0 where there are more than one in LONG particles.
    """
    runs = np.int32(1)
    for m in range(1, ancestors.size):
        runs += np.int32(ancestors[m] != ancestors[m - 1])
    if runs * LONG > ancestors.size:
        return 0
    begins[0] = 0
    found = 1
    for m in range(1, ancestors.size):
        begins[found] = m
        found += np.int32(ancestors[m] != ancestors[m - 1])
    begins[found] = ancestors.size
    return found


@kernel
def fill(plane, ancestors, begins, values):
    """Let each run of particles take the number its ancestor has in `plane`, in place."""
    for run in range(begins.size - 1):
        values[run] = plane[ancestors[begins[run]]]
    for run in range(begins.size - 1):
        plane[begins[run] : begins[run + 1]] = values[run]


@kernel
def compose(rows, used, ancestors):
    """Let rows[g, m] of every generation g in `used` follow particle m to its ancestor, in place.

    Ancestors ascend, so rows do too: one whose ends are equal is constant and stays as it is.
    """
    composed = np.empty(ancestors.size, np.int32)
    for g in used:
        row = rows[g]
        if row[0] == row[-1]:
            continue
        for m in range(composed.size):
            composed[m] = row[np.uint32(ancestors[m])]
        copy(composed, row)


@kernel
def count_owners(planes, columns, rows, generations):
    """How many of today's particles have each landmark: (C,) int64."""
    owners = np.zeros(columns.size, np.int64)
    limit = planes.dtype.type(0.5 * FAR)
    for i in range(columns.size):
        mean_x = planes[columns[i], 0]
        ancestors = rows[generations[i]]
        total = np.int32(0)
        for m in range(ancestors.size):
            total += np.int32(mean_x[np.uint32(ancestors[m])] < limit)
        owners[i] = total
    return owners


@kernel
def bound(planes, columns, reach, boxes):
    """Where an innovation of zero noise may lie in the gate: boxes[columns], for all particles.

    Inside the gate |nu_x| <= sqrt(D_0 Z_xx) <= sqrt(D_0 Sigma_xx) + sqrt(D_0 R_xx), and so for y.
    A box (x low, x high, y low, y high) holds every particle's mean +- `reach` sqrt(Sigma), with
    `reach` = sqrt(D_0). A landmark that some particle does not have has a box without end.
    """
    for column in columns:
        x_low, x_high = extremes(planes[column, 0])
        y_low, y_high = extremes(planes[column, 1])
        _, xx = extremes(planes[column, 3])
        _, yy = extremes(planes[column, 6])
        x_margin, y_margin = reach * np.sqrt(xx), reach * np.sqrt(yy)
        boxes[column, 0], boxes[column, 1] = x_low - x_margin, x_high + x_margin
        boxes[column, 2], boxes[column, 3] = y_low - y_margin, y_high + y_margin
        if x_high > 0.5 * FAR:
            boxes[column, 0], boxes[column, 1] = -FAR, FAR
            boxes[column, 2], boxes[column, 3] = -FAR, FAR


@kernel
def near(boxes, ids, box):
    """Columns whose box (N, 4) meets `box` (4,) and whose id is not negative, ascending."""
    found = np.empty(len(ids), np.int64)
    count = 0
    for column in range(len(ids)):
        x_low, x_high, y_low, y_high = boxes[column]
        meets = (x_low <= box[1]) & (x_high >= box[0]) & (y_low <= box[3]) & (y_high >= box[2])
        found[count] = column
        count += np.int64(meets & (ids[column] >= 0))
    return found[:count].copy()


@kernel
def extremes(row):
    """Least and greatest element of a contiguous `row`, float32 or float64, none of them NaN.

    Floats are compared as integers in the same order: which two come first makes no difference to
    those, so that the compiler may compare many at once.
    """
    bits = as_integers(row)
    low = high = in_order(bits[0])
    for m in range(1, bits.size):
        key = in_order(bits[m])
        low, high = min(low, key), max(high, key)
    ends = np.empty(2, row.dtype)
    found = as_integers(ends)
    found[0], found[1] = in_order(low), in_order(high)
    return ends[0], ends[1]


def as_integers(row):
    """The bits of floats as signed integers of the same size."""
    return row.view(np.int32 if row.dtype == np.float32 else np.int64)


@overload(as_integers)
def _as_integers(row):
    integer = np.int32 if row.dtype == types.float32 else np.int64
    return lambda row: row.view(integer)


def in_order(bits):
    """Integers in the order of the floats whose `bits` they are, and back."""
    integer = type(bits)
    return integer(bits ^ ((bits >> integer(8 * bits.itemsize - 1)) & np.iinfo(integer).max))


@overload(in_order, inline="always")
def _in_order(bits):
    integer = np.int32 if bits.bitwidth == 32 else np.int64
    sign, others = integer(bits.bitwidth - 1), np.iinfo(integer).max
    return lambda bits: integer(bits ^ (integer(bits >> sign) & integer(others)))


@kernel
def mix(planes, columns, rows, weights, result):
    """Mean and covariance (N, 9) of each of `columns` (N,) over the particles that have it.

    Row `rows` (N, M) of the column's planes belongs to each particle, with the `weights` (M,).
    """
    for n in range(len(columns)):
        own, mixed, total = planes[columns[n]], result[n], 0.0
        for m in range(rows.shape[1]):
            row = rows[n, m]
            if own[0, row] < 0.5 * FAR:
                total += weights[m]
                for k in range(PLANES):
                    mixed[k] += weights[m] * own[k, row]
        mixed /= total
        for m in range(rows.shape[1]):
            row = rows[n, m]
            if own[0, row] < 0.5 * FAR:
                share = weights[m] / total
                x, y, z = own[0, row] - mixed[0], own[1, row] - mixed[1], own[2, row] - mixed[2]
                mixed[3] += share * x * x
                mixed[4] += share * x * y
                mixed[5] += share * x * z
                mixed[6] += share * y * y
                mixed[7] += share * y * z
                mixed[8] += share * z * z
