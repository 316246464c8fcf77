"""The compiled sums of the information matrix H of the poses and hubs.

`system` is a `linearised.System`, `links` are `linearised.Links`.
"""

import numpy as np

from multi_robot_slam.models.compiled import kernel
from multi_robot_slam.models.symmetric import inverse
from multi_robot_slam.smoothing.kernels.landmarks import covariance_root, weighted_jacobian


@kernel
def address(system, row, column):
    """The element of H, at most on the diagonal."""
    return system.origins[row] + column * system.heights[row]


@kernel
def add_links(links, system):
    """Add J^T J (lower triangle) of the links."""
    ends, _, jacobians = links
    rows = system.rows
    for link in range(len(ends)):
        jacobian = jacobians[link]
        for i in range(6):
            row = rows[ends[link, i // 3]] + i % 3
            for j in range(6):
                column = rows[ends[link, j // 3]] + j % 3
                if column <= row:
                    value = np.sum(jacobian[:, i] * jacobian[:, j])
                    system.elements[address(system, row, column)] += value


@kernel
def add_prior(information, rows, system):
    """Add the information of anchors and centres (lower triangle), which have `rows` in H."""
    for i in range(len(rows)):
        for j in range(len(rows)):
            if rows[j] <= rows[i]:
                system.elements[address(system, rows[i], rows[j])] += information[i, j]


@kernel
def add_observations(observations, views, landmarks, system):
    """Add the observations' part of H (lower triangle), landmarks that are no hubs eliminated."""
    starts, seen_from, _, information = observations
    rows, widths, hubs = system.rows, system.widths, system.hubs
    roots = np.empty((len(seen_from), 3, 3))
    own = np.empty((3, 3))
    for n in range(len(landmarks)):
        root = covariance_root(landmarks[n])
        for o in range(starts[n], starts[n + 1]):
            view, row, width = views[seen_from[o]], rows[seen_from[o]], widths[seen_from[o]]
            q_x, q_y = landmarks[n, 0] - view[0], landmarks[n, 1] - view[1]
            weighted_jacobian(information[o], view, q_x, q_y, own)
            add_view(own, q_x, q_y, row, width, system)
            if hubs[n] < 0:
                multiply(own, root, roots[o])
            else:
                add_hub_and_view(own, hubs[n], row, width, system)
        if hubs[n] >= 0:
            add_hub(landmarks[n], hubs[n], system)
        else:
            subtract_pairs(roots, starts[n], starts[n + 1], seen_from, system)


@kernel
def add_view(own, q_x, q_y, row, width, system):
    """Add J^T W J of one view, whose J^T W is `own`."""
    for i in range(width):
        system.elements[address(system, row + i, row)] -= own[i, 0]
        if i >= 1:
            system.elements[address(system, row + i, row + 1)] -= own[i, 1]
        if i == 2:
            turned = own[i, 0] * q_y - own[i, 1] * q_x
            system.elements[address(system, row + i, row + 2)] += turned


@kernel
def multiply(a, lower, result):
    """A (3, 3) times a lower triangle."""
    for i in range(3):
        for j in range(3):
            result[i, j] = 0
            for k in range(j, 3):
                result[i, j] += a[i, k] * lower[k, j]


@kernel
def add_hub_and_view(own, hub, row, width, system):
    """Add own (3, 3), of a view's `width` rows and a hub, to their block of the lower triangle."""
    for i in range(width):
        for j in range(3):
            high, low = max(row + i, hub + j), min(row + i, hub + j)
            system.elements[address(system, high, low)] += own[i, j]


@kernel
def add_hub(landmark, row, system):
    """Add a hub's own information."""
    (xx, xy, xz, yy, yz, zz), _ = inverse(
        landmark[3], landmark[4], landmark[5], landmark[6], landmark[7], landmark[8]
    )
    system.elements[address(system, row, row)] += xx
    system.elements[address(system, row + 1, row)] += xy
    system.elements[address(system, row + 1, row + 1)] += yy
    system.elements[address(system, row + 2, row)] += xz
    system.elements[address(system, row + 2, row + 1)] += yz
    system.elements[address(system, row + 2, row + 2)] += zz


@kernel
def subtract_pairs(roots, first, last, seen_from, system):
    """Eliminate a landmark: subtract the product of the `roots` of any two of its observations."""
    rows, widths = system.rows, system.widths
    for o in range(first, last):
        for other in range(first, o + 1):
            one, two = seen_from[o], seen_from[other]
            a, b = roots[o], roots[other]
            if rows[one] < rows[two]:
                one, two, a, b = two, one, b, a
            subtract_product(a, b, rows[one], widths[one], rows[two], widths[two], system)
            if one == two and other < o:
                subtract_product(b, a, rows[one], widths[one], rows[one], widths[one], system)


@kernel
def subtract_product(a, b, row, height, column, width, system):
    """Subtract a b^T from the block of H (height, width) at `row`, `column`."""
    for j in range(width):
        at = address(system, row, column + j)
        for i in range(height):
            system.elements[at + i] -= a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]
