"""A long path as few poses, for whoever looks at it while the run goes on."""

import numpy as np

from msg_defs.types import Trajectory

MOST_POSES = 4000
"""Of a path that is published every second: a message of 288 kB, made in 2 ms."""


def thinned(path: Trajectory, most: int = MOST_POSES) -> Trajectory:
    """At most so many poses of a path, at least 4: the newer half all, of the older every 2^k-th.

    The first and the last are among them. Which older ones remain depends on their place in the
    path alone, so they stay the same until k grows.
    """
    count = len(path.stamps_ns)
    if count <= most:
        return path
    newest = count - most // 2
    room = most - most // 2
    step = 1
    while -(-newest // step) > room:
        step *= 2
    rows = np.concatenate([np.arange(0, newest, step), np.arange(newest, count)])
    return Trajectory(path.stamps_ns[rows], path.poses[rows])
