"""The compiled sums of the information matrix H of the poses and hubs.

`system` is a `linearised.System`, `links` are `linearised.Links`.
"""

import numpy as np

from multi_robot_slam.models.compiled import kernel
from multi_robot_slam.models.symmetric import inverse
from multi_robot_slam.smoothing.kernels.landmarks import covariance_root, weighted_jacobian


@kernel
def add_links(links, system):
    """Add J^T J (lower triangle) of the links."""
    ends, _, jacobians = links
    rows, _, origins, elements = system
    for link in range(len(ends)):
        jacobian = jacobians[link]
        for i in range(0 if ends[link, 0] >= 0 else 3, 6):
            row = rows[ends[link, i // 3]] + i % 3
            for j in range(0 if ends[link, 0] >= 0 else 3, 6):
                column = rows[ends[link, j // 3]] + j % 3
                if column <= row:
                    elements[origins[row] + column] += np.sum(jacobian[:, i] * jacobian[:, j])


@kernel
def add_observations(observations, poses, landmarks, system):
    """Add the observations' part of H (lower triangle), landmarks that are no hubs eliminated."""
    starts, seen_from, _, information = observations
    rows, hubs, origins, elements = system
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
            weighted_jacobian(information[o], pose, q_x, q_y, own)
            for i in range(3):
                at = origins[row + i] + row
                elements[at] -= own[i, 0]
                elements[at + 1] -= own[i, 1]
                elements[at + 2] += own[i, 0] * q_y - own[i, 1] * q_x
            if hubs[n] >= 0:
                add_transposed(own, hubs[n], row, system)
            else:
                multiply(own, root, roots[o])
        if hubs[n] >= 0:
            add_hub(landmarks[n], hubs[n], system)
        else:
            subtract_pairs(roots, first, starts[n + 1], seen_from, system)


@kernel
def multiply(a, lower, result):
    """A (3, 3) times a lower triangle."""
    for i in range(3):
        for j in range(3):
            result[i, j] = 0
            for k in range(j, 3):
                result[i, j] += a[i, k] * lower[k, j]


@kernel
def add_transposed(own, row, column, system):
    """Add own^T (3, 3) to the block of H at `row`, `column`."""
    for i in range(3):
        for j in range(3):
            system.elements[system.origins[row + i] + column + j] += own[j, i]


@kernel
def add_hub(landmark, row, system):
    """Add a hub's own information."""
    _, _, origins, elements = system
    (xx, xy, xz, yy, yz, zz), _ = inverse(
        landmark[3], landmark[4], landmark[5], landmark[6], landmark[7], landmark[8]
    )
    elements[origins[row] + row] += xx
    elements[origins[row + 1] + row] += xy
    elements[origins[row + 1] + row + 1] += yy
    elements[origins[row + 2] + row] += xz
    elements[origins[row + 2] + row + 1] += yz
    elements[origins[row + 2] + row + 2] += zz


@kernel
def subtract_pairs(roots, first, last, seen_from, system):
    """Eliminate a landmark: subtract the product of the `roots` of any two of its observations."""
    for o in range(first, last):
        for other in range(first, o + 1):
            row, column = system.rows[seen_from[o]], system.rows[seen_from[other]]
            if row < column:
                subtract_product(roots[other], roots[o], column, row, system)
            else:
                subtract_product(roots[o], roots[other], row, column, system)
            if row == column and other < o:
                subtract_product(roots[other], roots[o], row, row, system)


@kernel
def subtract_product(a, b, row, column, system):
    """Subtract a b^T (3, 3) from the block of H at `row`, `column`."""
    for i in range(3):
        at = system.origins[row + i] + column
        for j in range(3):
            system.elements[at + j] -= a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]
