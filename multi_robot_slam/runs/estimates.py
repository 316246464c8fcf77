"""What the fusion published of a run: read from a live run's bag, written into an offline run's."""

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from operator import itemgetter
from pathlib import Path

import numpy as np

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from msg_defs.topics import Topic
from msg_defs.types import Estimate, FrameCount, StepRecord, Trajectory
from msg_defs.wire import Estimates
from multi_robot_slam.bags import BagReader, BagWriter, absolute
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.runs.run import Recorded, Run, assemble
from multi_robot_slam.runs.views import View

FOLDER = "estimates"
"""Name of the bag in the folder of an offline run."""

DROPPED = "dropped: "
"""Prefix of the keys under which the fusion's diagnostics count what was dropped, by reason."""

STATUS = "fusion"
"""Name of the status with these keys."""
ALWAYS_TOLD = "steps"
"""A key that a live fusion's status has whether or not anything was dropped."""

OF_ROBOT = f"{STATUS}: "
"""Prefix of the name of each robot's status."""
SEEN, USED = "frames", "keyframes"
"""Its keys that count the frames that could be used, and those that became steps."""

LATER_PATHS = {
    "mean": topics.mean_path,
    "refined": topics.refined_path,
    "yardstick": topics.yardstick_path,
}
"""Paths that are known at the end of a run alone: field of `RobotRun` -> topic."""

Messages = Mapping[Topic, list[bytes]]
"""Those of each topic, by time."""


def topics_of(robots: Iterable[str]) -> list[Topic]:
    """Everything that is read of the estimates of the team `robots`, but the configuration."""
    kinds = (topics.pose, topics.mean_pose, topics.path, *LATER_PATHS.values())
    own = [kind(robot) for robot in robots for kind in kinds]
    team = [topics.STEPS, topics.MAP_LANDMARKS, topics.REFINED_LANDMARKS, topics.DIAGNOSTICS]
    return [*team, *own]


def config_in(reader: BagReader, namespace: str = "") -> Config:
    """The configuration the fusion published; `InputError` when there is none."""
    for _, data in reader.only([topics.FUSION_CONFIG], namespace):
        source = f"{reader.path}: {absolute(topics.FUSION_CONFIG.name, namespace)}"
        return scenario_file.from_yaml(Config, wire.decode_text(data), SECTION, source)
    raise none_in(reader, [topics.FUSION_CONFIG], namespace)


def none_in(reader: BagReader, missing: Iterable[Topic], namespace: str = "") -> InputError:
    """The complaint that a bag holds no estimates, for these topics are `missing`."""
    names = ", ".join(absolute(topic.name, namespace) for topic in missing)
    return InputError(
        f"{reader.path} holds no estimates: {names} not in it, its topics are {reader.found()}; "
        "record the fusion's topics too, or estimate from the recording with "
        f"`multi_robot_slam run {reader.path}`"
    )


def join(reader: BagReader, messages: Messages, config: Config, recording: Recorded) -> Run:
    """The run whose estimates are `messages`, read from the bag of `reader`."""

    def last(kind: Callable[[str], Topic]) -> dict[str, Trajectory]:
        found = {robot: messages[kind(robot)] for robot in config.robots}
        return {robot: wire.decode_path(m[-1], robot) for robot, m in found.items() if m}

    missing = [topic for topic in (topics.STEPS, topics.MAP_LANDMARKS) if not messages[topic]]
    if not any(messages[topics.path(robot)] for robot in config.robots):
        missing += map(topics.path, config.robots)
    if missing:
        raise none_in(reader, missing, recording.namespace)
    steps, predicted = _published(messages, config.robots)
    run = assemble(
        config,
        recording,
        steps=steps,
        paths=last(topics.path),
        landmarks=wire.decode_map(messages[topics.MAP_LANDMARKS][-1]),
        dropped=dropped(messages[topics.DIAGNOSTICS]),
        frames=frames(messages[topics.DIAGNOSTICS], config.robots),
        predicted=predicted,
    )
    refined = messages[topics.REFINED_LANDMARKS]
    return replace(
        run.with_paths(**{later: last(kind) for later, kind in LATER_PATHS.items()}),
        refined_landmarks=wire.decode_map(refined[-1]) if refined else None,
    )


def dropped(messages: list[bytes]) -> dict[str, int]:
    """What the fusion counted last as dropped, by reason."""
    for status in _statuses(messages):
        counts = {k: v for k, v in status.values.items() if k.startswith(DROPPED)}
        is_ours = status.name == STATUS and (counts or ALWAYS_TOLD in status.values)
        if is_ours and all(count.isdecimal() for count in counts.values()):
            return {key.removeprefix(DROPPED): int(count) for key, count in counts.items()}
    return {}


def frames(messages: list[bytes], robots: tuple[str, ...]) -> dict[str, FrameCount]:
    """What became of each robot's frames by the fusion's last count, where it told that."""
    found: dict[str, FrameCount] = {}
    for status in _statuses(messages):
        robot = status.name.removeprefix(OF_ROBOT)
        counts = [status.values.get(key, "") for key in (SEEN, USED)]
        is_ours = status.name != robot and robot in robots and all(map(str.isdecimal, counts))
        if is_ours and robot not in found:
            found[robot] = FrameCount(*map(int, counts))
        if len(found) == len(robots):
            break
    return found


def _statuses(messages: list[bytes]) -> Iterator[wire.Status]:
    """All of `/diagnostics`, the last messages first.

    The topic belongs to all nodes of a system: what cannot be decoded is passed over.
    """
    for data in reversed(messages):
        try:
            _, statuses = wire.decode_diagnostics(data)
        except InputError:
            continue
        yield from statuses


def _published(
    messages: Messages, robots: tuple[str, ...]
) -> tuple[list[StepRecord], dict[str, Estimates]]:
    """The steps with the estimates on `pose` and `mean_pose`; what else each `pose` predicted."""
    poses = {robot: _Stream(messages[topics.pose(robot)], robot) for robot in robots}
    means = {robot: _Stream(messages[topics.mean_pose(robot)], robot) for robot in robots}
    steps = []
    for step in map(wire.decode_step, messages[topics.STEPS]):
        estimates = []
        for robot in (frame.robot for frame in step.frames):
            mean = means[robot].take(step.stamp_ns)
            if estimate := poses[robot].take(step.stamp_ns):
                mean_pose = None if mean is None else mean.pose
                estimates.append(replace(estimate, mean=mean_pose))
        steps.append(replace(step, estimates=tuple(estimates)))
    return steps, {robot: own.rest() for robot, own in poses.items()}


class _Stream:
    """What was published on one topic, of which each step takes its own."""

    def __init__(self, messages: list[bytes], robot: str) -> None:
        self._robot = robot
        self._all = wire.decode_estimates(messages, robot)
        # of several of one stamp the last: a step comes after what was predicted for it
        self._rows = {stamp: row for row, stamp in enumerate(self._all.stamps_ns.tolist())}
        self._is_taken = np.zeros(len(self._all.stamps_ns), bool)

    def take(self, stamp_ns: int) -> Estimate | None:
        """What the step at `stamp_ns` published."""
        row = self._rows.get(stamp_ns)
        if row is None:
            return None
        self._is_taken[row] = True
        return Estimate(self._robot, stamp_ns, self._all.poses[row], self._all.covariances[row])

    def rest(self) -> Estimates:
        """What no step has taken: predictions."""
        return Estimates(*(values[~self._is_taken] for values in self._all))


def write(run: Run, folder: Path) -> None:
    """Write what the fusion would have published into the bag `estimates` in `folder`.

    And the run's views: the pictures may have been looked at by nobody but this run.
    """
    end_ns = run.steps[-1].stamp_ns if run.steps else 0
    with BagWriter(Path(folder) / FOLDER) as bag:
        text = scenario_file.to_yaml(**{SECTION: run.config})
        bag.write(topics.FUSION_CONFIG, end_ns, wire.encode_text(text))
        for stamp_ns, topic, data in heapq.merge(*_streams(run), key=itemgetter(0)):
            bag.write(topic, stamp_ns, data)
        for topic, data in _at_the_end(run, end_ns):
            bag.write(topic, end_ns, data)


def _streams(run: Run) -> list[Iterator[tuple[int, Topic, bytes]]]:
    """Stamp, topic and bytes by stamp; of one stamp predictions come before the step."""
    predicted = (_predictions(name, robot.predicted) for name, robot in run.robots.items())
    seen = (_views(name, views) for name, views in run.views.items())
    return [*predicted, *seen, _of_steps(run.steps)]


def _views(robot: str, views: Iterable[View]) -> Iterator[tuple[int, Topic, bytes]]:
    for view in views:
        for topic, data in view.messages(robot):
            yield view.stamp_ns, topic, data


def _predictions(robot: str, predicted: Estimates) -> Iterator[tuple[int, Topic, bytes]]:
    topic = topics.pose(robot)
    for stamp_ns, pose, covariance in zip(*predicted, strict=True):
        estimate = Estimate(robot, int(stamp_ns), pose, covariance)
        yield estimate.stamp_ns, topic, wire.encode_estimate(estimate)


def _of_steps(steps: Iterable[StepRecord]) -> Iterator[tuple[int, Topic, bytes]]:
    for step in steps:
        yield step.stamp_ns, topics.STEPS, wire.encode_step(step)
        for estimate in step.estimates:
            for topic, data in _of_estimate(estimate):
                yield step.stamp_ns, topic, data


def _of_estimate(estimate: Estimate) -> Iterator[tuple[Topic, bytes]]:
    yield topics.pose(estimate.robot), wire.encode_estimate(estimate)
    if estimate.mean is not None:
        yield topics.mean_pose(estimate.robot), wire.encode_mean(estimate)


def _at_the_end(run: Run, end_ns: int) -> Iterator[tuple[Topic, bytes]]:
    counts = {f"{DROPPED}{reason}": str(count) for reason, count in run.dropped.items()}
    statuses = [wire.Status(STATUS, counts)]
    for name, count in run.frames.items():
        frames = {SEEN: str(count.seen), USED: str(count.used)}
        statuses.append(wire.Status(f"{OF_ROBOT}{name}", frames))
    yield topics.DIAGNOSTICS, wire.encode_diagnostics(end_ns, statuses)
    yield topics.MAP_LANDMARKS, wire.encode_map(run.landmarks, end_ns)
    if run.refined_landmarks is not None:
        yield topics.REFINED_LANDMARKS, wire.encode_map(run.refined_landmarks, end_ns)
    for name, robot in run.robots.items():
        for attribute, kind in {"path": topics.path, **LATER_PATHS}.items():
            path = getattr(robot, attribute)
            if len(path.stamps_ns):
                yield kind(name), wire.encode_path(path, end_ns)
