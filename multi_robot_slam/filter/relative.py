"""Where the particles expect landmarks, seen from a robot."""

import numpy as np

from multi_robot_slam.models.compiled import kernel


@kernel
def relative_moments(planes, columns, rows, poses, weights, absent, moments, shares):
    """Mean and covariance of landmarks in `base_link`, over particles and within them.

    Parameters
    ----------
    planes : (N, 9, M) of all landmarks.
    columns, rows : (P,), (P, m) the landmark, and where its planes are for each of m particles.
    poses : (4, m) cos yaw, sin yaw, x, y of the robot.
    weights : (m,) of the particles.
    absent : mean x from which on a particle does not have a landmark.
    moments : (P, 15), out: mean (3); covariance of the means (6); mean of the covariances (6).
    shares : (P,), out: weight of the particles that have the landmark.

    """
    local = np.empty((3, weights.size))
    has = np.empty(weights.size)
    for p in range(columns.size):
        plane = planes[columns[p]]
        moment = moments[p]
        moment[:] = 0
        total = 0.0
        for m in range(weights.size):
            row = rows[p, m]
            x = plane[0, row]
            has[m] = weights[m] if x < absent else 0.0
            if has[m] == 0:
                continue
            cos, sin = poses[0, m], poses[1, m]
            dx, dy = x - poses[2, m], plane[1, row] - poses[3, m]
            local[0, m] = cos * dx + sin * dy
            local[1, m] = cos * dy - sin * dx
            local[2, m] = plane[2, row]
            total += has[m]
            xx, xy, xz = plane[3, row], plane[4, row], plane[5, row]
            yy, yz, zz = plane[6, row], plane[7, row], plane[8, row]
            for i in range(3):
                moment[i] += has[m] * local[i, m]
            moment[9] += has[m] * (cos * cos * xx + 2 * cos * sin * xy + sin * sin * yy)
            moment[10] += has[m] * (cos * sin * (yy - xx) + (cos * cos - sin * sin) * xy)
            moment[11] += has[m] * (cos * xz + sin * yz)
            moment[12] += has[m] * (sin * sin * xx - 2 * cos * sin * xy + cos * cos * yy)
            moment[13] += has[m] * (cos * yz - sin * xz)
            moment[14] += has[m] * zz
        shares[p] = total
        if total == 0:
            continue
        moment /= total
        for m in range(weights.size):
            if has[m] == 0:
                continue
            w = has[m] / total
            x, y, z = local[0, m] - moment[0], local[1, m] - moment[1], local[2, m] - moment[2]
            moment[3] += w * x * x
            moment[4] += w * x * y
            moment[5] += w * x * z
            moment[6] += w * y * y
            moment[7] += w * y * z
            moment[8] += w * z * z
