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
    """Where least squares with the true associations sees each robot, at every `every`-th step.

    No filter can be expected to do better: poses as they were published compare with these as
    whole paths compare with the yardstick (`refinement.yardstick`).

    Parameters
    ----------
    lineage : any particle's past; the search only starts from it.
    truth : (robot, stamp_ns) -> (B,) true landmark of each observation, of all frames.
    every : steps from one such pose to the next.

    Returns
    -------
    Per robot a trajectory with one pose for each such step in which it has a frame.

    Raises
    ------
    SmoothingError
        A yardstick has no optimum.
    ValueError
        The truth of a frame is missing.

    """
    steps = [record.step for record, _ in lineage]
    stamps: dict[str, list[int]] = {name: [] for name in config.robots}
    rows: dict[str, list[np.ndarray]] = {name: [] for name in config.robots}
    for step in range(every, steps[-1] + 1, every):
        first, known = bisect_left(steps, step), bisect_right(steps, step)
        paths = _paths(lineage[:known], truth, config)
        for record, _ in lineage[first:known]:
            name = config.robots[record.robot]
            stamps[name].append(int(paths[name].stamps_ns[-1]))
            rows[name].append(paths[name].poses[-1])
    return {
        name: Trajectory(np.array(stamps[name], np.int64), np.array(rows[name]).reshape(-1, 3))
        for name in config.robots
    }


def last_poses(
    lineage: Lineage, truth: Mapping[tuple[str, int], np.ndarray], config: Config
) -> dict[str, np.ndarray]:
    """(3,) where the same least squares over all of the `lineage` sees each robot last."""
    return {name: path.poses[-1] for name, path in _paths(lineage, truth, config).items()}


def _paths(
    lineage: Lineage, truth: Mapping[tuple[str, int], np.ndarray], config: Config
) -> dict[str, Trajectory]:
    paths = yardstick(lineage, truth, config)
    if paths is None:
        raise ValueError(f"the true landmarks of a frame are missing, or all {len(lineage)} frames")
    return paths
