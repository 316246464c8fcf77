"""ROS: publishes what was recorded in a bag, at its pace, with /clock."""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from annotated_types import Ge
from std_srvs.srv import SetBool

from msg_defs import topics, wire
from msg_defs.errors import InputError
from msg_defs.ros.endpoints import Audience, InFlight, publisher
from msg_defs.ros.parameters import declare
from msg_defs.ros.spin import EdgeNode, spin
from msg_defs.ros.usage import Usage
from msg_defs.topics import SENSOR, Topic
from msg_defs.types import settings
from multi_robot_slam.bags import BagReader, Record, absolute, playback

CLOCK = Topic("/clock", "rosgraph_msgs/msg/Clock", SENSOR)

MOST_IN_FLIGHT = 100
"""Messages published before subscribers must have acknowledged them.

So a message that is lost on the way and sent again is no further behind later ones than that.
"""
AT_ONCE = 20
"""Messages published before the node looks what has come in."""
MOST_PICTURES_IN_FLIGHT = 8
"""The same where there are pictures among them, of which publishers keep 10."""
POLL_S = 0.01
PROGRESS_PERIOD_S = 0.9


@settings
class Playback:
    """What to replay, and how."""

    bag: Annotated[str, "bag folder, .mcap or .db3 file"] = ""
    rate: Annotated[
        float, Ge(0), "times the pace of the recording; 0 is as fast as subscribers take it"
    ] = 1.0
    start_s: Annotated[float, Ge(0), "where in the recording to start [s]"] = 0.0
    loop: Annotated[bool, "start again at the end, until interrupted"] = False
    everything: Annotated[bool, "publish what a fusion made of it, too"] = False
    rename: Annotated[tuple[str, ...], "robots to rename, topics and frames: robot_1=alice"] = ()
    clock_hz: Annotated[
        float, Ge(0), "messages on /clock per second of the recording; 0 is none [Hz]"
    ] = 40.0
    subscribers: Annotated[
        int,
        Ge(0),
        "subscribers to wait for on each odom and stereo/landmarks topic, or each of pictures",
    ] = 1
    wait_s: Annotated[
        float,
        Ge(0),
        "start without them after so long, and say so; 0 waits forever; a fusion that is started "
        "at the same time takes some 3 s to load [s]",
    ] = 10.0


USAGE = Usage(
    "multi_robot_slam replay",
    "Publish what was recorded in a bag, at its pace, with /clock: by default all but what a "
    "fusion made of it, so that another fusion can run on it.",
    (Playback,),
)


class Replay(EdgeNode):
    """Publishes the recorded bytes on the recorded topics."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock` is a monotonic one [s]."""
        super().__init__("replay")
        (self._play,) = declare(self, *USAGE.classes)
        self._reader = _open(self._play.bag)
        for warning in self._reader.warnings:
            self.get_logger().warning(warning)
        robots = playback.require_robots(self._reader)
        self._names = playback.Names(self._play.rename, robots)
        if self._play.rename and self._play.everything:
            raise InputError("rename: a fusion's words keep the names; leave out everything:=true")
        self._begin_ns, self._end_ns = self._reader.summary.span_ns or (0, 0)
        self._start_ns = self._begin_ns + round(self._play.start_s * 1e9)
        if self._start_ns > self._end_ns:
            raise InputError(
                f"start_s = {self._play.start_s}: the recording lasts {self._since(self._end_ns)}"
            )
        self._wanted = self._available()
        self._outputs = {
            name: publisher(self, self._names.topic(topic)) for name, topic in self._wanted.items()
        }
        inputs = {absolute(topics.odometry(robot).name) for robot in robots}
        inputs |= {name for robot in robots for name in playback.eyes(self._wanted.values(), robot)}
        expected = [(p, self._play.subscribers) for n, p in self._outputs.items() if n in inputs]
        self._audience = Audience(self, expected, self._play.wait_s)
        has_pictures = any(map(playback.is_picture, self._wanted.values()))
        self._most_in_flight = MOST_PICTURES_IN_FLIGHT if has_pictures else MOST_IN_FLIGHT
        self._in_flight = InFlight(self, list(self._outputs.values()))
        self._clock_output = publisher(self, CLOCK) if self._play.clock_hz else None
        self.create_service(SetBool, "~/pause", self._pause)
        self._pace = playback.Pace(self._play.rate, clock) if self._play.rate else None
        self._is_paused = self._is_started = False
        self._passes = self._published = 0
        self._begun: set[str] = set()

    def work(self) -> float:
        """Publish what is due; the seconds until there is more to do."""
        if self._audience.is_missing():
            return POLL_S
        if not self._is_started:
            self._start()
        for _ in range(AT_ONCE):
            wait_s = self._go_on()
            if wait_s > 0 or self.done:
                return wait_s
        return 0.0

    def _go_on(self) -> float:
        """Publish the next message if it is due; the seconds until there is more to do."""
        if self._is_paused or self._is_held_up():
            return POLL_S
        if self._next is None:
            return self._end_pass()
        if self._pace:
            wait_s = self._pace.wait_s(self._next.stamp_ns)
            if wait_s > 0:
                self._tick(self._pace.now_ns())
                return min(wait_s, self._tick_s()) if self._clock_output else wait_s
        self._tick(self._next.stamp_ns)
        self._publish(self._next)
        return 0.0

    def close(self) -> None:
        """Tell how far it came."""
        self.get_logger().info(f"{self._published} messages published")

    def _since(self, stamp_ns: int) -> str:
        return f"{(stamp_ns - self._begin_ns) / 1e9:.1f} s"

    def _available(self) -> dict[str, Topic]:
        """The topics to publish, without those whose message type is not installed."""
        wanted = playback.selected(self._reader.summary.topics, self._play.everything)
        missing = [name for name, topic in wanted.items() if not _is_installed(topic)]
        if missing:
            self.get_logger().warning(f"types are not installed, left out: {', '.join(missing)}")
        left_out = sorted({topic.name for topic in self._reader.summary.topics} - set(wanted))
        if left_out:
            self.get_logger().info(f"left out: {', '.join(left_out)}")
        return {name: topic for name, topic in wanted.items() if name not in missing}

    def _start(self) -> None:
        self.get_logger().info(
            f"replaying {self._since(self._end_ns)}, {len(self._wanted)} of "
            f"{len(self._reader.summary.topics)} topics, from {self._since(self._start_ns)} on"
        )
        self._is_started = True
        self._begin_pass()

    def _begin_pass(self) -> None:
        self._passes += 1
        self._records = playback.messages(self._reader, self._wanted, self._start_ns)
        self._next = next(self._records, None)
        self._gaps = playback.Gaps(self._wanted, self._begin_ns)
        self._ticked_ns = -1
        if self._pace:
            self._pace.start(self._start_ns)
            if self._is_paused:
                self._pace.pause()

    def _end_pass(self) -> float:
        for gap in self._gaps.at_end(self._end_ns):
            self._tell(gap)
        if self._play.loop:
            self.get_logger().info(f"the recording is over, once more: pass {self._passes + 1}")
            self._begin_pass()
        else:
            self.get_logger().info("the recording is over")
            self.done = True
        return 0.0

    def _tick_s(self) -> float:
        """Our time between two messages on /clock [s]."""
        return 1 / (self._play.clock_hz * self._play.rate)

    def _tick(self, now_ns: int) -> None:
        """Send the time of the recording if it is due."""
        is_due = self._ticked_ns < 0 or now_ns >= self._ticked_ns + 1e9 / self._play.clock_hz
        if self._clock_output and is_due:
            self._clock_output.publish(wire.encode_clock(now_ns))
            self._ticked_ns = now_ns

    def _publish(self, record: Record) -> None:
        self._outputs[record.topic].publish(self._names.data(record))
        self._tell(self._gaps.note(record.topic, record.stamp_ns))
        self._published += 1
        self._in_flight.add()
        if record.topic not in self._begun:
            # That we know a subscriber does not mean that it knows us.
            self._begun.add(record.topic)
            self._in_flight.add(MOST_IN_FLIGHT)
        self._next = next(self._records, None)
        self.get_logger().info(
            f"{self._since(record.stamp_ns)} of {self._since(self._end_ns)}, "
            f"{self._published} messages",
            throttle_duration_sec=PROGRESS_PERIOD_S,
        )

    def _tell(self, gap: str) -> None:
        if gap and self._passes == 1:
            self.get_logger().warning(gap)

    def _is_held_up(self) -> bool:
        """Too much is unacknowledged to go on; the end of a pass must be acknowledged whole."""
        return self._in_flight.is_above(self._most_in_flight if self._next else 0)

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._is_paused = bool(request.data)
        if self._pace and self._is_started:
            self._pace.pause() if self._is_paused else self._pace.resume()
        response.success = True
        response.message = "paused" if self._is_paused else "going on"
        self.get_logger().info(response.message)
        return response


def _open(bag: str) -> BagReader:
    if not bag:
        raise InputError("bag is empty; name the bag to replay: --ros-args -p bag:=FOLDER")
    return BagReader(Path(bag))


def _is_installed(topic: Topic) -> bool:
    try:
        return wire.message_class(topic.type) is not None
    except (ImportError, AttributeError, ValueError):
        return False


def main(args: list[str] | None = None) -> int:
    """Replay until the recording is over, or until interrupted; the exit code."""
    return spin(Replay, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
