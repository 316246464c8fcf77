"""ROS: pictures of stereo cameras in, observations of landmarks out."""

import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt

from msg_defs import topics, wire
from msg_defs.errors import InputError
from msg_defs.ros import environment
from msg_defs.ros.endpoints import Audience, publisher, subscribe
from msg_defs.ros.parameters import declare
from msg_defs.ros.spin import SPIN_TIMEOUT_S, EdgeNode, spin
from msg_defs.ros.usage import Usage
from msg_defs.topics import Topic
from msg_defs.types import settings
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.front_end.front_end import FrontEnd
from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.nodes.camera_health import CameraHealth
from multi_robot_slam.nodes.silence import Silence
from multi_robot_slam.pipeline.cameras import Camera, Look
from multi_robot_slam.pipeline.sights import Sight, see

DIAGNOSTICS_PERIOD_S = 1.0
POLL_S = 0.005


@settings
class Looking:
    """What the node does with the pictures."""

    only: Annotated[str, "look at the pictures of this robot alone; empty is all"] = ""
    silent_s: Annotated[float, Gt(0), "silence after which a camera is reported [s]"] = 5.0
    unheard_s: Annotated[
        float, Gt(0), "time after which an expected topic that was never heard is reported [s]"
    ] = 10.0
    subscribers: Annotated[
        int, Ge(0), "subscribers to wait for on each stereo/landmarks topic before looking"
    ] = 0


USAGE = Usage(
    "multi_robot_slam camera",
    "Publish what stereo cameras see: <robot>/stereo/landmarks for the fusion, of the pictures on "
    "<robot>/left/image_rect and <robot>/right/image_rect and the camera_info beside them.",
    (Config, Looking),
    SECTION,
)


class CameraNode(EdgeNode):
    """Pairs pictures, looks at one pair at a time beside the node, publishes what it shows.

    Of each robot the newest pair waits, no more: what comes faster than it can be looked at is
    dropped and counted, and nothing lags. With `<robot>/odom` pairs are looked at that the fusion
    may make a keyframe of (`DuePairs`), else all.
    """

    def __init__(self) -> None:
        super().__init__("camera")
        config, looking = declare(self, *USAGE.classes, section=USAGE.section)
        self._config = config
        robots = _chosen(config, looking.only)
        self._waiting: dict[str, Look] = {}
        self._job: tuple[Look, Future[tuple[Sight, float]]] | None = None
        self._health: dict[str, CameraHealth] = {}
        self.get_logger().info("loading the front end, which is compiled the first time")
        _warm_up(config)
        self._cameras = {robot: self._camera(robot, looking.silent_s) for robot in robots}
        self._outputs = {
            topic: publisher(self, topic) for robot in robots for topic in _outputs(config, robot)
        }
        clouds = (self._outputs[topics.observations(robot)] for robot in robots)
        self._audience = Audience(self, [(cloud, looking.subscribers) for cloud in clouds])
        self._diagnostics = publisher(self, topics.DIAGNOSTICS)
        self._names = {
            robot: [self._listen(topic, robot) for topic in self._cameras[robot].inputs]
            for robot in robots
        }
        for robot in robots:
            self._follow_odometry(robot)
        heard = [topic for names in self._names.values() for topic in names]
        self._silence = Silence(heard, looking.unheard_s)
        self._worker = ThreadPoolExecutor(1, "front end")
        self.every(DIAGNOSTICS_PERIOD_S, self._publish_diagnostics)
        self.get_logger().info(f"ready for {', '.join(robots)}; {environment.reach()}")

    def work(self) -> float:
        """Publish what was seen, and begin to look at the pair that waits longest."""
        if self._job and self._job[1].done():
            self._publish(*self._job)
            self._job = None
        if self._job is None and self._waiting and not self._audience.is_missing():
            robot = next(iter(self._waiting))
            look = self._waiting.pop(robot)
            self._job = look, self._worker.submit(_timed, look, self._config)
        return POLL_S if self._job else SPIN_TIMEOUT_S

    def close(self) -> None:
        """Finish the pair that is looked at."""
        if self._job:
            self._publish(*self._job)
        self._worker.shutdown(cancel_futures=True)
        self._publish_diagnostics()

    def _camera(self, robot: str, silent_s: float) -> Camera:
        camera = Camera(self._config, robot, lambda error: self._health[robot].refuse(error))
        self._health[robot] = CameraHealth(camera, silent_s)
        return camera

    def _listen(self, topic: Topic, robot: str) -> Topic:
        """Take pictures or calibrations of `robot`; the topic with its whole name."""
        camera, health = self._cameras[robot], self._health[robot]

        def take(data: bytes) -> None:
            self._silence.hear(reader.topic_name)
            changes = camera.calibration.changes
            self._await(camera.take(topic, data))
            health.hear(topic)
            if camera.calibration.changes > changes:
                self.get_logger().warning(f"{reader.topic_name} changed: taken over")

        reader = subscribe(self, topic, take)
        return topic._replace(name=reader.topic_name)

    def _follow_odometry(self, robot: str) -> None:
        camera = self._cameras[robot]

        def take(data: bytes) -> None:
            try:
                sample = wire.decode_pose(data, robot)
            except InputError as error:
                self._health[robot].refuse(error)
            else:
                self._await(camera.move(sample))

        subscribe(self, topics.odometry(robot), take)

    def _await(self, looks: list[Look]) -> None:
        """Have the newest pair of each robot wait in place of an older one.

        But for the first of all while subscribers are missing: it says where the robot starts.
        """
        for look in looks:
            is_second = look.robot in self._waiting
            self._health[look.robot].dropped += is_second
            if not (is_second and self._audience.is_missing()):
                self._waiting[look.robot] = look

    def _publish(self, look: Look, job: "Future[tuple[Sight, float]]") -> None:
        health = self._health[look.robot]
        try:
            sight, took_ms = job.result()
        except InputError as error:
            health.refuse(error)
            return
        health.see(sight.seen, took_ms)
        for topic, data in sight.messages:
            self._outputs[topic].publish(data)

    def _publish_diagnostics(self) -> None:
        news = self._silence.news(self._published_by_others)
        statuses = []
        for robot, health in self._health.items():
            own = {topic.name for topic in self._names[robot]}
            told = [text for name, text in self._silence.told.items() if name in own]
            statuses.append(health.status(told))
            if not told:
                news.append(health.news(statuses[-1]))
        for line in filter(None, news):
            self.get_logger().warning(line)
        stamp_ns = self.get_clock().now().nanoseconds
        self._diagnostics.publish(wire.encode_diagnostics(stamp_ns, statuses))

    def _published_by_others(self) -> dict[str, str]:
        """The type of every topic that somebody else publishes, by whole name."""
        own = {one.topic_name for one in self._outputs.values()}
        known = self.get_topic_names_and_types()
        return {n: types[0] for n, types in known if n not in own and self.count_publishers(n)}


def _chosen(config: Config, only: str) -> tuple[str, ...]:
    if only and only not in config.robots:
        raise InputError(f"only: no robot '{only}'; the team is {', '.join(config.robots)}")
    return (only,) if only else config.robots


def _outputs(config: Config, robot: str) -> list[Topic]:
    previews = [topics.preview(robot), topics.preview_info(robot)]
    sightings = [topics.sightings(robot)] if config.camera.tags.on_robots else []
    previews = previews if config.camera.preview_px else []
    return [topics.observations(robot), *sightings, *previews]


def _timed(look: Look, config: Config) -> tuple[Sight, float]:
    """What a pair shows, and how long it took [ms]."""
    start = time.perf_counter()
    sight = see(look, config)
    return sight, (time.perf_counter() - start) * 1e3


def _warm_up(config: Config) -> None:
    """Compile the front end, or load it from the cache: look at noise.

    Pictures as they come from the wire cannot be written, which compiles to other code.
    """
    width_px, height_px = 160, 120
    rig = StereoRig(100.0, (width_px / 2, height_px / 2), 0.1, width_px, height_px)
    noise = np.random.default_rng(0).integers(0, 256, (height_px, width_px), np.uint8)
    front_end = FrontEnd(rig, config.camera)
    for is_writable in (True, False):
        pair = noise, np.roll(noise, -5, axis=1)
        for picture in pair:
            picture.setflags(write=is_writable)
        front_end.observe(*pair)


def main(args: list[str] | None = None) -> int:
    """Look at pictures until interrupted; the exit code."""
    return spin(CameraNode, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
