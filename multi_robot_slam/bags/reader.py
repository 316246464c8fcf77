"""Reads bags: whatever rosbag2 writes, without ROS, and as far as a broken one goes."""

import heapq
from collections.abc import Collection, Iterator
from functools import cached_property
from operator import attrgetter
from pathlib import Path

from msg_defs.errors import InputError
from msg_defs.topics import Topic
from multi_robot_slam.bags import metadata
from multi_robot_slam.bags.chunks import Record
from multi_robot_slam.bags.files import (
    MCAP_MAGIC,
    SQLITE_MAGIC,
    McapFile,
    RosbagsFile,
    Summary,
    merged,
)
from multi_robot_slam.bags.names import absolute, clean, namespaces


class BagReader:
    """The messages of a bag, by time, then in the order written.

    A bag is a folder, with or without metadata, or a lone file: MCAP, sqlite3, or compressed by
    rosbag2. What is missing or broken without making the rest useless is said in `warnings`.
    """

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise InputError(f"no bag {path}: there is no such file or folder")
        self._promised = metadata.read(self.path / metadata.FILE)
        try:
            self._files = _files(self.path, self._promised.is_compressed)
        except OSError as error:
            raise InputError(f"cannot read the bag {self.path}: {error.strerror}") from None

    def __iter__(self) -> Iterator[Record]:
        return self.records()

    def records(self, names: Collection[str] | None = None) -> Iterator[Record]:
        """Those of the topics `names`, absolute; by default all."""
        files = [file.records(names) for file in self._files]
        if len(files) == 1:
            return files[0]
        return heapq.merge(*files, key=attrgetter("stamp_ns"))

    def only(self, wanted: Collection[Topic], namespace: str = "") -> Iterator[tuple[Topic, bytes]]:
        """The messages of the topics that are `wanted`, which must have the recorded types.

        Relative topics are those in `namespace` (`find_namespace`).
        """
        self.require(wanted, namespace)
        by_name = {absolute(topic.name, namespace): topic for topic in wanted}
        for record in self.records(by_name.keys()):
            yield by_name[record.topic], record.data

    def by_topic(self, wanted: Collection[Topic], namespace: str = "") -> dict[Topic, list[bytes]]:
        """All messages of each topic that is `wanted`, by time (`only`)."""
        messages: dict[Topic, list[bytes]] = {topic: [] for topic in wanted}
        for topic, data in self.only(wanted, namespace):
            messages[topic].append(data)
        return messages

    def find_namespace(self, wanted: Collection[Topic], chosen: str | None = None) -> str:
        """In which namespace the topics `wanted` were recorded; the root is the empty string.

        `chosen`, or the only one that has any of them; the root where none has. `InputError` where
        several have some.
        """
        if chosen is not None:
            return clean(chosen)
        found = namespaces(self.summary.topics, wanted)
        if len(found) > 1:
            names = ", ".join(name or "/" for name in found)
            raise InputError(
                f"{self.path} has the team's topics in the namespaces {names}; "
                f"choose one: --namespace {found[-1]}"
            )
        return found[0] if found else ""

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
        count = self.summary.message_count
        if losses and not self._promised.message_count:
            count = 0  # it breaks off, so nobody has counted
        found = {file.path.name for file in self._files}
        path = self.path / metadata.FILE
        return [*losses, *metadata.disagreements(path, self._promised, found, count)]

    def require(self, wanted: Collection[Topic], namespace: str = "") -> None:
        """`InputError` when nothing was recorded, or another type on a topic that is `wanted`."""
        if not self.summary.message_count:
            raise InputError(f"{self.path} holds no messages; record it again")
        types = {absolute(topic.name, namespace): topic.type for topic in wanted}
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


def _files(path: Path, is_compressed: bool) -> list[McapFile | RosbagsFile]:
    if not path.is_dir():
        return [_file(path)]
    if is_compressed or any(path.glob("*.zstd")):
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
