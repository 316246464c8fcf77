"""ROS: one publisher node per robot, all driven by one simulation."""

import sys
import time
from collections.abc import Callable, Iterator
from typing import Annotated, NamedTuple

from annotated_types import Ge
from rclpy.node import Node
from rclpy.publisher import Publisher

from msg_defs import topics
from msg_defs.ros.endpoints import Audience, InFlight, is_available, publisher
from msg_defs.ros.parameters import declare
from msg_defs.ros.spin import EdgeNode, spin
from msg_defs.ros.usage import Usage
from msg_defs.topics import Topic
from msg_defs.types import settings
from sim_world import messages
from sim_world.messages import Message
from sim_world.robot import START_NS
from sim_world.scenario import SECTION, Scenario
from sim_world.simulator import Simulation

IN_FLIGHT_S = 4.0
"""Message time published before subscribers must have acknowledged it.

A message lost on the way is sent again and arrives behind later ones, but no further behind than
this, which is less than the 5 s that a fusion waits for a robot by default.
"""
MOST_IN_FLIGHT = 200
"""As many steps, if that is less; publishers and subscribers keep 1000."""
MOST_PICTURES_IN_FLIGHT = 8
"""As many steps with pictures, of which publishers keep 10."""
AUTOMATIC: messages.Transport = "raw"
"""How messages hold pictures, where the scenario does not say."""
POLL_S = 0.01


@settings
class Playback:
    """How the simulation is played."""

    seed: Annotated[int, Ge(0), "seed of the simulation's random numbers"] = 0
    speed: Annotated[float, Ge(0), "times real time; 0 is as fast as possible"] = 5.0
    only: Annotated[str, "publish this robot alone; empty is the whole team"] = ""
    subscribers: Annotated[
        int, Ge(0), "subscribers to wait for on each odom and stereo/landmarks topic"
    ] = 1
    image_subscribers: Annotated[
        int, Ge(0), "subscribers to wait for on each topic of pictures and their calibration"
    ] = 1
    truth_subscribers: Annotated[
        int, Ge(0), "subscribers to wait for on each ground_truth and stereo/truth topic"
    ] = 0
    wait_s: Annotated[float, Ge(0), "start without them after so long; 0 waits forever [s]"] = 0.0
    publish_tf: Annotated[
        bool, "publish the transforms <robot>/odom -> <robot>/base_link -> camera"
    ] = True


class RobotNode(Node):
    """Publishes what one robot reports, and the truth about it."""

    def __init__(self, name: str, transport: messages.Transport | None, publish_tf: bool) -> None:
        """Of pictures that messages hold in this way or, where there is none, of landmarks."""
        super().__init__(name)
        inputs, truths = [topics.odometry(name)], [topics.ground_truth(name)]
        if not transport:
            inputs.append(topics.observations(name))
            truths.append(topics.observation_truth(name))
        self.inputs = _publishers(self, inputs)
        pictures = messages.picture_topics(name, transport) if transport else []
        self.pictures = _publishers(self, pictures)
        self.truths = _publishers(self, truths)
        self.transforms = _publishers(self, [topics.TF] if publish_tf else [])

    @property
    def outputs(self) -> dict[Topic, Publisher]:
        """All publishers."""
        return self.inputs | self.pictures | self.truths | self.transforms

    def publish(self, step: list[Message]) -> None:
        """Publish everything of one instant."""
        outputs = self.outputs
        for topic, data in step:
            outputs[topic].publish(data)


def _publishers(node: Node, wanted: list[Topic]) -> dict[Topic, Publisher]:
    return {topic: publisher(node, topic) for topic in wanted}


class _Said(NamedTuple):
    """What all robots say at one instant."""

    stamp_ns: int
    messages: list[list[Message]]
    """Of each robot."""


def _said(simulation: Simulation, publish_tf: bool) -> Iterator[_Said]:
    say = messages.teller(simulation, AUTOMATIC)
    for instant in simulation.steps():
        said = [say(step) for step in instant]
        if publish_tf:
            for own, step in zip(said, instant, strict=True):
                own.append(messages.odometry_transform(step))
        yield _Said(instant[0].odometry.stamp_ns, said)


class SimWorld(EdgeNode):
    """Plays a simulation; holds the parameters, and publishes what belongs to no robot."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock` is a monotonic one [s]."""
        super().__init__("sim_world")
        self._now_s = clock
        scenario, playback = declare(self, *USAGE.classes, section=USAGE.section)
        simulation = Simulation(scenario, playback.seed, playback.only or None)
        images = scenario.images
        transport = messages.transport(images, AUTOMATIC) if images.enabled else None
        publish_tf = playback.publish_tf and is_available(topics.TF)
        names = simulation.start_poses
        self._robots = [RobotNode(name, transport, publish_tf) for name in names]
        self.companions = [*self._robots]
        self._speed = playback.speed
        self._audience = Audience(self, self._expected(playback), playback.wait_s)
        self._in_flight = InFlight(self, [p for r in self._robots for p in r.outputs.values()])
        self._publish_world(simulation, publish_tf)
        if images.enabled:
            self.get_logger().info("painting the walls and compiling what renders them")
        self._steps = _said(simulation, publish_tf)
        self._next = next(self._steps, None)
        self._published = 0
        most = MOST_PICTURES_IN_FLIGHT if images.enabled else MOST_IN_FLIGHT
        self._most_in_flight = min(most, int(IN_FLIGHT_S / scenario.odometry_period_s))
        self._started_s: float | None = None

    def work(self) -> float:
        """Publish the next step if it is due; the seconds until there is more to do."""
        if self._audience.is_missing() or self._is_held_up():
            return POLL_S
        if self._next is None:
            self.get_logger().info(f"the exploration is over: {self._published} steps published")
            self.done = True
            return 0.0
        wait_s = self._due_s(self._next) - self._now_s()
        if wait_s > 0:
            return wait_s
        self._publish_step(self._next)
        return 0.0

    def _expected(self, playback: Playback) -> Iterator[tuple[Publisher, int]]:
        """Publishers, each with the subscribers it waits for."""
        for robot in self._robots:
            yield from ((one, playback.subscribers) for one in robot.inputs.values())
            yield from ((one, playback.image_subscribers) for one in robot.pictures.values())
            yield from ((one, playback.truth_subscribers) for one in robot.truths.values())

    def _publish_world(self, simulation: Simulation, publish_tf: bool) -> None:
        cameras = [messages.camera_transforms(simulation)] if publish_tf else []
        for topic, data in [*messages.of_world(simulation), *cameras]:
            publisher(self, topic).publish(data)

    def _due_s(self, step: "_Said") -> float:
        """When a step is to be published, on the monotonic clock [s]."""
        if self._started_s is None:
            self._started_s = self._now_s()
            names = ", ".join(robot.get_name() for robot in self._robots)
            self.get_logger().info(f"publishing {names}")
        if self._speed == 0:
            return 0.0
        elapsed_s = (step.stamp_ns - START_NS) / 1e9
        return self._started_s + elapsed_s / self._speed

    def _publish_step(self, step: "_Said") -> None:
        for robot, own in zip(self._robots, step.messages, strict=True):
            robot.publish(own)
        self._next = next(self._steps, None)
        self._published += 1
        self._in_flight.add()

    def _is_held_up(self) -> bool:
        """Too much is unacknowledged to go on.

        The first step and the last must be acknowledged: that a publisher knows its subscriber
        does not mean that the subscriber knows the publisher, and the end ends the publisher.
        """
        is_between = self._next is not None and self._published > 1
        return self._in_flight.is_above(self._most_in_flight if is_between else 0)


USAGE = Usage("sim_world robots", "Publish simulated robots.", (Scenario, Playback), SECTION)


def main(args: list[str] | None = None) -> int:
    """Publish the simulated robots until the exploration is over; the exit code."""
    return spin(SimWorld, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
