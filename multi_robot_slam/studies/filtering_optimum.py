"""The best answer while a run goes on: at an instant nothing later is known."""

from bisect import bisect_left, bisect_right
from collections.abc import Mapping

import numpy as np

from msg_defs.types import Trajectory
from multi_robot_slam.config import Config
from multi_robot_slam.pipeline.refinement import Lineage, yardstick


def poses(
    lineage: Lineage, truth: Mapping[tuple[str, int], np.ndarray], config: Config, every: int
) -> dict[str, Trajectory]:
    """Where least squares with the true associations sees each robot, at every so manieth step.

    What no filter can be expected to beat: its poses as published are to be compared with these,
    as its whole paths are with the yardstick (`refinement.yardstick`).

    Parameters
    ----------
    lineage : any particle's past; the search only starts from it.
    truth : (robot, stamp_ns) -> (B,) true landmark of each observation.

    """
    steps = [record.step for record, _ in lineage]
    found = {name: ([], []) for name in config.robots}
    for step in range(every, steps[-1] + 1, every):
        first, known = bisect_left(steps, step), bisect_right(steps, step)
        best = yardstick(lineage[:known], truth, config)
        for record, _ in lineage[first:known]:
            name = config.robots[record.robot]
            (stamps, rows), path = found[name], best[name]
            stamps.append(path.stamps_ns[-1])
            rows.append(path.poses[-1])
    return {
        name: Trajectory(np.array(stamps, np.int64), np.array(rows).reshape(-1, 3))
        for name, (stamps, rows) in found.items()
    }
