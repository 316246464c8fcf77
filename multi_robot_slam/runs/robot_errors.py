"""How far everything that claims to know where a robot was is from the truth."""

from typing import NamedTuple

import numpy as np

from msg_defs.types import Trajectory
from multi_robot_slam.runs.run import RobotRun, Run
from multi_robot_slam.runs.trajectory_errors import PoseErrors, at, covers, pose_errors, rotation


class RobotErrors(NamedTuple):
    """Errors of everything that claims to know where one robot was, live before hindsight.

    Figures (`evaluation.evaluate`) come in the order of these fields.
    """

    online: PoseErrors
    """Of the poses as published at each step."""
    online_mean: PoseErrors
    """Of the particles' means as published at each step."""
    path: PoseErrors
    """Of the best particle's whole path at the end."""
    odometry: PoseErrors
    """Of the odometry alone, composed onto the start pose."""
    mean: PoseErrors
    """Of the mean of all particles' whole paths at the end."""
    refined: PoseErrors
    """Of the path smoothed over the best particle's associations."""
    yardstick: PoseErrors
    """Of the best answer there is: the path smoothed over the true associations."""


def odometry_in_map(robot: RobotRun) -> Trajectory:
    """Odometry in `map`: T_map(t) = T_start T_odom(start)^-1 T_odom(t).

    Where the truth covers the path's first stamp, at which the filter begins, that is the start,
    and T_start the true pose. Else T_start is where the odometry's origin is configured to be.
    """
    stamps, poses = robot.odometry.stamps_ns, robot.odometry.poses
    if not len(stamps):
        return robot.odometry
    start_ns = (robot.path.stamps_ns if len(robot.path.stamps_ns) else stamps)[:1]
    start, origin = robot.start_pose, np.zeros(3)
    if robot.truth is not None and covers(robot.truth, start_ns).all():
        start, origin = at(robot.truth, start_ns)[0], at(robot.odometry, start_ns)[0]
    turn = start[2] - origin[2]
    places = start[:2] + (poses[:, :2] - origin[:2]) @ rotation(turn).T
    return Trajectory(stamps, np.column_stack([places, poses[:, 2] + turn]))


def robot_errors(run: Run) -> dict[str, RobotErrors]:
    """Errors of each robot whose truth is known, in the team's order."""
    return {
        name: RobotErrors(
            path=pose_errors(robot.path, robot.truth, f"path of {name}"),
            odometry=pose_errors(odometry_in_map(robot), robot.truth, f"odometry of {name}"),
            online=pose_errors(robot.online, robot.truth, f"published poses of {name}"),
            online_mean=pose_errors(robot.online_mean, robot.truth, f"published means of {name}"),
            mean=pose_errors(robot.mean, robot.truth, f"mean path of {name}"),
            refined=pose_errors(robot.refined, robot.truth, f"refined path of {name}"),
            yardstick=pose_errors(robot.yardstick, robot.truth, f"yardstick of {name}"),
        )
        for name, robot in run.robots.items()
        if robot.truth is not None
    }
