"""Bags: rosbag2's folders of MCAP files, written and read without ROS.

A bag is complete once it is closed, but what was flushed before survives a kill: the reader takes
everything up to the point where a file breaks off, and says so.
"""

import heapq
import os
import time
from collections import Counter
from collections.abc import Iterator
from operator import attrgetter
from pathlib import Path
from typing import IO, NamedTuple

import yaml
from mcap.reader import SeekingReader
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer

from msg_defs.errors import InputError
from msg_defs.topics import LATCHED, SENSOR, STREAM, Topic
from msg_defs.wire import message_schema

METADATA = "metadata.yaml"
METADATA_VERSION = 9
"""The one Jazzy writes."""

FLUSH_PERIOD_S = 0.1
CHUNK_BYTES = 64 * 1024

_MAGIC = b"\x89MCAP0\r\n"

_FOREVER = {"sec": 9223372036, "nsec": 854775807}
_QOS = {
    STREAM: {"depth": 1000, "reliability": "reliable", "durability": "volatile"},
    LATCHED: {"depth": 1, "reliability": "reliable", "durability": "transient_local"},
    SENSOR: {"depth": 1, "reliability": "best_effort", "durability": "volatile"},
}


class Record(NamedTuple):
    """One message of a bag."""

    topic: str
    """Absolute, as recorded: `/robot_1/odom`."""
    type: str
    stamp_ns: int
    """When it was recorded."""
    data: bytes
    """CDR."""


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
    """The messages of a bag folder or a lone `.mcap` file, by time, then in the order written.

    What is missing or broken without making the rest useless is said in `warnings`.
    """

    def __init__(self, path: Path) -> None:
        path = Path(path)
        if not path.exists():
            raise InputError(f"no bag {path}: there is no such file or folder")
        self._files = [_File(file) for file in _mcap_files(path)]
        self.warnings = [
            f"{file.path} breaks off: its recorder was killed, or it was cut; "
            "read up to there, not beyond"
            for file in self._files
            if not file.is_complete
        ]
        if path.is_dir():
            self.warnings += _compare(path / METADATA, self._files)

    def __iter__(self) -> Iterator[Record]:
        return heapq.merge(*self._files, key=attrgetter("stamp_ns"))


def _mcap_files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    files = sorted(path.glob("*.mcap"))
    if not files:
        raise InputError(f"{path} is no bag: there is no .mcap file in it")
    return files


class _File:
    """One MCAP file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with path.open("rb") as stream:
                start = stream.read(len(_MAGIC))
                size = stream.seek(0, os.SEEK_END)
                stream.seek(max(0, size - len(_MAGIC)))
                end = stream.read()
        except OSError as error:
            raise InputError(f"cannot read the bag {path}: {error.strerror}") from None
        if not size:
            raise InputError(f"{path} is empty; record it again")
        if start != _MAGIC:
            raise InputError(f"{path} is no MCAP file; name a bag folder or an .mcap file")
        self.is_complete = size > len(_MAGIC) and end == _MAGIC

    def __iter__(self) -> Iterator[Record]:
        with self.path.open("rb") as stream:
            if self.is_complete:
                yield from self._checked(stream)
            else:
                yield from sorted(_salvage(stream), key=attrgetter("stamp_ns"))

    def message_count(self) -> int | None:
        """As the file's own summary says it; None when there is none."""
        with self.path.open("rb") as stream:
            try:
                summary = SeekingReader(stream).get_summary()
            except Exception as error:
                raise self._damaged(error) from None
        return summary and summary.statistics and summary.statistics.message_count

    def _checked(self, stream: IO[bytes]) -> Iterator[Record]:
        messages = SeekingReader(stream, validate_crcs=True).iter_messages()
        while True:
            try:
                record = _record(*next(messages))
            except StopIteration:
                return
            except Exception as error:
                raise self._damaged(error) from None
            yield record

    def _damaged(self, error: Exception) -> InputError:
        """MCAP's reader raises anything from `struct.error` to `KeyError` on damaged bytes."""
        return InputError(
            f"{self.path} is damaged: {type(error).__name__}: {error}; copy or record it again"
        )


def _salvage(stream: IO[bytes]) -> Iterator[Record]:
    """Every whole message up to where the file breaks off."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    size = os.fstat(stream.fileno()).st_size
    records = StreamReader(stream, record_size_limit=size, validate_crcs=True).records
    while True:
        try:
            record = next(records)
        except StopIteration:
            return
        except Exception:  # anything can come of half a record
            return
        match record:
            case Schema():
                schemas[record.id] = record
            case Channel():
                channels[record.id] = record
            case Message():
                channel = channels[record.channel_id]
                yield _record(schemas.get(channel.schema_id), channel, record)


def _record(schema: Schema | None, channel: Channel, message: Message) -> Record:
    return Record(channel.topic, schema.name if schema else "", message.log_time, message.data)


def _compare(path: Path, files: list[_File]) -> list[str]:
    """What the metadata at `path` and the `files` beside it disagree about."""
    try:
        information = yaml.safe_load(path.read_text())["rosbag2_bagfile_information"]
        listed = {Path(str(name)).name for name in information["relative_file_paths"]}
        promised = information["message_count"]
        compression = str(information.get("compression_mode") or "none")
    except (OSError, yaml.YAMLError, UnicodeDecodeError, LookupError, TypeError) as error:
        return [f"{path} is unusable ({type(error).__name__}); read the .mcap files without it"]
    if compression.lower() != "none":
        raise InputError(
            f"{path}: compression_mode '{compression}' is not read here; convert the bag to one "
            "without, which may be compressed inside its MCAP file"
        )
    found = {file.path.name for file in files}
    warnings = [f"{path} lists {name}, which is missing" for name in sorted(listed - found)]
    warnings += [f"{path} does not list {name}; read it too" for name in sorted(found - listed)]
    counts = [file.message_count() for file in files if file.is_complete]
    if len(counts) == len(files) and None not in counts and sum(counts) != promised:
        warnings.append(f"{path} promises {promised} messages, the files hold {sum(counts)}")
    return warnings
