"""A run that is over: everything that was published of it, in the order it was recorded."""

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import fields
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from msg_defs import topics
from msg_defs.errors import InputError
from msg_defs.topics import Topic
from msg_defs.types import LandmarkMap, StepRecord
from multi_robot_slam import runs
from multi_robot_slam.bags import BagReader, absolute
from multi_robot_slam.runs import estimates, loading, result
from multi_robot_slam.watch.inputs import Input, inputs
from multi_robot_slam.watch.watched import Watched

MOST_VERSIONS = 200
"""Kept of each map, path, picture and set of particles; of more, every n-th."""


class News(NamedTuple):
    """One message as it was recorded."""

    stamp_ns: int
    take: Callable[[Watched, Any], None]
    value: Any


class Recording:
    """What was known at any time of a run, in a bag or in the folder that `run` or `demo` left."""

    def __init__(self, path: Path, namespace: str | None = None) -> None:
        """`InputError` where there is no run at `path`, or none of a fusion in `namespace`."""
        reader = BagReader(_bag(path))
        found = reader.find_namespace([topics.FUSION_CONFIG], namespace)
        self.config = estimates.config_in(reader, found)
        self.warnings = reader.warnings
        news = [*_news(reader, inputs(self.config.robots), found)]
        steps = [one for one in news if isinstance(one.value, StepRecord)]
        if not steps:
            raise estimates.none_in(reader, [topics.STEPS], found)
        self.begin_ns, self.end_ns = steps[0].stamp_ns, news[-1].stamp_ns
        if runs.is_offline(path):
            news += [*_walls_of(path, self.begin_ns), *_growing(news, steps)]
        self._news = sorted(news, key=attrgetter("stamp_ns"))
        self._stamps = [one.stamp_ns for one in self._news]
        self._next = 0
        self._watched = Watched(self.config)

    def at(self, stamp_ns: int) -> Watched:
        """What was known at a time of the recording, that included."""
        end = bisect_right(self._stamps, stamp_ns)
        if end < self._next:
            self._next, self._watched = 0, Watched(self.config)
        for one in self._news[self._next : end]:
            one.take(self._watched, one.value)
        self._next = end
        return self._watched


def _bag(path: Path) -> Path:
    """The bag with what the fusion published in a run."""
    if runs.is_offline(path):
        return path / estimates.FOLDER
    return path / loading.BAG if (path / loading.BAG).exists() else path


def _news(reader: BagReader, wanted: dict[Topic, Input], namespace: str) -> Iterator[News]:
    """What was recorded of the topics `wanted`, by time; what is damaged is passed over."""
    by_name = {absolute(topic.name, namespace): topic for topic in wanted}
    reader.require(wanted, namespace)
    counts, seen = reader.summary.counts, Counter[str]()
    for record in reader.records(by_name.keys()):
        topic, place = by_name[record.topic], seen[record.topic]
        seen[record.topic] += 1
        every = -(-counts[record.topic] // MOST_VERSIONS) if wanted[topic].is_whole else 1
        if place % every and place != counts[record.topic] - 1:
            continue
        with suppress(InputError):
            input = wanted[topic]
            yield News(record.stamp_ns, input.take, input.decode(record.data))


def _walls_of(folder: Path, stamp_ns: int) -> Iterator[News]:
    """The walls in the bag that an offline run was estimated from, if it is there still."""
    figures = result.figures_in(folder)
    bag = Path(figures.get("bag") or "")
    if bag.exists():
        wanted = {topics.GROUND_TRUTH_WALLS: inputs(())[topics.GROUND_TRUTH_WALLS]}
        for one in _news(BagReader(bag), wanted, figures.get("namespace") or ""):
            yield one._replace(stamp_ns=stamp_ns)


def _growing(news: list[News], steps: list[News]) -> Iterator[News]:
    """The map while it grew: of what an offline run publishes at its end, what had been seen."""
    ends = [one for one in news if isinstance(one.value, LandmarkMap)][-1:]
    every = -(-len(steps) // MOST_VERSIONS)
    seen: set[int] = set()
    for place, (stamp_ns, _, step) in enumerate(steps):
        seen.update(landmark for frame in step.frames for landmark in frame.landmarks.tolist())
        for end in ends:
            if place % every == 0 and stamp_ns < end.stamp_ns:
                yield News(stamp_ns, end.take, _those_of(end.value, seen))


def _those_of(landmarks: LandmarkMap, seen: set[int]) -> LandmarkMap:
    rows = [row for row, landmark in enumerate(landmarks.ids.tolist()) if landmark in seen]
    return LandmarkMap(*(getattr(landmarks, field.name)[rows] for field in fields(LandmarkMap)))
