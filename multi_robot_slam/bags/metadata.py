"""`metadata.yaml`, which rosbag2 puts beside the files of a bag: written, read, and doubted."""

import os
from collections import Counter
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import NamedTuple

import yaml

from msg_defs.topics import BULKY, LATCHED, SENSOR, STREAM, Topic
from msg_defs.wire import message_schema
from multi_robot_slam.bags.names import absolute

FILE = "metadata.yaml"
VERSION = 9
"""The one Jazzy writes."""

_FOREVER = {"sec": 9223372036, "nsec": 854775807}
_QOS: Mapping[str, Mapping[str, object]] = {
    STREAM: {"depth": 1000, "reliability": "reliable", "durability": "volatile"},
    LATCHED: {"depth": 1, "reliability": "reliable", "durability": "transient_local"},
    SENSOR: {"depth": 1, "reliability": "best_effort", "durability": "volatile"},
    BULKY: {"depth": 10, "reliability": "reliable", "durability": "volatile"},
}


def write(folder: Path, file: str, counts: Counter[Topic], span_ns: tuple[int, int]) -> None:
    """Describe the one MCAP `file` of the bag `folder`; replaced at once, so whole at any time."""
    information = _information(file, counts, span_ns)
    new = folder / f"{FILE}.new"
    new.write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
    os.replace(new, folder / FILE)


def _information(file: str, counts: Counter[Topic], span_ns: tuple[int, int]) -> dict[str, object]:
    return {
        "version": VERSION,
        "storage_identifier": "mcap",
        **_extent(counts, span_ns),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": absolute(topic.name),
                    "type": topic.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [quality(topic)],
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


def _extent(counts: Counter[Topic], span_ns: tuple[int, int]) -> dict[str, object]:
    first, last = span_ns
    return {
        "starting_time": {"nanoseconds_since_epoch": first},
        "duration": {"nanoseconds": last - first},
        "message_count": counts.total(),
    }


def quality(topic: Topic) -> dict[str, object]:
    """The quality of service that a topic's publishers offer, in rosbag2's words."""
    return {
        "history": "keep_last",
        **_QOS[topic.qos],
        "deadline": dict(_FOREVER),
        "lifespan": dict(_FOREVER),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_FOREVER),
        "avoid_ros_namespace_conventions": False,
    }


class Metadata(NamedTuple):
    """What the metadata of a bag folder promise."""

    problem: str = ""
    """Why they are unusable; empty when they are not."""
    listed: frozenset[str] = frozenset()
    """Names of the files."""
    message_count: int = 0
    is_compressed: bool = False
    """By rosbag2, as whole files or message by message."""


def read(path: Path) -> Metadata:
    """What the file at `path` promises; one that cannot be read promises nothing and says why."""
    try:
        information = yaml.safe_load(path.read_text())["rosbag2_bagfile_information"]
        return Metadata(
            listed=frozenset(Path(str(name)).name for name in information["relative_file_paths"]),
            message_count=int(information["message_count"]),
            is_compressed=str(information.get("compression_mode") or "none").lower() != "none",
        )
    except (OSError, yaml.YAMLError, ValueError, LookupError, TypeError) as error:
        return Metadata(f"{path} is unusable ({type(error).__name__}); read the files without it")


def disagreements(path: Path, promised: Metadata, found: Collection[str], count: int) -> list[str]:
    """Between what was `promised` at `path` and the files `found` beside it: `count` messages."""
    if promised.problem:
        return [promised.problem]
    files = frozenset(found)
    told = [f"{path} lists {name}, which is missing" for name in sorted(promised.listed - files)]
    told += [
        f"{path} does not list {name}; read it too" for name in sorted(files - promised.listed)
    ]
    if promised.message_count != count:
        told.append(f"{path} promises {promised.message_count} messages, the files hold {count}")
    return told
