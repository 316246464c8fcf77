"""Writes bags: rosbag2 folders with one MCAP file."""

import contextlib
import time
from collections import Counter
from pathlib import Path
from types import TracebackType

import yaml
from mcap.well_known import MessageEncoding, Profile, SchemaEncoding
from mcap.writer import CompressionType, Writer

from msg_defs.errors import InputError
from msg_defs.topics import Topic
from msg_defs.wire import message_schema
from multi_robot_slam.bags import metadata
from multi_robot_slam.bags.names import absolute

FLUSH_PERIOD_S = 0.1
CHUNK_BYTES = 64 * 1024


class BagWriter:
    """Writes the bag `folder`, which must not exist; use it in a `with` statement.

    A block that ends by an exception leaves a bag that breaks off there, and says so when read.
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

    def break_off(self) -> None:
        """Leave what was written as it is: it can be read, and the bag says that it breaks off."""
        if self._file.closed:
            return
        with contextlib.suppress(OSError):  # why it breaks off may be that the disk is full
            self.flush()
        with contextlib.suppress(OSError):
            self._file.close()

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.break_off()

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
                "offered_qos_profiles": yaml.safe_dump([metadata.quality(topic)], sort_keys=False),
                "topic_type_hash": type_hash,
            },
        )

    def _write_metadata(self) -> None:
        file = Path(self._file.name).name
        metadata.write(self._folder, file, self._counts, self._span_ns or (0, 0))
