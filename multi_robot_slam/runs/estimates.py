"""What the fusion published of a run: read from a live run's bag, written into an offline run's."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from msg_defs.topics import Topic
from msg_defs.types import Estimate, StepRecord, Trajectory
from multi_robot_slam.bags import BagReader, BagWriter, absolute
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.runs.run import Recorded, Run, assemble

FOLDER = "estimates"
"""Name of the bag in the folder of an offline run."""

DROPPED = "dropped: "
"""Prefix of the keys under which the fusion's diagnostics count what was dropped, by reason."""

STATUS = "fusion"
"""Name of the status with these keys."""
ALWAYS_TOLD = "steps"
"""A key that a live fusion's status has whether or not anything was dropped."""

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
    run = assemble(
        config,
        recording,
        steps=_steps(messages, config.robots),
        paths=last(topics.path),
        landmarks=wire.decode_map(messages[topics.MAP_LANDMARKS][-1]),
        dropped=dropped(messages[topics.DIAGNOSTICS]),
    )
    refined = messages[topics.REFINED_LANDMARKS]
    return replace(
        run.with_paths(**{later: last(kind) for later, kind in LATER_PATHS.items()}),
        refined_landmarks=wire.decode_map(refined[-1]) if refined else None,
    )


def dropped(messages: list[bytes]) -> dict[str, int]:
    """What the fusion counted last as dropped, by reason.

    `/diagnostics` belongs to all nodes of a system: what others say there is passed over.
    """
    for data in reversed(messages):
        try:
            _, statuses = wire.decode_diagnostics(data)
        except InputError:
            continue
        for status in statuses:
            counts = {k: v for k, v in status.values.items() if k.startswith(DROPPED)}
            is_ours = status.name == STATUS and (counts or ALWAYS_TOLD in status.values)
            if is_ours and all(count.isdecimal() for count in counts.values()):
                return {key.removeprefix(DROPPED): int(count) for key, count in counts.items()}
    return {}


def _steps(messages: Messages, robots: Iterable[str]) -> list[StepRecord]:
    """The steps, with the estimates that were published on each robot's `pose`, `mean_pose`."""
    robots = tuple(robots)
    published = _published(messages, robots, topics.pose)
    for key, mean in _published(messages, robots, topics.mean_pose).items():
        if key in published:
            published[key] = replace(published[key], mean=mean.pose)
    steps = []
    for step in map(wire.decode_step, messages[topics.STEPS]):
        keys = [(frame.robot, step.stamp_ns) for frame in step.frames]
        estimates = tuple(published[key] for key in keys if key in published)
        steps.append(replace(step, estimates=estimates))
    return steps


def _published(
    messages: Messages, robots: tuple[str, ...], kind: Callable[[str], Topic]
) -> dict[tuple[str, int], Estimate]:
    """Robot and stamp -> what was published."""
    return {
        (robot, estimate.stamp_ns): estimate
        for robot in robots
        for estimate in (wire.decode_estimate(d, robot) for d in messages[kind(robot)])
    }


def write(run: Run, folder: Path) -> None:
    """Write what the fusion would have published into the bag `estimates` in `folder`."""
    end_ns = run.steps[-1].stamp_ns if run.steps else 0
    with BagWriter(Path(folder) / FOLDER) as bag:
        text = scenario_file.to_yaml(**{SECTION: run.config})
        bag.write(topics.FUSION_CONFIG, end_ns, wire.encode_text(text))
        for step in run.steps:
            bag.write(topics.STEPS, step.stamp_ns, wire.encode_step(step))
            for estimate in step.estimates:
                for topic, data in _of_estimate(estimate):
                    bag.write(topic, step.stamp_ns, data)
        for topic, data in _at_the_end(run, end_ns):
            bag.write(topic, end_ns, data)


def _of_estimate(estimate: Estimate) -> Iterator[tuple[Topic, bytes]]:
    yield topics.pose(estimate.robot), wire.encode_estimate(estimate)
    if estimate.mean is not None:
        yield topics.mean_pose(estimate.robot), wire.encode_mean(estimate)


def _at_the_end(run: Run, end_ns: int) -> Iterator[tuple[Topic, bytes]]:
    counts = {f"{DROPPED}{reason}": str(count) for reason, count in run.dropped.items()}
    yield topics.DIAGNOSTICS, wire.encode_diagnostics(end_ns, [wire.Status(STATUS, counts)])
    yield topics.MAP_LANDMARKS, wire.encode_map(run.landmarks, end_ns)
    if run.refined_landmarks is not None:
        yield topics.REFINED_LANDMARKS, wire.encode_map(run.refined_landmarks, end_ns)
    for name, robot in run.robots.items():
        for attribute, kind in {"path": topics.path, **LATER_PATHS}.items():
            path = getattr(robot, attribute)
            if len(path.stamps_ns):
                yield kind(name), wire.encode_path(path, end_ns)
