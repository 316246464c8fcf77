"""Bytes in, events out: the topics of a team, live or recorded."""

from collections.abc import Callable
from functools import partial

from msg_defs import topics, wire
from msg_defs.topics import Topic
from msg_defs.types import Event
from multi_robot_slam.config import Config

Decode = Callable[[bytes], Event]
"""CDR bytes -> event; `InputError` where they are damaged or mean nothing."""


def inputs(config: Config) -> dict[Topic, tuple[str, Decode]]:
    """Every topic the estimate needs: whose it is, and how its messages are decoded."""
    found: dict[Topic, tuple[str, Decode]] = {}
    for robot in config.robots:
        frame = config.camera_frame
        see = partial(wire.decode_observations, robot=robot, frame=frame)
        found[topics.odometry(robot)] = robot, partial(wire.decode_pose, robot=robot)
        found[topics.observations(robot)] = robot, see
        if config.sightings:
            sight = partial(wire.decode_sightings, robot=robot, frame=frame)
            found[topics.sightings(robot)] = robot, sight
    return found
