"""The configuration of a run: the bag's, a scenario's, and what single settings override."""

from collections.abc import Callable, Mapping
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from msg_defs import scenario_file, topics
from msg_defs.errors import InputError
from multi_robot_slam.bags import BagReader, absolute
from multi_robot_slam.config import FOR_PICTURES, SECTION, Config
from multi_robot_slam.pipeline import image_bags, offline

OF_THE_RECORDING = (
    *("robots", "start_poses", "start_sigma", "start_sigmas", "start_at"),
    *("camera_frame", "mount", "mounts", "sightings", "camera"),
)
"""Facts about the robots and what they sent, which another way to estimate does not change."""
OF_EACH_ROBOT = ("start_poses", "start_sigmas", "mounts")
"""Those of them with one entry for each robot, in the order of `robots`; the last may be empty."""
INSTEAD = {"mount": "mounts", "start_sigma": "start_sigmas"}
"""What is stated for all robots, and what was known of each that it replaces."""


class Recording(NamedTuple):
    """What to estimate from."""

    bag: Path
    namespace: str | None = None
    """In which the team was recorded; by default the only one."""


def of_run(
    recording: Recording,
    scenario: str | None,
    overrides: Mapping,
    warn: Callable[[str], None],
) -> Config:
    """How to estimate from a recording.

    `overrides` win over `scenario`, and what these two state explicitly wins over the configuration
    in the bag. Of what a scenario leaves out, the facts about the robots (`OF_THE_RECORDING`) are
    the bag's, the rest are defaults; where pictures are looked at, those for pictures. Without a
    scenario everything left out is the bag's.

    Raises
    ------
    InputError : without a configuration, or when a robot that is stated was not recorded. One that
        only the bag's own configuration names is told to `warn`, and so are robots that were
        recorded and are not named.

    """
    bag, namespace = recording
    recorded = offline.recorded_config(bag, namespace)
    if scenario is None and recorded is None:
        raise _unconfigured(recording)
    stated, source = _stated(scenario)
    stated = merged(stated, overrides)
    known = {} if recorded is None else scenario_file.to_plain(recorded)
    if scenario is not None:
        known = {name: value for name, value in known.items() if name in OF_THE_RECORDING}
    values = merged(_for_robots(known, stated, bag), stated)
    config = scenario_file.from_mapping(Config, values, source)
    if _has_pictures(recording, config):
        config = scenario_file.from_mapping(Config, merged(of_pictures(), values), source)
    _check_robots(recording, config, "robots" in stated, warn)
    return config


def _unconfigured(recording: Recording) -> InputError:
    """The complaint that nothing is known of the robots; what can be known is in the remedy."""
    reader, namespace = BagReader(recording.bag), recording.namespace or ""
    names = sorted(_with_odometry(reader, namespace))
    starts = ", ".join("[x, y, yaw]" for _ in names)
    remedy = "name one with --scenario"
    if names:
        remedy += (
            f", a file with `{SECTION}: {{robots: [{', '.join(names)}], start_poses: [{starts}], "
            "mount: {...}}`"
        )
    return InputError(
        f"{recording.bag} carries no configuration on "
        f"{absolute(topics.FUSION_CONFIG.name, namespace)}, its topics are {reader.found()}: "
        f"{remedy}"
    )


def _has_pictures(recording: Recording, config: Config) -> bool:
    """Observations of some robot are what the front end sees in its pictures."""
    reader = BagReader(recording.bag)
    expected = [topics.odometry(robot) for robot in config.robots]
    where = reader.find_namespace(expected, recording.namespace)
    return bool(image_bags.with_images(reader, config, where))


def of_pictures() -> dict:
    """Settings of the filter for what the front end sees in pictures, unless others are stated."""
    stated, _ = _stated(FOR_PICTURES)
    return {"filter": stated["filter"]}


def merged(below: Mapping, above: Mapping) -> dict:
    """Nested values of both; where both have one it is that of `above`."""
    values = dict(below)
    for name, value in above.items():
        is_group = isinstance(value, Mapping) and isinstance(values.get(name), Mapping)
        values[name] = merged(values[name], value) if is_group else value
    return values


def _stated(scenario: str | None) -> tuple[dict, str]:
    """What the scenario states, and its name for complaints."""
    if scenario is None:
        return {}, "--set"
    path = scenario_file.find_scenario(scenario)
    source = f"{path}: {SECTION}"
    return scenario_file.sections(scenario_file.read(path), str(path))[SECTION], source


def _for_robots(known: Mapping, stated: Mapping, bag: Path) -> dict:
    """What is `known`, for the robots that are `stated` if any are.

    What is stated for all robots replaces what was known of each.
    """
    own = dict(known)
    for key in INSTEAD.keys() & stated.keys():
        own.pop(INSTEAD[key], None)
    names = stated.get("robots")
    if not isinstance(names, list):
        return own
    for key in (key for key in OF_EACH_ROBOT if own.get(key) and key not in stated):
        entries = dict(zip(known["robots"], known[key], strict=True))
        if strangers := [str(name) for name in names if name not in entries]:
            raise InputError(
                f"{key}: the configuration in {bag} has none of {', '.join(strangers)}, its robots "
                f"are {', '.join(entries)}; state {key} of each robot, or correct robots"
            )
        own[key] = [entries[name] for name in names]
    return own


def _check_robots(
    recording: Recording, config: Config, are_stated: bool, warn: Callable[[str], None]
) -> None:
    """Make sure that the bag has something of every robot, and of no others.

    A bag that has nothing of any of them is refused when it is read.
    """
    reader = BagReader(recording.bag)
    recorded = {topic.name for topic in reader.summary.topics}
    expected = {r: [topics.odometry(r), topics.observations(r)] for r in config.robots}
    where = reader.find_namespace([*chain(*expected.values())], recording.namespace)
    for robot in image_bags.with_images(reader, config, where):
        expected[robot].remove(topics.observations(robot))
    absent = {}
    for robot, inputs in expected.items():
        names = [absolute(topic.name, where) for topic in inputs]
        if missing := [name for name in names if name not in recorded]:
            absent[robot] = f"{recording.bag} has no {' and no '.join(missing)}"
    for robot, what in absent.items():
        if are_stated:
            raise InputError(
                f"robots: {robot} was not recorded: {what}; its topics are {reader.found()}; "
                "correct robots"
            )
        if len(absent) < len(config.robots):
            warn(f"{robot} was not recorded: {what}")
    others = sorted(_with_odometry(reader, where) - set(config.robots))
    if others and len(absent) < len(config.robots):
        warn(
            f"{recording.bag} has more robots, which are not estimated: {', '.join(others)}; "
            "name them in robots"
        )


def _with_odometry(reader: BagReader, namespace: str) -> set[str]:
    """The robots whose odometry is in the bag, by its topics in the `namespace`."""
    recorded = {topic.name: topic.type for topic in reader.summary.topics}
    root = absolute("", namespace)
    names = {name.removeprefix(root).partition("/")[0] for name in recorded}
    kinds = {name: topics.odometry(name) for name in names}
    return {
        name
        for name, odometry in kinds.items()
        if recorded.get(absolute(odometry.name, namespace)) == odometry.type
    }
