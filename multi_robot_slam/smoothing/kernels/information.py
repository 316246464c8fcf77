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
    rows, _, _, origins, elements = system
    for link in range(len(ends)):
        jacobian = jacobians[link]
        for i in range(6):
            row = rows[ends[link, i // 3]] + i % 3
            for j in range(6):
                column = rows[ends[link, j // 3]] + j % 3
                if column <= row:
                    elements[origins[row] + column] += np.sum(jacobian[:, i] * jacobian[:, j])


@kernel
def add_prior(information, rows, system):
    """Add the information of anchors and centres (lower triangle), which have `rows` in H."""
    for i in range(len(rows)):
        for j in range(len(rows)):
            if rows[j] <= rows[i]:
                system.elements[system.origins[rows[i]] + rows[j]] += information[i, j]


@kernel
def add_observations(observations, views, landmarks, system):
    """Add the observations' part of H (lower triangle), landmarks that are no hubs eliminated."""
    starts, seen_from, _, information = observations
    rows, widths, hubs, origins, elements = system
    roots = np.empty((len(seen_from), 3, 3))
    own = np.empty((3, 3))
    for n in range(len(landmarks)):
        root = covariance_root(landmarks[n])
        for o in range(starts[n], starts[n + 1]):
            view, row, width = views[seen_from[o]], rows[seen_from[o]], widths[seen_from[o]]
            q_x, q_y = landmarks[n, 0] - view[0], landmarks[n, 1] - view[1]
            weighted_jacobian(information[o], view, q_x, q_y, own)
            for i in range(width):
                at = origins[row + i] + row
                elements[at] -= own[i, 0]
                if i >= 1:
                    elements[at + 1] -= own[i, 1]
                if i == 2:
                    elements[at + 2] += own[i, 0] * q_y - own[i, 1] * q_x
            if hubs[n] < 0:
                multiply(own, root, roots[o])
            else:
                add_hub_and_view(own, hubs[n], row, width, system)
        if hubs[n] >= 0:
            add_hub(landmarks[n], hubs[n], system)
        else:
            subtract_pairs(roots, starts[n], starts[n + 1], seen_from, system)


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
            system.elements[system.origins[high] + low] += own[i, j]


@kernel
def add_hub(landmark, row, system):
    """Add a hub's own information."""
    _, _, _, origins, elements = system
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
    for i in range(height):
        at = system.origins[row + i] + column
        for j in range(width):
            system.elements[at + j] -= a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]
