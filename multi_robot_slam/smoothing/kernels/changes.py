"""The compiled pass over all observations: how their residuals change with poses and centres.

`observations` are `problem.Observations`, `views` (V, 3) poses, then centres with yaw 0.
"""

import numpy as np

from multi_robot_slam.models.compiled import kernel
from multi_robot_slam.smoothing.kernels.landmarks import turned


@kernel
def observation_changes(observations, views, landmarks, robots, moves, changes, mixed):
    """Whitened changes (O, 3, M) of e_o to first order, landmarks following at their best.

    `moves` (V, 3, M) of the views, in whose precision it is computed. With the upper root
    U^T U = W of each observation's information in `map` a change is U e, e = J dx + dl,
    dl = -Lambda^-1 sum W J dx. `mixed` (K, K): the mean over M of sum_n g_i^T Lambda^-1 g_j,
    g_i = sum W e of the observations of robot i, by `robots` (O,), -1: of none.
    """
    starts, seen_from, _, information = observations
    draws, single = moves.shape[2], moves.dtype.type
    pull, spread = np.empty((3, draws), moves.dtype), np.empty((3, draws), moves.dtype)
    of_robots = np.zeros((len(mixed), 3, draws), moves.dtype)
    sees = np.zeros(len(mixed), np.bool_)
    mixed[:] = 0
    for n in range(len(landmarks)):
        pull[:] = 0
        for o in range(starts[n], starts[n + 1]):
            view, move, change = views[seen_from[o]], moves[seen_from[o]], changes[o]
            xx, xy, xz, yy, yz = turned(information[o], np.cos(view[2]), np.sin(view[2]))
            xx, xy, xz, yy, yz = single(xx), single(xy), single(xz), single(yy), single(yz)
            q_x, q_y = single(landmarks[n, 0] - view[0]), single(landmarks[n, 1] - view[1])
            for m in range(draws):
                x, y = q_y * move[2, m] - move[0, m], -q_x * move[2, m] - move[1, m]
                change[0, m], change[1, m] = x, y
                pull[0, m] -= xx * x + xy * y
                pull[1, m] -= xy * x + yy * y
                pull[2, m] -= xz * x + yz * y
        spread_by(landmarks[n], pull, spread)
        for o in range(starts[n], starts[n + 1]):
            change, own = changes[o], of_robots[robots[o]]
            if robots[o] >= 0 and not sees[robots[o]]:
                sees[robots[o]] = True
                own[:] = 0
            yaw = views[seen_from[o], 2]
            xx, xy, xz, yy, yz = turned(information[o], np.cos(yaw), np.sin(yaw))
            zz = information[o, 5]
            u_xx = np.sqrt(xx)
            u_xy, u_xz = over(xy, u_xx), over(xz, u_xx)
            u_yy = np.sqrt(max(yy - u_xy * u_xy, 0.0))
            u_yz = over(yz - u_xy * u_xz, u_yy)
            u_zz = np.sqrt(max(zz - u_xz * u_xz - u_yz * u_yz, 0.0))
            xx, xy, xz, yy, yz = single(xx), single(xy), single(xz), single(yy), single(yz)
            u_xx, u_xy, u_xz = single(u_xx), single(u_xy), single(u_xz)
            u_yy, u_yz, u_zz, zz = single(u_yy), single(u_yz), single(u_zz), single(zz)
            for m in range(draws):
                x, y, z = change[0, m] + spread[0, m], change[1, m] + spread[1, m], spread[2, m]
                change[0, m] = u_xx * x + u_xy * y + u_xz * z
                change[1, m] = u_yy * y + u_yz * z
                change[2, m] = u_zz * z
                if robots[o] >= 0:
                    own[0, m] += xx * x + xy * y + xz * z
                    own[1, m] += xy * x + yy * y + yz * z
                    own[2, m] += xz * x + yz * y + zz * z
        for i in range(len(mixed)):
            if not sees[i]:
                continue
            spread_by(landmarks[n], of_robots[i], spread)
            for j in range(i):
                if sees[j]:
                    mixed[i, j] += np.sum(spread * of_robots[j]) / draws
                    mixed[j, i] = mixed[i, j]
        sees[:] = False


@kernel
def over(a, b):
    """Quotient a / b; the information of a gross error, a and b alike, may be zero."""
    return a / b if b > 0 else 0.0


@kernel
def spread_by(landmark, pull, result):
    """Lambda^-1 `pull` (3, M) -> `result`, of a landmark (9,)."""
    single = pull.dtype.type
    xx, xy, xz = single(landmark[3]), single(landmark[4]), single(landmark[5])
    yy, yz, zz = single(landmark[6]), single(landmark[7]), single(landmark[8])
    for m in range(pull.shape[1]):
        x, y, z = pull[0, m], pull[1, m], pull[2, m]
        result[0, m] = xx * x + xy * y + xz * z
        result[1, m] = xy * x + yy * y + yz * z
        result[2, m] = xz * x + yz * y + zz * z


@kernel
def information_in_map(observations, views):
    """(O, 6) W = Rz R^-1 Rz^T of each observation."""
    _, seen_from, _, information = observations
    result = np.empty_like(information)
    for o in range(len(information)):
        yaw = views[seen_from[o], 2]
        xx, xy, xz, yy, yz = turned(information[o], np.cos(yaw), np.sin(yaw))
        result[o, 0], result[o, 1], result[o, 2] = xx, xy, xz
        result[o, 3], result[o, 4], result[o, 5] = yy, yz, information[o, 5]
    return result
