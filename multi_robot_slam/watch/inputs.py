"""The topics that are watched: how each is decoded, and where it goes."""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

from msg_defs import topics, wire
from msg_defs.topics import Topic
from multi_robot_slam.watch.watched import Watched


class Input(NamedTuple):
    """What becomes of the messages on one topic."""

    decode: Callable[[bytes], Any]
    """`InputError` where a message is damaged."""
    take: Callable[[Watched, Any], None]
    is_whole: bool = False
    """Each message is all there is of its kind: of many, some will do."""


def team() -> dict[Topic, Input]:
    """What is watched of the team as a whole."""
    return {
        topics.DIAGNOSTICS: Input(
            lambda data: wire.decode_diagnostics(data)[1], Watched.take_diagnostics
        ),
        topics.GROUND_TRUTH_WALLS: Input(wire.decode_walls, Watched.take_walls),
        topics.MAP_LANDMARKS: Input(wire.decode_map, Watched.take_map, is_whole=True),
        topics.STEPS: Input(wire.decode_step, Watched.take_step),
    }


def of_robot(name: str) -> dict[Topic, Input]:
    """What is watched of one robot."""
    return {
        topics.path(name): Input(
            partial(wire.decode_path, robot=name), lambda w, own: w.take_path(name, own), True
        ),
        topics.pose(name): Input(partial(wire.decode_estimate, robot=name), Watched.take_pose),
        topics.particles(name): Input(
            partial(wire.decode_particles, robot=name),
            lambda w, own: w.take_particles(name, own),
            True,
        ),
        topics.preview_info(name): Input(
            partial(wire.decode_camera_info, what=f"preview of {name}"),
            lambda w, info: w.take_calibration(name, info),
        ),
        topics.preview(name): Input(
            partial(wire.decode_compressed, what=f"preview of {name}"),
            lambda w, picture: w.take_picture(name, picture),
            True,
        ),
    }


def inputs(robots: Iterable[str]) -> dict[Topic, Input]:
    """Everything that is watched of the team `robots`."""
    own = (item for name in robots for item in of_robot(name).items())
    return {**team(), **dict(own)}
