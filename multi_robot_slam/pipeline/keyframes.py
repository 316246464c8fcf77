"""Which frames become steps: those of robots that have moved, or see one that has."""

import math
from collections.abc import Mapping

import numpy as np

from multi_robot_slam.config import Keyframe
from multi_robot_slam.models.motion import wrap


class Keyframes:
    """Remembers from where each robot had its last keyframe, and with it saw each other robot.

    Poses (3,) are of the odometry: x, y [m], yaw [rad], each robot's in a frame of its own.
    """

    def __init__(self, settings: Keyframe) -> None:
        self._settings = settings
        self._last: dict[int, np.ndarray] = {}
        self._sighted: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    def is_due(self, robot: int, pose: np.ndarray, others: Mapping[int, np.ndarray]) -> bool:
        """A frame of `robot` at `pose`, from where it sees `others` at theirs, is a keyframe.

        It is the robot's first, or the robot has moved since its last, or it or one that it sees
        has moved since its last keyframe with a sighting of that one.
        """
        if self._has_moved(self._last.get(robot), pose):
            return True
        for other, its_pose in others.items():
            own, its = self._sighted.get((robot, other), (None, None))
            if self._has_moved(own, pose) or self._has_moved(its, its_pose):
                return True
        return False

    def use(self, robot: int, pose: np.ndarray, others: Mapping[int, np.ndarray]) -> None:
        """The frame was used."""
        self._last[robot] = pose
        for other, its_pose in others.items():
            self._sighted[robot, other] = pose, its_pose

    def _has_moved(self, since: np.ndarray | None, pose: np.ndarray) -> bool:
        """A keyframe's way from one pose to the other; always, if there was none before."""
        if since is None:
            return True
        dx, dy, turn = (pose - since).tolist()
        if math.hypot(dx, dy) >= self._settings.distance_m:
            return True
        return bool(np.abs(wrap(turn)) >= self._settings.yaw_rad)
