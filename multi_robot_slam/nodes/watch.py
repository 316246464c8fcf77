"""ROS: shows what a fusion publishes as a page in the browser."""

import os
import sys
from functools import partial
from typing import Annotated

from annotated_types import Ge

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from msg_defs.ros import environment
from msg_defs.ros.endpoints import subscribe
from msg_defs.ros.parameters import declare
from msg_defs.ros.spin import EdgeNode, spin
from msg_defs.ros.usage import Usage
from msg_defs.topics import LATCHED, Topic
from msg_defs.types import settings
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.watch.address import Serving, free, require_viser
from multi_robot_slam.watch.inputs import Input, inputs
from multi_robot_slam.watch.watched import Watched

DAMAGED_PERIOD_S = 5.0
"""Of messages that cannot be read one is told of in so long."""


@settings
class Life:
    """When the node ends by itself."""

    ends_with: Annotated[
        int, Ge(0), "process that started the node, with which it ends; 0: it goes on"
    ] = 0


USAGE = Usage(
    "multi_robot_slam watch",
    "Show a fusion that runs as a page in the browser: map, robots, paths, uncertainty, particles, "
    "and how the fusion is. It learns the team from fusion/config and changes nothing: it only "
    "listens. The page needs no network. A run that is over is played by: multi_robot_slam watch "
    "BAG",
    (Serving, Life),
)


class Watch(EdgeNode):
    """Listens to what the fusion publishes, and has the page show it.

    Streams are heard once there is a map. Until then a fusion may wait for subscribers, and would
    take this node for one that must not miss anything, such as a recorder.
    """

    def __init__(self) -> None:
        super().__init__("watch")
        serving, self._life = declare(self, *USAGE.classes)
        require_viser()
        from multi_robot_slam.watch.page import Page

        self._page = Page(free(serving))
        self._watched: Watched | None = None
        self._inputs: dict[Topic, Input] = {}
        self._heard: set[Topic] = set()
        subscribe(self, topics.FUSION_CONFIG, self._configure)
        self._page.say(f"Waiting for a fusion; {environment.reach()}.")
        if warning := self._page.address.warning:
            self.get_logger().warning(warning)
        self.get_logger().info(f"{self._page.address} shows the fusion; {environment.reach()}")

    def work(self) -> float:
        """Bring the page up to date."""
        self.done = self._life.ends_with not in (0, os.getppid())
        if self._watched is not None:
            self._page.draw(self._watched)
        return super().work()

    def close(self) -> None:
        """Serve no longer."""
        self._page.close()

    def _configure(self, data: bytes) -> None:
        """Watch the team of a fusion that has begun."""
        try:
            text = wire.decode_text(data)
            config = scenario_file.from_yaml(Config, text, SECTION, topics.FUSION_CONFIG.name)
        except InputError as error:
            self._complain(error)
            return
        self._watched, self._inputs = Watched(config), inputs(config.robots)
        for topic in self._inputs:
            if topic.qos == LATCHED or topic == topics.DIAGNOSTICS:
                self._listen(topic)

    def _listen(self, topic: Topic) -> None:
        if topic not in self._heard:
            self._heard.add(topic)
            subscribe(self, topic, partial(self._take, topic))

    def _take(self, topic: Topic, data: bytes) -> None:
        if self._watched is None or topic not in self._inputs:
            return
        try:
            value = self._inputs[topic].decode(data)
        except InputError as error:
            self._complain(error)
            return
        self._inputs[topic].take(self._watched, value)
        if topic == topics.MAP_LANDMARKS:
            for other in self._inputs:
                self._listen(other)

    def _complain(self, error: InputError) -> None:
        self.get_logger().warning(str(error), throttle_duration_sec=DAMAGED_PERIOD_S)


def main(args: list[str] | None = None) -> int:
    """Show the fusion until interrupted; the exit code."""
    return spin(Watch, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
