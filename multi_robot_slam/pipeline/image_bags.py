"""The cameras in a bag: whose pictures were recorded, and the pairs to look at among them."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Literal

from msg_defs import topics, wire
from msg_defs.errors import InputError
from msg_defs.topics import Topic
from msg_defs.types import EncodedObservations, Event, ObservationSet, PoseSample
from multi_robot_slam.bags import BagReader, absolute
from multi_robot_slam.config import Config
from multi_robot_slam.front_end.settings import CameraSettings
from multi_robot_slam.front_end.sync import SIDES
from multi_robot_slam.pipeline.cameras import Camera, Look, image_topic
from multi_robot_slam.pipeline.sights import Sight, see

OnSight = Callable[[Look, Sight], None]


def with_images(reader: BagReader, config: Config, namespace: str) -> list[str]:
    """The robots of `config` of whom pictures of both sides were recorded."""
    counts, settings = reader.summary.counts, in_bag(reader, config, namespace).camera

    def is_there(robot: str) -> bool:
        sides = (image_topic(settings, robot, side) for side in SIDES)
        return all(counts.get(absolute(topic.name, namespace)) for topic in sides)

    return [robot for robot in config.robots if is_there(robot)]


def without_clouds(reader: BagReader, config: Config, namespace: str) -> list[str]:
    """Those of them whose observations were not recorded: their pictures are looked at."""
    counts = reader.summary.counts
    return [
        robot
        for robot in with_images(reader, config, namespace)
        if not counts.get(absolute(topics.observations(robot).name, namespace))
    ]


def in_bag(reader: BagReader, config: Config, namespace: str) -> Config:
    """`config` with the transport of the pictures that the bag has, where it has but the other."""
    names = {topic.name for topic in reader.summary.topics}
    is_raw = config.camera.image_transport == "raw"
    other: Literal["raw", "compressed"] = "compressed" if is_raw else "raw"

    def are_there(settings: CameraSettings) -> bool:
        found = (image_topic(settings, robot, side) for robot in config.robots for side in SIDES)
        return any(absolute(topic.name, namespace) in names for topic in found)

    changed = replace(config.camera, image_transport=other)
    is_changed = are_there(changed) and not are_there(config.camera)
    return replace(config, camera=changed) if is_changed else config


def nothing_in(reader: BagReader, config: Config, namespace: str) -> InputError:
    """The complaint that there are no pictures of the robots of `config`."""
    expected = (
        absolute(image_topic(config.camera, robot, side).name, namespace)
        for robot in config.robots
        for side in SIDES
    )
    return InputError(
        f"{reader.path} has no pictures: expected {', '.join(expected)}; its topics are "
        f"{reader.found()}; correct robots or camera.image, or record these topics"
    )


class Cameras:
    """The cameras of several robots, as they were recorded, with the odometry they need.

    Parameters
    ----------
    refuse : called for each message that is damaged, or picture without its other side.

    """

    def __init__(
        self, config: Config, robots: list[str], refuse: Callable[[InputError], None]
    ) -> None:
        self.robots = robots
        self._refuse = refuse
        self._cameras = {robot: Camera(config, robot, refuse) for robot in robots}
        self._of_topic = {
            topic: camera for camera in self._cameras.values() for topic in camera.inputs
        }
        self._odometry = {topics.odometry(robot): robot for robot in robots}

    @property
    def inputs(self) -> set[Topic]:
        """The topics of all pictures, calibrations and odometry."""
        return {*self.views, *self._odometry}

    @property
    def views(self) -> set[Topic]:
        """The topics of all pictures and calibrations."""
        return {*self._of_topic}

    @property
    def pictures(self) -> set[Topic]:
        """The topics of all pictures."""
        return {topic for topic in self._of_topic if not topic.type.endswith("CameraInfo")}

    def take(self, topic: Topic, data: bytes) -> list[Look]:
        """Take a message of one of `inputs`; the pairs that are due now."""
        robot = self._odometry.get(topic)
        if robot is None:
            return self._of_topic[topic].take(topic, data)
        try:
            return self.move(wire.decode_pose(data, robot))
        except InputError as error:
            self._refuse(error)
            return []

    def move(self, sample: PoseSample) -> list[Look]:
        """Take odometry of any robot; the pairs that are due now."""
        camera = self._cameras.get(sample.robot)
        return camera.move(sample) if camera else []

    def rest(self) -> Iterator[Look]:
        """Nothing more comes; the pairs that were not decided upon."""
        for camera in self._cameras.values():
            yield from camera.rest()


def frames(
    looks: Iterable[Look], config: Config, on_sight: OnSight, refuse: Callable[[InputError], None]
) -> Iterator[Event]:
    """Pairs as frames that are looked at when they are used; then `on_sight` is told.

    Where robots carry tags, all are looked at here: who is in view decides which frames are used.
    """
    for look in looks:
        if not config.camera.tags.on_robots:
            decode = partial(_decoded, look, config, on_sight)
            yield EncodedObservations(look.robot, look.pair.stamp_ns, decode)
            continue
        try:
            sight = see(look, config)
        except InputError as error:
            refuse(error)
            continue
        on_sight(look, sight)
        decode = partial(
            wire.decode_observations, sight.observations, look.robot, config.camera_frame
        )
        yield EncodedObservations(look.robot, look.pair.stamp_ns, decode)
        yield wire.decode_sightings(sight.sightings, look.robot, config.camera_frame)


def _decoded(look: Look, config: Config, on_sight: OnSight) -> ObservationSet:
    sight = see(look, config)
    on_sight(look, sight)
    # By way of the message, so that nothing differs from clouds that were sent or recorded.
    return wire.decode_observations(sight.observations, look.robot, config.camera_frame)
