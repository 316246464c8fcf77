"""The files of a bag: MCAP, whole or broken off, and whatever else rosbags reads.

Each gives its records by time, equal times in the order written, and a summary of them.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property, lru_cache
from operator import attrgetter
from pathlib import Path
from typing import IO, NamedTuple

from mcap.reader import SeekingReader
from mcap.reader import Summary as McapSummary
from mcap.records import Channel, Message, Schema, Statistics
from mcap.stream_reader import StreamReader
from rosbags.interfaces import ConnectionExtRosbag2, Qos, QosDurability, QosReliability
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.metadata import parse_qos

from msg_defs.errors import InputError
from msg_defs.topics import LATCHED, SENSOR, STREAM, Topic
from multi_robot_slam.bags import chunks
from multi_robot_slam.bags.chunks import Record

MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format 3\0"


class Summary(NamedTuple):
    """What a file holds."""

    topics: frozenset[Topic]
    """Names are absolute."""
    counts: Mapping[str, int]
    """Messages of each topic, by its name; a topic without any may be missing."""
    span_ns: tuple[int, int] | None
    """When the first and the last message were recorded; None without messages."""

    @property
    def message_count(self) -> int:
        """Messages of all topics."""
        return sum(self.counts.values())


def merged(summaries: list[Summary]) -> Summary:
    """The summary of several files together."""
    spans = [summary.span_ns for summary in summaries if summary.span_ns]
    return Summary(
        frozenset().union(*(summary.topics for summary in summaries)),
        sum((Counter(summary.counts) for summary in summaries), Counter()),
        (min(first for first, _ in spans), max(last for _, last in spans)) if spans else None,
    )


class McapFile:
    """One MCAP file. One that breaks off is read up to there."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = path.stat().st_size
        with path.open("rb") as stream:
            stream.seek(max(0, self.size - len(MCAP_MAGIC)))
            end = stream.read()
        self.is_complete = self.size > len(MCAP_MAGIC) and end == MCAP_MAGIC

    def records(self, names: Collection[str] | None = None) -> Iterator[Record]:
        """Those of the topics `names`, by default all."""
        with self.path.open("rb") as stream, _damage_reported(self.path):
            if self.is_complete:
                yield from chunks.records(stream, self._index, names)
            else:
                salvaged = _Salvage(stream, self.size).records()
                wanted = (r for r in salvaged if names is None or r.topic in names)
                yield from sorted(wanted, key=attrgetter("stamp_ns"))

    @cached_property
    def summary(self) -> Summary:
        """From the file's own summary where it has one, else from all its messages."""
        with _damage_reported(self.path):
            found = self._index if self.is_complete else None
        if found is None or found.statistics is None:
            return self._scan[0]
        return _declared(found, found.statistics)

    @property
    def _index(self) -> McapSummary | None:
        """The file's own summary, if it has one."""
        state = self.path.stat()
        return _summary_section(self.path.resolve(), state.st_size, state.st_mtime_ns)

    @property
    def loss(self) -> str:
        """What is known about the part that is missing; empty when the file is complete."""
        if self.is_complete:
            return ""
        summary, used = self._scan
        first, last = summary.span_ns or (0, 0)
        return (
            f"{self.path} breaks off: its recorder was killed or failed, or it was cut; "
            f"{summary.message_count} messages over {(last - first) / 1e9:.1f} s are read, "
            f"{self.size - used} bytes after them hold no whole one"
        )

    @cached_property
    def _scan(self) -> tuple[Summary, int]:
        """What the messages tell, and the size up to the end of the last whole record [bytes]."""
        stamps: list[int] = []
        counts: Counter[str] = Counter()
        with self.path.open("rb") as stream, _damage_reported(self.path):
            salvage = _Salvage(stream, self.size)
            for record in salvage.records():
                stamps.append(record.stamp_ns)
                counts[record.topic] += 1
            topics = {
                _topic(channel, salvage.schemas.get(channel.schema_id))
                for channel in salvage.channels.values()
            }
        span_ns = (min(stamps), max(stamps)) if stamps else None
        return Summary(frozenset(topics), counts, span_ns), salvage.used


@lru_cache(maxsize=4)
def _summary_section(path: Path, size: int, changed_ns: int) -> McapSummary | None:
    """What a file as it was changed last says of itself: read once, however often it is asked."""
    with path.open("rb") as stream:
        return SeekingReader(stream).get_summary()


class _Salvage:
    """Every whole message of an MCAP stream up to where it breaks off, in the order written."""

    def __init__(self, stream: IO[bytes], size: int) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.used = 0
        self._stream = stream
        self._size = size

    def records(self) -> Iterator[Record]:
        reader = StreamReader(self._stream, record_size_limit=self._size, validate_crcs=True)
        found = reader.records
        while True:
            try:
                record = next(found)
            except Exception:  # StopIteration, and anything can come of half a record
                return
            self.used = self._stream.tell()
            match record:
                case Schema():
                    self.schemas[record.id] = record
                case Channel():
                    self.channels[record.id] = record
                case Message():
                    channel = self.channels[record.channel_id]
                    yield _record(self.schemas.get(channel.schema_id), channel, record)


class RosbagsFile:
    """A sqlite3 file, or a whole bag that rosbag2 compressed."""

    loss = ""

    def __init__(self, path: Path) -> None:
        self.path = path

    def records(self, names: Collection[str] | None = None) -> Iterator[Record]:
        """Those of the topics `names`, by default all."""
        with _damage_reported(self.path), Reader(self.path) as reader:
            messages = (
                Record(connection.topic, connection.msgtype, stamp_ns, bytes(data))
                for connection, stamp_ns, data in reader.messages()
                if names is None or connection.topic in names
            )
            # rosbags gives one file of a folder after the other.
            is_folder = self.path.is_dir()
            yield from sorted(messages, key=attrgetter("stamp_ns")) if is_folder else messages

    @cached_property
    def summary(self) -> Summary:
        with _damage_reported(self.path), Reader(self.path) as reader:
            topics = {
                Topic(c.topic, c.msgtype, _kind(c.ext.offered_qos_profiles))
                for c in reader.connections
                if isinstance(c.ext, ConnectionExtRosbag2)
            }
            counts = {name: about.msgcount for name, about in reader.topics.items()}
            span_ns = (reader.start_time, reader.end_time - 1) if reader.message_count else None
            return Summary(frozenset(topics), counts, span_ns)


@contextmanager
def _damage_reported(path: Path) -> Iterator[None]:
    """Readers raise anything from `struct.error` to `KeyError` on damaged bytes."""
    try:
        yield
    except Exception as error:
        text = " ".join(str(error).split())
        raise InputError(
            f"{path} is damaged: {type(error).__name__}: {text}; copy or record it again"
        ) from None


def _declared(summary: McapSummary, statistics: Statistics) -> Summary:
    span_ns = statistics.message_start_time, statistics.message_end_time
    counts: Counter[str] = Counter()
    for number, count in statistics.channel_message_counts.items():
        counts[summary.channels[number].topic] += count
    return Summary(
        frozenset(_topic(c, summary.schemas.get(c.schema_id)) for c in summary.channels.values()),
        counts,
        span_ns if statistics.message_count else None,
    )


def _record(schema: Schema | None, channel: Channel, message: Message) -> Record:
    return Record(channel.topic, schema.name if schema else "", message.log_time, message.data)


def _topic(channel: Channel, schema: Schema | None) -> Topic:
    offered = channel.metadata.get("offered_qos_profiles", "")
    return Topic(channel.topic, schema.name if schema else "", _offered_kind(offered))


@lru_cache(maxsize=64)
def _offered_kind(profiles: str) -> str:
    """The kind that a channel's metadata tell; many channels tell the same, as YAML."""
    try:
        return _kind(parse_qos(profiles))
    except Exception:  # not rosbag2's: the quality of service is a hint
        return _kind([])


def _kind(profiles: list[Qos]) -> str:
    """The nearest of the three kinds of `msg_defs.topics` to what a publisher offered."""
    if any(qos.durability is QosDurability.TRANSIENT_LOCAL for qos in profiles):
        return LATCHED
    if any(qos.reliability is QosReliability.BEST_EFFORT for qos in profiles):
        return SENSOR
    return STREAM
