"""What cameras saw: some of a robot's left pictures, and where in them its observations are."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from msg_defs import topics, wire
from msg_defs.errors import InputError
from msg_defs.topics import Topic
from msg_defs.types import StepRecord
from multi_robot_slam.bags import BagReader, absolute

MOST_VIEWS = 60
"""Of one robot; of more keyframes, every n-th."""


@dataclass(frozen=True, eq=False)
class View:
    """A keyframe's small left picture, as messages."""

    stamp_ns: int
    observations: bytes
    """As on `<robot>/stereo/landmarks`."""
    picture: bytes
    """As on `<robot>/preview/image/compressed`."""
    calibration: bytes
    """As on `<robot>/preview/camera_info`."""

    def jpeg(self) -> bytes:
        """The picture as a file."""
        return wire.packed_image(self.picture, "preview")

    def size_px(self) -> tuple[int, int]:
        """Width and height of the picture."""
        info = wire.decode_camera_info(self.calibration, "preview")
        return info.width_px, info.height_px

    def points_px(self, robot: str) -> np.ndarray:
        """(B, 2) column and row of each observation in the picture."""
        info = wire.decode_camera_info(self.calibration, "preview")
        x, y, z = wire.decode_observations(self.observations, robot, "").positions.T
        p = info.projection
        return np.column_stack([p[0, 2] + p[0, 0] * x / z, p[1, 2] - p[1, 1] * y / z])

    def messages(self, robot: str) -> list[tuple[Topic, bytes]]:
        """All of it, to be recorded."""
        data = (self.observations, self.picture, self.calibration)
        return [*zip(topics_of(robot), data, strict=True)]


Views = Mapping[str, Sequence[View]]
"""Of each robot that has any, by time."""


def topics_of(robot: str) -> tuple[Topic, Topic, Topic]:
    """Where the parts of a robot's views are."""
    return topics.observations(robot), topics.preview(robot), topics.preview_info(robot)


class ViewChoice:
    """Takes a robot's views as they come and keeps every n-th, `MOST_VIEWS` at most."""

    def __init__(self) -> None:
        self._kept: dict[str, list[View]] = {}
        self._every: dict[str, int] = {}
        self._taken: dict[str, int] = {}

    def add(self, robot: str, stamp_ns: int, messages: Iterable[tuple[Topic, bytes]]) -> None:
        """Take what was told of a robot's next pair; without a preview there is no view."""
        view = _view(robot, stamp_ns, dict(messages))
        if view:
            self._add(robot, view)

    def _add(self, robot: str, view: View) -> None:
        kept, every = self._kept.setdefault(robot, []), self._every.setdefault(robot, 1)
        number = self._taken.get(robot, 0)
        self._taken[robot] = number + 1
        if number % every:
            return
        kept.append(view)
        if len(kept) > MOST_VIEWS:
            del kept[1::2]
            self._every[robot] = 2 * every

    def views(self) -> Views:
        """Those that were kept."""
        return {robot: tuple(kept) for robot, kept in self._kept.items()}


def load(
    reader: BagReader, robots: Iterable[str], steps: Sequence[StepRecord], namespace: str = ""
) -> Views:
    """Views of the keyframes among `steps` that were recorded; what is damaged is left out."""
    counts = reader.summary.counts
    seen = [r for r in robots if counts.get(absolute(topics.preview(r).name, namespace))]
    chosen = {robot: _chosen(steps, robot) for robot in seen}
    parts: dict[tuple[str, int], dict[Topic, bytes]] = {}
    of_topic = {topic: robot for robot in seen for topic in topics_of(robot)}
    for topic, data in reader.only(of_topic, namespace) if seen else ():
        robot = of_topic[topic]
        try:
            stamp_ns = wire.peek_stamp(data, topic.name)
        except InputError:
            continue
        if stamp_ns in chosen[robot]:
            parts.setdefault((robot, stamp_ns), {})[topic] = data
    found: dict[str, list[View]] = {robot: [] for robot in seen}
    for (robot, stamp_ns), own in sorted(parts.items()):
        if view := _view(robot, stamp_ns, own):
            found[robot].append(view)
    return {robot: tuple(views) for robot, views in found.items() if views}


def _view(robot: str, stamp_ns: int, messages: Mapping[Topic, bytes]) -> View | None:
    """The view of these messages, if none is missing."""
    parts = [messages.get(topic) for topic in topics_of(robot)]
    whole = [part for part in parts if part is not None]
    return View(stamp_ns, *whole) if len(whole) == len(parts) else None


def _chosen(steps: Sequence[StepRecord], robot: str) -> set[int]:
    """Stamps of a robot's keyframes, every n-th where they are many."""
    stamps = [s.stamp_ns for s in steps if any(f.robot == robot for f in s.frames)]
    return set(stamps[:: max(1, -(-len(stamps) // MOST_VIEWS))])
