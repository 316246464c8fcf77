"""ROS: writes down when each message of a team and of its fusion arrives."""

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated

from annotated_types import Len

from msg_defs import topics, wire
from msg_defs.ros.endpoints import subscribe
from msg_defs.ros.parameters import declare
from msg_defs.ros.spin import EdgeNode, spin
from msg_defs.ros.usage import Usage
from msg_defs.types import settings

HEADER = "topic,stamp_ns,arrived_ns"


@settings
class Timing:
    """What to time, and where to write it."""

    out: Annotated[str, "CSV file to write when the node ends"] = "arrivals.csv"
    robots: Annotated[tuple[str, ...], Len(1), "names of the robots"] = ("robot_1",)

    def __post_init__(self) -> None:
        for name in self.robots:
            topics.require_robot_name(name)


USAGE = Usage(
    "python -m multi_robot_slam.nodes.stopwatch",
    "Write down when odometry, clouds and poses of the team arrive, by one monotonic clock.",
    (Timing,),
)


class Stopwatch(EdgeNode):
    """Notes topic, stamp and arrival of each message as it is taken."""

    def __init__(self, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        super().__init__("stopwatch")
        (timing,) = declare(self, *USAGE.classes)
        self._out = Path(timing.out)
        self._now_ns = now_ns
        self._arrivals: list[tuple[str, int, bytes]] = []
        kinds = topics.odometry, topics.observations, topics.pose, topics.mean_pose
        for topic in [topics.STEPS, *(kind(name) for name in timing.robots for kind in kinds)]:
            subscribe(self, topic, partial(self._note, topic.name))

    def close(self) -> None:
        """Write the file."""
        lines = [
            f"{topic},{wire.peek_stamp(data, topic)},{arrived_ns}"
            for topic, arrived_ns, data in self._arrivals
        ]
        self._out.write_text("\n".join([HEADER, *lines]) + "\n")

    def _note(self, topic: str, data: bytes) -> None:
        self._arrivals.append((topic, self._now_ns(), data))


def main(args: list[str] | None = None) -> int:
    """Take the time until interrupted; the exit code."""
    return spin(Stopwatch, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
