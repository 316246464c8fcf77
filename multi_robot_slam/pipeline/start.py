"""Where a robot is at its first frame: the start that was told, and the way it has driven since.

Whatever was told of the start holds at the origin of the robot's odometry, or at its first message;
its first frame may come later, if the fusion begins late, or if frames were lost. Then (B1)

    mean = start (+) way,    covariance = J_start P_start J_start^T + J_way P_way J_way^T

The driver's own covariance is P_way where it can be one. Otherwise that is what (7) says of a
straight way between its ends (B2), the least that any way is worth: a robot that came back after a
long drive is less certain than that, and nothing but its driver knows.

Where all starts are measured alike, with P, and the first is taken for certain, as what `map` is
by, its error is the others': they are turned around it and shifted with it (B3)

    P_start = P + J P J^T,    J = [1 0 -(y - y_1); 0 1 x - x_1; 0 0 1]
"""

import numpy as np

from multi_robot_slam.config import Config
from multi_robot_slam.models.frames import Start
from multi_robot_slam.models.motion import composed, increment, least_covariance
from multi_robot_slam.pipeline.odometry import Odometry

LARGEST_VARIANCE_M2 = 1e4
"""A driver that is less certain of its place tells nothing: 100 m, where placeholders are 1e6."""

LARGEST_VARIANCE_RAD2 = np.pi**2 / 3
"""Of a heading that can be any."""


def start_of(robot: int, stamp_ns: int, odometry: Odometry, config: Config) -> Start:
    """What is believed of a robot, by its index in the team, at its first frame.

    Odometry must have reached `stamp_ns`. Where nothing is known the robot is at the origin, in a
    frame of its own.
    """
    if not config.are_known[robot]:
        return Start(np.zeros(3), np.zeros((3, 3)))
    pose = odometry.at(stamp_ns)
    first_ns, first = odometry.first
    is_known_at_origin = config.start_at == "odom"
    way = pose if is_known_at_origin else increment(first, pose)
    covariance = np.zeros((3, 3))
    if way.any():
        covariance = least_covariance(way, max(stamp_ns - first_ns, 0) / 1e9, config.filter.motion)
        drivers = odometry.covariance_at(stamp_ns) if is_known_at_origin else None
        if drivers is not None and _can_be(drivers, covariance):
            covariance = drivers
    told = config.starts[robot]
    return Start(*composed(told, start_covariance(robot, config), way, covariance))


def start_covariance(robot: int, config: Config) -> np.ndarray:
    """(3, 3): of the start pose that was told of the robot with this index."""
    metres, radians = config.start_sigma_of(robot)
    own = np.diag([metres**2, metres**2, radians**2])
    first = int(np.argmax(config.are_known))
    if robot == first or config.start_sigmas:
        return own
    apart = increment(config.starts[first], config.starts[robot])
    return composed(config.starts[first], own, apart, own)[1]


def _can_be(told: np.ndarray, least: np.ndarray) -> bool:
    """The driver's covariance (3, 3) is one, and not less than the `least` that the way is worth.

    Many drivers tell constants, which do not grow with the way.
    """
    if not np.isfinite(told).all() or not np.allclose(told, told.T):
        return False
    place, heading = told[0, 0] + told[1, 1], told[2, 2]
    is_enough = place >= least[0, 0] + least[1, 1] and heading >= least[2, 2]
    is_something = place <= LARGEST_VARIANCE_M2 and heading <= LARGEST_VARIANCE_RAD2
    return bool(is_enough and is_something and np.linalg.eigvalsh(told)[0] >= 0)
