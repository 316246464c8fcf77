"""A bag of pictures -> the same bag with what the front end sees in them."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from msg_defs.topics import Topic
from multi_robot_slam.bags import BagReader, BagWriter, Record, absolute
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.pipeline import image_bags
from multi_robot_slam.pipeline.cameras import Look
from multi_robot_slam.pipeline.image_bags import Cameras
from multi_robot_slam.pipeline.sights import see

OnProgress = Callable[[int, int], None]
"""Told how many messages have been read, and how many there are."""

MADE = (topics.observations, topics.preview, topics.preview_info)
"""What is written of each robot; what was recorded of it is replaced."""
MADE_OF_TAGS = (*MADE, topics.sightings)
"""The same where robots carry tags."""


@dataclass
class Made:
    """What was made of one robot's pictures."""

    pairs: int = 0
    """Looked at."""
    matched: int = 0
    """Points with a disparity in all of them."""
    observations: int = 0
    """Those of them that were kept."""


@dataclass
class Result:
    """What `write` did."""

    robots: dict[str, Made]
    dropped: Counter[str] = field(default_factory=Counter)
    """Messages that could not be used, by what they are."""
    left_out: list[str] = field(default_factory=list)
    """Topics that could not be copied: nothing is known of their types."""


def write(
    bag: Path,
    out: Path,
    config: Config,
    warn: Callable[[str], None],
    on_progress: OnProgress = lambda done, total: None,
    namespace: str | None = None,
    keep_images: bool = False,
) -> Result:
    """Copy `bag` to the new bag `out` with observations in place of pictures.

    Of each pair that is due (`DuePairs`) the cloud and the preview are written at the time of the
    message with which it became due. The configuration in the bag is replaced by `config`.

    Parameters
    ----------
    warn : called with a line for the first message of each kind that is dropped.

    Raises
    ------
    InputError : the bag has no pictures of the robots of `config`.

    """
    reader = BagReader(bag)
    where = reader.find_namespace([topics.odometry(r) for r in config.robots], namespace)
    config = image_bags.in_bag(reader, config, where)
    robots = image_bags.with_images(reader, config, where)
    if not robots:
        raise image_bags.nothing_in(reader, config, where)
    result = Result({robot: Made() for robot in robots})

    def refuse(error: InputError) -> None:
        what = str(error).partition(":")[0]
        result.dropped[what] += 1
        if result.dropped[what] == 1:
            warn(f"dropped {error}")

    cameras = Cameras(config, robots, refuse)
    copied, result.left_out = _copied(reader, cameras, where, config, keep_images)
    inputs = {absolute(topic.name, where): topic for topic in cameras.inputs}
    total = reader.summary.message_count
    with BagWriter(out) as writer:
        made = _Made(writer, where, config, result, refuse)
        for done, record in enumerate(reader, start=1):
            made.begin(record)
            if record.topic in copied:
                writer.write(copied[record.topic], record.stamp_ns, record.data)
            if record.topic in inputs:
                made.write(cameras.take(inputs[record.topic], record.data))
            on_progress(done, total)
        made.write(cameras.rest())
    return result


def _copied(
    reader: BagReader, cameras: Cameras, where: str, config: Config, keep_images: bool
) -> tuple[Mapping[str, Topic], list[str]]:
    """Topics to copy, by their names, and the names of those that cannot be."""
    made = MADE_OF_TAGS if config.camera.tags.on_robots else MADE
    replaced = [kind(robot) for robot in cameras.robots for kind in made] + [topics.FUSION_CONFIG]
    unwanted = {absolute(topic.name, where) for topic in replaced}
    if not keep_images:
        unwanted |= {absolute(topic.name, where) for topic in cameras.pictures}
    wanted = {topic.name: topic for topic in reader.summary.topics if topic.name not in unwanted}
    unknown = sorted(name for name, topic in wanted.items() if not wire.is_known(topic.type))
    return {name: topic for name, topic in wanted.items() if name not in unknown}, unknown


class _Made:
    """Writes what pairs show, at the time of the record that was read last."""

    def __init__(
        self,
        writer: BagWriter,
        where: str,
        config: Config,
        result: Result,
        refuse: Callable[[InputError], None],
    ) -> None:
        self._writer, self._where, self._config = writer, where, config
        self._result, self._refuse = result, refuse
        self._now_ns: int | None = None

    def begin(self, record: Record) -> None:
        """A record was read; the configuration comes before the first."""
        if self._now_ns is None:
            text = scenario_file.to_yaml(**{SECTION: self._config})
            self._put(topics.FUSION_CONFIG, record.stamp_ns, wire.encode_text(text))
        self._now_ns = record.stamp_ns

    def write(self, looks: Iterable[Look]) -> None:
        """Look at pairs and write what they show."""
        for look in looks:
            try:
                sight = see(look, self._config)
            except InputError as error:
                self._refuse(error)
                continue
            made = self._result.robots[look.robot]
            made.pairs += 1
            made.matched += sight.seen.counts.kept + sight.seen.counts.surplus
            made.observations += len(sight.seen.positions)
            for topic, data in sight.messages:
                self._put(topic, self._now_ns or 0, data)

    def _put(self, topic: Topic, stamp_ns: int, data: bytes) -> None:
        self._writer.write(topic._replace(name=absolute(topic.name, self._where)), stamp_ns, data)
