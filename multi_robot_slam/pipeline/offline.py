"""Bag in, estimates out, as fast as the filter goes; no ROS."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from msg_defs.types import Event, StepRecord
from multi_robot_slam.bags import BagReader, absolute
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.pipeline import refinement
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs import run as runs


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
        decoders[topics.odometry(robot)] = (robot, wire.decode_pose)
        decoders[topics.observations(robot)] = (robot, wire.decode_observations)
        if config.sightings:
            decoders[topics.sightings(robot)] = (robot, wire.decode_sightings)
    reader, found = BagReader(bag), set()
    for topic, data in reader.only(decoders):
        robot, decode = decoders[topic]
        found.add(topic)
        try:
            event = decode(data, robot)
        except InputError as error:
            refuse(error)
        else:
            yield event
    if not any({topics.odometry(r), topics.observations(r)} <= found for r in config.robots):
        raise InputError(
            f"{bag} has nothing to estimate from: expected "
            f"{', '.join(absolute(topic.name) for topic in decoders)}; its topics are "
            f"{reader.found()}; record these topics, or name the robots in the configuration"
        )


def recorded_config(bag: Path) -> Config | None:
    """The configuration the fusion published while the bag was recorded, if there was one."""
    for _, data in BagReader(bag).only([topics.FUSION_CONFIG]):
        return scenario_file.from_yaml(Config, wire.decode_text(data), SECTION, str(bag))
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

    An offline run has it with it. A live one's needs the frames and not the estimates: one particle
    puts them in order.
    """
    run = runs.load(folder)
    if runs.is_offline(folder) or not run.observation_truth:
        return run
    pipeline = Pipeline(replace(run.config, filter=replace(run.config.filter, particles=1)))
    for event in events(run.bag, run.config, pipeline.refuse):
        pipeline.handle(event)
    pipeline.finish()
    return refinement.with_yardstick(run, pipeline.lineage())
