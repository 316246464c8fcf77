"""Bag in, estimates out, as fast as the filter goes; no ROS."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from msg_defs import settings, topics, wire
from msg_defs.errors import InputError
from msg_defs.types import Event, StepRecord
from multi_robot_slam import refinement, runs
from multi_robot_slam.bags import BagReader, absolute
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.pipeline import Pipeline


def _raise(error: InputError) -> None:
    raise error


def events(
    bag: Path, config: Config, refuse: Callable[[InputError], None] = _raise
) -> Iterator[Event]:
    """What the robots of `config` sent, in the order it was recorded.

    `InputError` when the bag has none; `refuse` is called for each message that is damaged or
    not what its topic says.
    """
    decoders = {}
    for robot in config.robots:
        decoders[absolute(topics.odometry(robot).name)] = (robot, wire.decode_pose)
        decoders[absolute(topics.observations(robot).name)] = (robot, wire.decode_observations)
        if config.sightings:
            decoders[absolute(topics.sightings(robot).name)] = (robot, wire.decode_sightings)
    found = set()
    for record in BagReader(bag):
        if record.topic in decoders:
            robot, decode = decoders[record.topic]
            found.add(record.topic)
            try:
                event = decode(record.data, robot)
            except InputError as error:
                refuse(error)
            else:
                yield event
    if len(found) < 2:
        raise InputError(
            f"{bag} has nothing to estimate from: expected {', '.join(decoders)}; "
            "record these topics, or name the robots in the configuration"
        )


def recorded_config(bag: Path) -> Config | None:
    """The configuration the fusion published while the bag was recorded, if there was one."""
    name = absolute(topics.FUSION_CONFIG.name)
    for record in BagReader(bag):
        if record.topic == name:
            return settings.from_yaml(Config, wire.decode_text(record.data), SECTION, str(bag))
    return None


def estimate(
    bag: Path,
    config: Config,
    warn: Callable[[str], None],
    on_step: Callable[[StepRecord], None] = lambda step: None,
    refine: bool = False,
) -> runs.Run:
    """Run the filter over the bag.

    Parameters
    ----------
    warn : called with a line for each message that is dropped.
    on_step : called with each step as it is done.
    refine : whether to smooth over the best particle's associations at the end.
    """
    pipeline = Pipeline(config, warn)
    steps = []
    for event in events(bag, config, pipeline.refuse):
        done = pipeline.handle(event)
        for step in done:
            on_step(step)
        steps += done
    steps += pipeline.finish()
    run = runs.assemble(
        config,
        runs.recorded(bag, config.robots),
        steps,
        pipeline.trajectories(),
        pipeline.landmark_map(),
        pipeline.dropped,
    )
    return refinement.complete(run, pipeline, with_refined=refine)


def load(folder: Path) -> runs.Run:
    """The run in `folder` (`runs.load`), with the yardstick where the associations are known.

    The yardstick needs the frames and not the estimates: one particle puts them in order.
    """
    run = runs.load(folder)
    has_yardstick = any(len(robot.batch.stamps_ns) for robot in run.robots.values())
    if has_yardstick or not run.observation_truth:
        return run
    pipeline = Pipeline(replace(run.config, filter=replace(run.config.filter, particles=1)))
    for event in events(run.bag, run.config, pipeline.refuse):
        pipeline.handle(event)
    pipeline.finish()
    return refinement.with_yardstick(run, pipeline.lineage())
