"""ROS: records what the team sends and what the fusion makes of it, byte for byte, into a bag."""

import sys
import time
from collections import Counter
from collections.abc import Callable
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Annotated

from annotated_types import Len

from msg_defs import topics
from msg_defs.ros.endpoints import is_available, subscribe
from msg_defs.ros.parameters import declare
from msg_defs.ros.spin import EdgeNode, spin
from msg_defs.ros.usage import Usage
from msg_defs.types import settings
from multi_robot_slam.bags import FLUSH_PERIOD_S, BagWriter


@settings
class Recording:
    """What to record, and where."""

    out: Annotated[str, "bag folder to write, which must not exist; empty is recording_<time>"] = ""
    robots: Annotated[tuple[str, ...], Len(1), "names of the robots to record"] = ("robot_1",)

    def __post_init__(self) -> None:
        for name in self.robots:
            topics.require_robot_name(name)


USAGE = Usage(
    "multi_robot_slam record",
    "Record all topics of the team, the simulator and the fusion into a bag.",
    (Recording,),
)


def recorded(robots: tuple[str, ...]) -> list[topics.Topic]:
    """Every topic of the team `robots`, its simulator and its fusion."""
    of_each = (
        topics.odometry,
        topics.observations,
        topics.sightings,
        topics.preview,
        topics.preview_info,
        topics.ground_truth,
        topics.observation_truth,
    )
    return [
        topics.GROUND_TRUTH_LANDMARKS,
        topics.GROUND_TRUTH_WALLS,
        topics.WORLD_CONFIG,
        topics.TF_STATIC,
        *(topic(robot) for robot in robots for topic in of_each),
        *topics.fusion_outputs(robots),
    ]


class Recorder(EdgeNode):
    """Writes each message with the time it was received."""

    def __init__(self) -> None:
        super().__init__("recorder")
        (recording,) = declare(self, *USAGE.classes)
        self._folder = Path(recording.out or f"recording_{datetime.now():%Y%m%d_%H%M%S}")
        self._bag = BagWriter(self._folder)
        self._counts: Counter[str] = Counter()
        for topic in filter(is_available, recorded(recording.robots)):
            resolved = topic._replace(name=self.resolve_topic_name(topic.name))
            subscribe(self, topic, partial(self._record, resolved))
        self.create_timer(FLUSH_PERIOD_S, partial(self._guarded, self._bag.flush))
        self.get_logger().info(f"recording {', '.join(recording.robots)} into {self._folder}")

    def close(self) -> None:
        """Complete the bag and tell what is in it."""
        self._guarded(self._bag.close)
        messages, topics_heard = self._counts.total(), len(self._counts)
        self.get_logger().info(f"{messages} messages of {topics_heard} topics in {self._folder}")

    def _record(self, topic: topics.Topic, data: bytes) -> None:
        if not self.exit_code:
            self._guarded(partial(self._bag.write, topic, time.time_ns(), data))
            self._counts[topic.name] += 1

    def _guarded(self, write: Callable[[], None]) -> None:
        """Do what writes to the disk; when the disk fails, say so once and end."""
        try:
            write()
        except OSError as error:
            if not self.exit_code:
                text = f"cannot write {self._folder}: {error.strerror}; the recording ends here"
                self.get_logger().error(text)
            self.exit_code = 1
            self.done = True


def main(args: list[str] | None = None) -> int:
    """Record until interrupted; the exit code."""
    return spin(Recorder, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
