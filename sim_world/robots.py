"""ROS: one publisher node per robot, all driven by one simulation."""

import sys
import time
from typing import Annotated

from annotated_types import Ge
from rclpy.duration import Duration
from rclpy.node import Node

from msg_defs import scenario_file as yaml_settings
from msg_defs import topics, wire
from msg_defs.ros import node
from msg_defs.types import settings
from sim_world.robot import START_NS
from sim_world.scenario import SECTION, Scenario
from sim_world.simulator import RobotStep, Simulation

IN_FLIGHT_S = 4.0
"""Message time published before subscribers must have acknowledged it.

A message lost on the way is sent again and arrives behind later ones, but no further behind than
this, which is less than the 5 s that a fusion waits for a robot by default.
"""
MOST_IN_FLIGHT = 200
"""As many steps, if that is less; publishers and subscribers keep 1000."""
ACKNOWLEDGE_S = 5.0
"""How long a subscriber that acknowledges nothing holds up the others."""
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
    truth_subscribers: Annotated[
        int, Ge(0), "subscribers to wait for on each ground_truth and stereo/truth topic"
    ] = 0
    wait_s: Annotated[float, Ge(0), "start without them after so long; 0 waits forever [s]"] = 0.0


class RobotNode(Node):
    """Publishes what one robot reports, and the truth about it."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._frames = topics.odom_frame(name), topics.base_frame(name)
        inputs = topics.odometry(name), topics.observations(name)
        truths = topics.ground_truth(name), topics.observation_truth(name)
        self.inputs = [node.publisher(self, topic) for topic in inputs]
        self.truths = [node.publisher(self, topic) for topic in truths]

    def publish(self, step: RobotStep) -> None:
        """Publish everything of one instant."""
        odom_frame, base_frame = self._frames
        odometry, observations = self.inputs
        odometry.publish(wire.encode_pose(step.odometry, odom_frame, base_frame))
        observations.publish(wire.encode_observations(step.observations))
        truth, observation_truth = self.truths
        truth.publish(wire.encode_pose(step.truth, topics.MAP_FRAME, base_frame))
        observation_truth.publish(wire.encode_observation_truth(step.observation_truth))

    def is_acknowledged(self) -> bool:
        """Every subscriber has everything that was published."""
        publishers = self.inputs + self.truths
        return all(p.wait_for_all_acked(Duration(nanoseconds=1)) for p in publishers)

    def missing(self, subscribers: int, truth_subscribers: int) -> list[str]:
        """Topics that have fewer subscribers than expected."""
        expected = ((self.inputs, subscribers), (self.truths, truth_subscribers))
        return [
            publisher.topic_name
            for publishers, count in expected
            for publisher in publishers
            if publisher.get_subscription_count() < count
        ]


class SimWorld(node.EdgeNode):
    """Plays a simulation; holds the parameters, and publishes what belongs to no robot."""

    def __init__(self) -> None:
        super().__init__("sim_world")
        scenario, playback = node.declare(self, Scenario, Playback, section=SECTION)
        simulation = Simulation(scenario, playback.seed, playback.only or None)
        self.companions = [RobotNode(name) for name in simulation.start_poses]
        self._playback = playback
        self._publish_world(simulation, scenario)
        self._steps = simulation.steps()
        self._next = next(self._steps, None)
        self._published = self._in_flight = 0
        self._most_in_flight = min(MOST_IN_FLIGHT, int(IN_FLIGHT_S / scenario.period_s))
        self._created_s = time.monotonic()
        self._started_s = self._held_up_s = None

    def work(self) -> float:
        """Publish the next step if it is due; the seconds until there is more to do."""
        if self._started_s is None:
            return self._wait_for_subscribers()
        if self._is_held_up():
            return POLL_S
        if self._next is None:
            self.get_logger().info(f"the exploration is over: {self._published} steps published")
            self.done = True
            return 0.0
        wait_s = self._due_s() - time.monotonic()
        if wait_s > 0:
            return wait_s
        self._publish_step()
        return 0.0

    def _publish_world(self, simulation: Simulation, scenario: Scenario) -> None:
        config = yaml_settings.to_yaml(**{SECTION: scenario})
        for topic, data in (
            (topics.GROUND_TRUTH_LANDMARKS, wire.encode_map(simulation.landmarks, START_NS)),
            (topics.GROUND_TRUTH_WALLS, wire.encode_walls(simulation.walls, START_NS)),
            (topics.WORLD_CONFIG, wire.encode_text(f"# seed: {simulation.seed}\n{config}")),
        ):
            node.publisher(self, topic).publish(data)

    def _wait_for_subscribers(self) -> float:
        play, log = self._playback, self.get_logger()
        missing = ", ".join(
            topic
            for robot in self.companions
            for topic in robot.missing(play.subscribers, play.truth_subscribers)
        )
        waited_s = time.monotonic() - self._created_s
        if missing and (play.wait_s == 0 or waited_s < play.wait_s):
            log.info(f"waiting for subscribers of {missing}", throttle_duration_sec=5.0)
            return POLL_S
        if missing:
            log.warning(f"starting without subscribers of {missing}")
        log.info(f"publishing {', '.join(robot.get_name() for robot in self.companions)}")
        self._started_s = time.monotonic()
        return 0.0

    def _due_s(self) -> float:
        """When the next step is to be published, on the monotonic clock [s]."""
        if self._playback.speed == 0:
            return 0.0
        elapsed_s = (self._next[0].odometry.stamp_ns - START_NS) / 1e9
        return self._started_s + elapsed_s / self._playback.speed

    def _publish_step(self) -> None:
        for robot, step in zip(self.companions, self._next, strict=True):
            robot.publish(step)
        self._next = next(self._steps, None)
        self._published += 1
        self._in_flight += 1

    def _is_held_up(self) -> bool:
        """Too much is unacknowledged to go on.

        The first step and the last must be acknowledged: that a publisher knows its subscriber
        does not mean that the subscriber knows the publisher, and the end ends the publisher.
        """
        limit = self._most_in_flight if self._next and self._published > 1 else 0
        if self._in_flight > limit // 2 and all(r.is_acknowledged() for r in self.companions):
            self._in_flight, self._held_up_s = 0, None
        if self._in_flight <= limit:
            return False
        self._held_up_s = self._held_up_s or time.monotonic()
        if time.monotonic() - self._held_up_s < ACKNOWLEDGE_S:
            return True
        self.get_logger().warning("a subscriber does not acknowledge: it may lose messages")
        self._in_flight, self._held_up_s = 0, None
        return False


def main(args: list[str] | None = None) -> int:
    """Publish the simulated robots until the exploration is over; the exit code."""
    return node.spin(SimWorld, args)


if __name__ == "__main__":
    sys.exit(main())
