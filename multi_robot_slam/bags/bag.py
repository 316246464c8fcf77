"""Bags: rosbag2's folders, written as MCAP and read as whatever rosbag2 writes, without ROS.

A bag is complete once it is closed, but what was flushed before survives a kill: the reader takes
everything up to the point where a file breaks off, and says so.
"""

import heapq
import os
import time
from collections import Counter
from collections.abc import Collection, Iterator
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import yaml
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer

from msg_defs.errors import InputError
from msg_defs.topics import LATCHED, SENSOR, STREAM, Topic
from msg_defs.wire import message_schema
from multi_robot_slam.bags.files import (
    MCAP_MAGIC,
    SQLITE_MAGIC,
    McapFile,
    Record,
    RosbagsFile,
    Summary,
    merged,
)

METADATA = "metadata.yaml"
METADATA_VERSION = 9
"""The one Jazzy writes."""

FLUSH_PERIOD_S = 0.1
CHUNK_BYTES = 64 * 1024

_FOREVER = {"sec": 9223372036, "nsec": 854775807}
_QOS = {
    STREAM: {"depth": 1000, "reliability": "reliable", "durability": "volatile"},
    LATCHED: {"depth": 1, "reliability": "reliable", "durability": "transient_local"},
    SENSOR: {"depth": 1, "reliability": "best_effort", "durability": "volatile"},
}


def absolute(name: str) -> str:
    """A topic's name as bags have it, with a leading slash."""
    return name if name.startswith("/") else f"/{name}"


class BagWriter:
    """Writes the bag `folder`, which must not exist; use it in a `with` statement.

    A message later than `FLUSH_PERIOD_S` after the last flush is flushed at once with all before
    it. So while messages flow a kill costs at most that period; who wants the same in a pause
    calls `flush`.
    """

    def __init__(self, folder: Path) -> None:
        folder = Path(folder)
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            raise InputError(f"{folder} exists already; remove it or name another bag") from None
        except OSError as error:
            raise InputError(f"cannot write the bag {folder}: {error.strerror}") from None
        self._folder = folder
        self._file = (folder / f"{folder.resolve().name}_0.mcap").open("xb")
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE)
        self._writer.start(Profile.ROS2)
        self._schemas: dict[str, int] = {}
        self._channels: dict[Topic, int] = {}
        self._counts: Counter[Topic] = Counter()
        self._span_ns: tuple[int, int] | None = None
        self.flush()
        self._write_metadata()
        self._flushed_s = -float("inf")

    def write(self, topic: Topic, stamp_ns: int, data: bytes) -> None:
        """Append one message; its time in the bag is `stamp_ns`."""
        if topic not in self._channels:
            self._channels[topic] = self._add_channel(topic)
        self._writer.add_message(
            self._channels[topic], log_time=stamp_ns, data=data, publish_time=stamp_ns
        )
        self._counts[topic] += 1
        first, last = self._span_ns or (stamp_ns, stamp_ns)
        self._span_ns = min(first, stamp_ns), max(last, stamp_ns)
        if time.monotonic() - self._flushed_s > FLUSH_PERIOD_S:
            self.flush()

    def flush(self) -> None:
        """Hand everything written so far to the operating system: it survives a kill."""
        self._writer.flush()
        self._flushed_s = time.monotonic()

    def close(self) -> None:
        """Complete the bag; a second call does nothing."""
        if self._file.closed:
            return
        self._writer.finish()
        self._file.close()
        self._write_metadata()

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _add_channel(self, topic: Topic) -> int:
        text, type_hash = message_schema(topic.type)
        if topic.type not in self._schemas:
            self._schemas[topic.type] = self._writer.register_schema(
                topic.type, SchemaEncoding.ROS2, text.encode()
            )
        return self._writer.register_channel(
            absolute(topic.name),
            MessageEncoding.CDR,
            self._schemas[topic.type],
            {
                "offered_qos_profiles": yaml.safe_dump([_qos(topic)], sort_keys=False),
                "topic_type_hash": type_hash,
            },
        )

    def _write_metadata(self) -> None:
        """Replace the file in one go, so that it is whole at any time."""
        file = Path(self._file.name).name
        information = _metadata(file, self._counts, self._span_ns or (0, 0))
        new = self._folder / f"{METADATA}.new"
        new.write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
        os.replace(new, self._folder / METADATA)


def _metadata(file: str, counts: Counter[Topic], span_ns: tuple[int, int]) -> dict:
    return {
        "version": METADATA_VERSION,
        "storage_identifier": "mcap",
        **_extent(counts, span_ns),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": absolute(topic.name),
                    "type": topic.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [_qos(topic)],
                    "type_description_hash": message_schema(topic.type)[1],
                },
                "message_count": count,
            }
            for topic, count in counts.items()
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file],
        "files": [{"path": file, **_extent(counts, span_ns)}],
        "custom_data": None,
        "ros_distro": "jazzy",
    }


def _extent(counts: Counter[Topic], span_ns: tuple[int, int]) -> dict:
    first, last = span_ns
    return {
        "starting_time": {"nanoseconds_since_epoch": first},
        "duration": {"nanoseconds": last - first},
        "message_count": counts.total(),
    }


def _qos(topic: Topic) -> dict:
    return {
        "history": "keep_last",
        **_QOS[topic.qos],
        "deadline": dict(_FOREVER),
        "lifespan": dict(_FOREVER),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_FOREVER),
        "avoid_ros_namespace_conventions": False,
    }


class BagReader:
    """The messages of a bag, by time, then in the order written.

    A bag is a folder, with or without metadata, or a lone file: MCAP, sqlite3, or compressed by
    rosbag2. What is missing or broken without making the rest useless is said in `warnings`.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise InputError(f"no bag {path}: there is no such file or folder")
        self._metadata = _read_metadata(self.path / METADATA)
        try:
            self._files = _files(self.path, self._metadata)
        except OSError as error:
            raise InputError(f"cannot read the bag {self.path}: {error.strerror}") from None

    def __iter__(self) -> Iterator[Record]:
        return self.records()

    def records(self, names: Collection[str] | None = None) -> Iterator[Record]:
        """Those of the topics `names`, absolute; by default all."""
        files = (file.records(names) for file in self._files)
        return heapq.merge(*files, key=attrgetter("stamp_ns"))

    def only(self, wanted: Collection[Topic]) -> Iterator[tuple[Topic, bytes]]:
        """The messages of the topics that are `wanted`, which must have the recorded types."""
        self.require(wanted)
        by_name = {absolute(topic.name): topic for topic in wanted}
        for record in self.records(by_name.keys()):
            yield by_name[record.topic], record.data

    @cached_property
    def summary(self) -> Summary:
        """Topics, number of messages and time span of the whole bag."""
        return merged([file.summary for file in self._files])

    @cached_property
    def warnings(self) -> list[str]:
        """Where it breaks off, and what its metadata and its files disagree about."""
        losses = [file.loss for file in self._files if file.loss]
        is_read_by_its_files = all(file.path.parent == self.path for file in self._files)
        if not is_read_by_its_files:
            return losses
        path = self.path / METADATA
        return [*losses, *_disagreements(path, self._metadata, self._files)]

    def require(self, wanted: Collection[Topic]) -> None:
        """`InputError` when nothing was recorded, or another type on a topic that is `wanted`."""
        if not self.summary.count:
            raise InputError(f"{self.path} holds no messages; record it again")
        types = {absolute(topic.name): topic.type for topic in wanted}
        for topic in sorted(self.summary.topics):
            expected = types.get(topic.name, topic.type)
            if topic.type != expected:
                raise InputError(
                    f"{self.path}: {topic.name} was recorded as {topic.type or 'no type'}, "
                    f"expected is {expected}; publish it as that, or remap the topic"
                )

    def found(self) -> str:
        """The names of its topics, for a complaint."""
        return ", ".join(sorted({topic.name for topic in self.summary.topics})) or "none"


class _Metadata(NamedTuple):
    """What the metadata of a bag folder promise."""

    problem: str = ""
    """Why they are unusable; empty when they are not."""
    listed: frozenset[str] = frozenset()
    """Names of the files."""
    count: int = 0
    """Messages."""
    is_compressed: bool = False
    """By rosbag2, as whole files or message by message."""


def _read_metadata(path: Path) -> _Metadata:
    try:
        information = yaml.safe_load(path.read_text())["rosbag2_bagfile_information"]
        return _Metadata(
            listed=frozenset(Path(str(name)).name for name in information["relative_file_paths"]),
            count=int(information["message_count"]),
            is_compressed=str(information.get("compression_mode") or "none").lower() != "none",
        )
    except (OSError, yaml.YAMLError, ValueError, LookupError, TypeError) as error:
        return _Metadata(f"{path} is unusable ({type(error).__name__}); read the files without it")


def _files(path: Path, metadata: _Metadata) -> list[McapFile | RosbagsFile]:
    if not path.is_dir():
        return [_file(path)]
    if metadata.is_compressed or any(path.glob("*.zstd")):
        return [RosbagsFile(path)]
    files = sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
    if not files:
        raise InputError(f"{path} is no bag: there is no .mcap file in it, and no .db3 file")
    return [_file(file) for file in files]


def _file(path: Path) -> McapFile | RosbagsFile:
    with path.open("rb") as stream:
        start = stream.read(len(SQLITE_MAGIC))
    if not start:
        raise InputError(f"{path} is empty; record it again")
    if start.startswith(MCAP_MAGIC):
        return McapFile(path)
    if start == SQLITE_MAGIC and path.suffix == ".db3":
        return RosbagsFile(path)
    raise InputError(
        f"{path} is no MCAP file and no sqlite3 .db3 file; name a bag folder or one of these"
    )


def _disagreements(
    path: Path, metadata: _Metadata, files: list[McapFile | RosbagsFile]
) -> Iterator[str]:
    """Between the metadata at `path` and the `files` beside it."""
    if metadata.problem:
        yield metadata.problem
        return
    found = {file.path.name for file in files}
    for name in sorted(metadata.listed - found):
        yield f"{path} lists {name}, which is missing"
    for name in sorted(found - metadata.listed):
        yield f"{path} does not list {name}; read it too"
    count = merged([file.summary for file in files]).count
    is_unfinished = metadata.count == 0 and any(file.loss for file in files)
    if metadata.count != count and not is_unfinished:
        yield f"{path} promises {metadata.count} messages, the files hold {count}"
