"""The best answer while a run goes on: at an instant nothing later is known."""

from collections.abc import Mapping

import numpy as np

from msg_defs.types import Trajectory
from multi_robot_slam.config import Config
from multi_robot_slam.filter import smoothing
from multi_robot_slam.filter.motion import wrap
from multi_robot_slam.filter.smoothing_problem import problem_of
from multi_robot_slam.refinement import Lineage


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
    records = [record for record, _ in lineage]
    best = np.array([record.poses[:, row] for record, row in lineage])
    steps = np.array([record.step for record in records])
    identities = [truth[config.robots[record.robot], record.stamp_ns] for record in records]
    starts = np.array(config.start_poses)
    found = {name: ([], []) for name in config.robots}
    for step in range(every, int(steps.max()) + 1, every):
        known = int(np.count_nonzero(steps <= step))
        problem = problem_of(
            records[:known], identities[:known], starts, config.filter.motion, config.mount
        )
        best[:known] = smoothing.smooth(problem, best[:known]).poses
        for p in np.flatnonzero(steps == step):
            stamps, rows = found[config.robots[records[p].robot]]
            stamps.append(records[p].stamp_ns)
            rows.append([*best[p, :2], wrap(best[p, 2])])
    return {
        name: Trajectory(np.array(stamps, np.int64), np.array(rows).reshape(-1, 3))
        for name, (stamps, rows) in found.items()
    }
