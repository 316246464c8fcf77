"""Bytes in, events out: the topics of a team, live or recorded."""

from collections.abc import Callable
from functools import partial

from msg_defs import topics, wire
from msg_defs.topics import Topic
from msg_defs.types import EncodedObservations, Event
from multi_robot_slam.config import Config

Decode = Callable[[bytes], Event]
"""CDR bytes -> event; `InputError` where they are damaged or mean nothing."""


def inputs(config: Config) -> dict[Topic, tuple[str, Decode]]:
    """Every topic the estimate needs: whose it is, and how its messages are decoded."""
    found: dict[Topic, tuple[str, Decode]] = {}
    for robot in config.robots:
        frame = config.camera_frame
        found[topics.odometry(robot)] = robot, partial(wire.decode_pose, robot=robot)
        found[topics.observations(robot)] = robot, partial(_observations, robot=robot, frame=frame)
        if config.sightings:
            sight = partial(wire.decode_sightings, robot=robot, frame=frame)
            found[topics.sightings(robot)] = robot, sight
    return found


def _observations(data: bytes, robot: str, frame: str) -> EncodedObservations:
    """A cloud of which the stamp alone is decoded yet: most never become keyframes."""
    stamp_ns = wire.peek_stamp(data, f"observations of {robot}")
    decode = partial(wire.decode_observations, data, robot, frame)
    return EncodedObservations(robot, stamp_ns, decode)
