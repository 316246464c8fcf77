"""What a replay of a recording sends and when; knows no node."""

import time
from collections.abc import Callable, Iterable, Iterator

from msg_defs import topics, wire
from msg_defs.errors import InputError
from msg_defs.topics import BULKY, LATCHED, Topic
from multi_robot_slam.bags import BagReader, Record, absolute

GAP_S = 1.0
GAP_PERIODS = 10
"""A topic is silent that sends nothing for so long, and for so many of its mean periods."""

_ODOMETRY_END = absolute(topics.odometry("").name)
_CLOCK = "/clock"


def robots_of(recorded: Iterable[Topic]) -> tuple[str, ...]:
    """The robots whose odometry is among `recorded` topics, each with its namespace if any."""
    names = (topic.name for topic in recorded if topic.name.endswith(_ODOMETRY_END))
    return tuple(sorted(name.removesuffix(_ODOMETRY_END).lstrip("/") for name in names))


def require_robots(reader: BagReader) -> tuple[str, ...]:
    """The robots with odometry in the bag; `InputError` when there are none that see anything."""
    robots = robots_of(reader.summary.topics)
    kinds = (topics.odometry, topics.observations)
    reader.require([kind(robot) for robot in robots for kind in kinds])
    if not any(eyes(reader.summary.topics, robot) for robot in robots):
        expected = ", ".join(absolute(kind("<robot>").name) for kind in kinds)
        raise InputError(
            f"{reader.path} has no robot in it: expected {expected}; its topics are "
            f"{reader.found()}; record these topics, or remap yours to them"
        )
    return robots


def eyes(recorded: Iterable[Topic], robot: str) -> set[str]:
    """Names of the topics with what a robot sees: its observations or, without them, pictures."""
    by_name = {topic.name: topic for topic in recorded}
    observations = absolute(topics.observations(robot).name)
    if observations in by_name:
        return {observations}
    sides = tuple(absolute(f"{robot}/{side}/") for side in ("left", "right"))
    own = (topic for name, topic in by_name.items() if name.startswith(sides))
    return {topic.name for topic in own if is_picture(topic)}


def is_picture(topic: Topic) -> bool:
    """Its messages are pictures, raw or compressed."""
    return topic.type in (topics.image("", "").type, topics.compressed_image("", "").type)


def selected(recorded: Iterable[Topic], everything: bool) -> dict[str, Topic]:
    """By name, the topics to send: those a fusion publishes only if `everything` is wanted.

    Of pictures few are kept in store: many would fill the memory.
    """
    by_name = {
        topic.name: topic._replace(qos=BULKY) if is_picture(topic) else topic
        for topic in sorted(recorded)
        if topic.name != _CLOCK
    }
    if everything:
        return by_name
    outputs = tuple(absolute(t.name) for t in topics.fusion_outputs(robots_of(recorded)))
    return {name: topic for name, topic in by_name.items() if not name.endswith(outputs)}


class Names:
    """Other names for some of the robots, given as `old=new`.

    A robot recorded in a namespace is `fleet/robot_1`, or `robot_1` where no other namespace has
    one of that name. It stays in its namespace. Frames have none: its are `robot_1/odom`, ...
    """

    def __init__(self, rules: Iterable[str], robots: tuple[str, ...]) -> None:
        self._names: dict[str, str] = {}
        for rule in rules:
            old, _, new = rule.partition("=")
            meant = [robot for robot in robots if old in (robot, _own_name(robot))]
            if not new or "/" in new or not meant:
                raise InputError(
                    f"rename: '{rule}' is not robot=name with a robot of the recording, "
                    f"{', '.join(robots)}"
                )
            if len(meant) > 1:
                raise InputError(
                    f"rename: '{old}' is each of {', '.join(meant)}; name one of these"
                )
            robot = meant[0]
            self._names[robot] = robot.removesuffix(_own_name(robot)) + new
        team = [self._names.get(robot, robot) for robot in robots]
        if len(set(team)) < len(team):
            raise InputError(f"rename: two robots would have one name in {', '.join(team)}")

    def topic(self, topic: Topic) -> Topic:
        """The topic as it is called after renaming."""
        robot = self._robot(topic.name)
        if robot is None:
            return topic
        rest = topic.name.removeprefix(f"/{robot}/")
        return topic._replace(name=f"/{self._names[robot]}/{rest}")

    def data(self, record: Record) -> bytes:
        """The message with its frames renamed; what cannot be decoded stays as it is."""
        robot = self._robot(record.topic)
        if robot is None:
            return record.data
        namespace = robot.removesuffix(_own_name(robot))
        frames = {
            _own_name(old): _own_name(new)
            for old, new in self._names.items()
            if old.removesuffix(_own_name(old)) == namespace
        }
        try:
            return wire.renamed(record.data, record.type, frames)
        except InputError:
            return record.data

    def _robot(self, name: str) -> str | None:
        """The robot to rename whose topic this is."""
        return next((robot for robot in self._names if name.startswith(f"/{robot}/")), None)


def _own_name(robot: str) -> str:
    """A robot's name without its namespace."""
    return robot.rpartition("/")[2]


def messages(reader: BagReader, wanted: dict[str, Topic], start_ns: int) -> Iterator[Record]:
    """The `wanted` messages from `start_ns` on, after what was latched until then."""
    latched: dict[str, Record] = {}
    for record in reader.records(wanted.keys()):
        if record.stamp_ns >= start_ns:
            yield from (r._replace(stamp_ns=start_ns) for r in latched.values())
            latched.clear()
            yield record
        elif wanted[record.topic].qos == LATCHED:
            latched[record.topic] = record


class Pace:
    """Where the replay is in the recording: its time goes on `rate` times as fast as ours.

    `clock` is a monotonic one [s].
    """

    def __init__(self, rate: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate = rate
        self._clock = clock
        self._since: tuple[float, int] | None = None
        self._recorded_ns = 0

    def start(self, recorded_ns: int) -> None:
        """Be at this time of the recording, and go on."""
        self._since = self._clock(), recorded_ns

    def pause(self) -> None:
        """Stand still until `resume`."""
        self._recorded_ns, self._since = self.now_ns(), None

    def resume(self) -> None:
        if self._since is None:
            self.start(self._recorded_ns)

    def now_ns(self) -> int:
        """Time of the recording."""
        if self._since is None:
            return self._recorded_ns
        started_s, recorded_ns = self._since
        return recorded_ns + int((self._clock() - started_s) * self._rate * 1e9)

    def wait_s(self, recorded_ns: int) -> float:
        """How long until this time of the recording; negative when it is over."""
        return (recorded_ns - self.now_ns()) / 1e9 / self._rate


class Gaps:
    """Notices when a topic that was sent regularly is silent."""

    def __init__(self, wanted: dict[str, Topic], start_ns: int) -> None:
        self._regular = {name for name, topic in wanted.items() if topic.qos != LATCHED}
        self._start_ns = start_ns
        self._heard: dict[str, tuple[int, int, int]] = {}

    def note(self, name: str, stamp_ns: int) -> str:
        """A message at `stamp_ns`; what to say about the silence before it, mostly nothing."""
        if name not in self._regular:
            return ""
        first_ns, last_ns, count = self._heard.get(name, (stamp_ns, stamp_ns, 0))
        self._heard[name] = first_ns, stamp_ns, count + 1
        return self._complaint(name, first_ns, last_ns, count, stamp_ns)

    def at_end(self, end_ns: int) -> list[str]:
        """What to say about the silences up to the end of the recording."""
        said = (self._complaint(name, *heard, end_ns) for name, heard in self._heard.items())
        return [text for text in said if text]

    def _complaint(self, name: str, first_ns: int, last_ns: int, count: int, now_ns: int) -> str:
        silence_s = (now_ns - last_ns) / 1e9
        period_s = (last_ns - first_ns) / 1e9 / max(1, count - 1)
        if count < 2 or silence_s < max(GAP_S, GAP_PERIODS * period_s):
            return ""
        after_s = (last_ns - self._start_ns) / 1e9
        return f"gap: nothing on {name} for {silence_s:.1f} s, after {after_s:.1f} s"
