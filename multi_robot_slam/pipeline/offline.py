"""Bag in, estimates out, as fast as the filter goes; no ROS."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from msg_defs.topics import Topic
from msg_defs.types import Estimate, Event, PoseSample, StepRecord
from multi_robot_slam import runs
from multi_robot_slam.bags import BagReader, absolute
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.pipeline import decoding, image_bags, refinement
from multi_robot_slam.pipeline.cameras import Look
from multi_robot_slam.pipeline.image_bags import Cameras, OnSight
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.pipeline.sights import Sight

OnStep = Callable[[StepRecord], None]
OnProgress = Callable[[int, int], None]
"""Told how many messages have been handled, and how many there are."""


def _raise(error: InputError) -> None:
    raise error


def events(
    bag: Path,
    config: Config,
    refuse: Callable[[InputError], None] = _raise,
    namespace: str | None = None,
    on_sight: OnSight = lambda look, sight: None,
    on_read: Callable[[], None] = lambda: None,
) -> Iterator[Event]:
    """What the robots of `config` sent, in the order it was recorded.

    Of robots whose pictures were recorded and whose observations were not, pairs of pictures are
    the frames; they are looked at when they are used (`EncodedObservations`).

    Parameters
    ----------
    refuse : called for each message that is damaged or not what its topic says.
    namespace : in which the robots were recorded, `/fleet`; the root is `/`. By default the only
        one in which odometry or observations of theirs are.
    on_sight : called for each pair when it is looked at.
    on_read : called for each message that was read (`count`).

    Raises
    ------
    InputError : there is nothing of them in the bag, or in several namespaces.

    """
    decoders = decoding.inputs(config)
    reader, found = BagReader(bag), set()
    where = reader.find_namespace(_inputs(config), namespace)
    config = image_bags.in_bag(reader, config, where)
    cameras = Cameras(config, image_bags.without_clouds(reader, config, where), refuse)
    for topic, data in reader.only({*decoders, *cameras.views}, where):
        found.add(topic)
        on_read()
        looks: list[Look] = []
        if topic in cameras.views:
            looks = cameras.take(topic, data)
        else:
            _, decode = decoders[topic]
            try:
                event = decode(data)
            except InputError as error:
                refuse(error)
                continue
            yield event
            if isinstance(event, PoseSample):
                looks = cameras.move(event)
        yield from image_bags.frames(looks, config, on_sight, refuse)
    yield from image_bags.frames(cameras.rest(), config, on_sight, refuse)
    seeing = {*cameras.robots, *(r for r in config.robots if topics.observations(r) in found)}
    if not any(topics.odometry(robot) in found for robot in seeing):
        raise InputError(
            f"{bag} has nothing to estimate from: expected "
            f"{', '.join(absolute(topic.name, where) for topic in decoders)}; its topics are "
            f"{reader.found()}; record these topics, or name the robots in the configuration"
        )


def _inputs(config: Config) -> list[Topic]:
    """The topics by which a namespace is known."""
    kinds = (topics.odometry, topics.observations)
    return [kind(robot) for robot in config.robots for kind in kinds]


def recorded_config(bag: Path, namespace: str | None = None) -> Config | None:
    """The configuration the fusion published while the bag was recorded, if there was one.

    `namespace` is that of the fusion; by default the only one in which there is a configuration,
    and `InputError` where there are several.
    """
    reader = BagReader(bag)
    where = reader.find_namespace([topics.FUSION_CONFIG], namespace)
    for _, data in reader.only([topics.FUSION_CONFIG], where):
        return scenario_file.from_yaml(Config, wire.decode_text(data), SECTION, str(bag))
    return None


def estimate(
    bag: Path,
    config: Config,
    warn: Callable[[str], None],
    on_progress: OnProgress = lambda done, total: None,
    refine: bool = False,
    yardstick: bool = False,
    namespace: str | None = None,
    scenario: str | None = None,
) -> runs.Run:
    """Run the filter over the bag; `warn` is called with a line for each message that is dropped.

    The rest as for `estimate_by`.
    """
    pipeline = Pipeline(config, warn, keeps_frames=refine or yardstick)
    return estimate_by(pipeline, bag, on_progress, refine, yardstick, namespace, scenario)


def estimate_by(
    pipeline: Pipeline,
    bag: Path,
    on_progress: OnProgress = lambda done, total: None,
    refine: bool = False,
    yardstick: bool = False,
    namespace: str | None = None,
    scenario: str | None = None,
) -> runs.Run:
    """Run a new pipeline over the bag; to refine, and for the yardstick, it must keep frames.

    Parameters
    ----------
    on_progress : called after each step.
    refine : whether to smooth over the best particle's associations at the end.
    yardstick : whether also over the true ones, if they are known.
    namespace : in which the team was recorded (`events`).
    scenario : name or file of the scenario the configuration comes from, for `result.json`.

    """
    config = pipeline.config
    where = BagReader(bag).find_namespace(_inputs(config), namespace)
    predictions = runs.Predictions()
    read = Tally()
    seen = runs.ViewChoice()

    def keep(look: Look, sight: Sight) -> None:
        seen.add(look.robot, look.pair.stamp_ns, sight.messages)

    sent = events(bag, config, pipeline.refuse, where, keep, read.add)
    total = count(bag, config, where)
    steps = run_through(
        pipeline, sent, lambda step: on_progress(read.count, total), predictions.add
    )
    run = assemble(pipeline, runs.recorded(bag, config.robots, where), steps, predictions)
    run = replace(run, views=seen.views(), provenance=runs.here(scenario))
    return refinement.complete(run, pipeline, with_refined=refine, with_yardstick=yardstick)


class Tally:
    """How often something happened."""

    count = 0

    def add(self) -> None:
        """It happened once more."""
        self.count += 1


def count(bag: Path, config: Config, namespace: str) -> int:
    """How many messages of the robots of `config` the bag holds in a namespace."""
    reader = BagReader(bag)
    config = image_bags.in_bag(reader, config, namespace)
    cameras = Cameras(config, image_bags.without_clouds(reader, config, namespace), _raise)
    wanted = {*decoding.inputs(config), *cameras.views}
    return sum(reader.summary.counts.get(absolute(t.name, namespace), 0) for t in wanted)


def run_through(
    pipeline: Pipeline,
    sent: Iterable[Event],
    on_step: OnStep = lambda step: None,
    on_prediction: Callable[[Estimate], None] = lambda estimate: None,
) -> list[StepRecord]:
    """Feed the pipeline with all events that were `sent`, and end it; the steps."""
    steps = []
    for event in sent:
        done = pipeline.handle(event)
        for step in done:
            on_step(step)
        steps += done
        if prediction := pipeline.predict(event):
            on_prediction(prediction)
    return steps + pipeline.finish()


def assemble(
    pipeline: Pipeline,
    recording: runs.Recorded,
    steps: list[StepRecord],
    predictions: runs.Predictions,
) -> runs.Run:
    """The run of a pipeline that has ended: what it made in these `steps` of the recording.

    `predictions` are what it published in between.
    """
    return runs.assemble(
        pipeline.config,
        recording,
        steps,
        pipeline.trajectories(),
        pipeline.landmark_map(),
        pipeline.dropped,
        pipeline.frames(),
        predictions.by_robot(),
    )


def load(folder: Path, namespace: str | None = None) -> runs.Run:
    """The run in `folder` (`runs.load`), with the yardstick where the associations are known.

    A run that does not have it with it needs the frames for it and not the estimates: one particle
    puts them in order. Where no start is known, they are in no common frame.
    """
    run = runs.load(folder, namespace)
    has_it = any(len(robot.yardstick.stamps_ns) for robot in run.robots.values())
    frames = sum(len(step.frames) for step in run.steps)
    is_known = run.observation_truth and run.config.are_known.any()
    if has_it or run.bag is None or not is_known or frames > refinement.MAX_FRAMES:
        return run
    one = replace(run.config.filter, particles=1, mapping=True)
    pipeline = Pipeline(replace(run.config, filter=one))
    run_through(pipeline, events(run.bag, run.config, pipeline.refuse, run.namespace))
    return refinement.measured(run, pipeline.lineage(), pipeline.team)
