"""A run that was taken apart in its middle, and put together, is the run that was not."""

import json
import random
from collections import deque
from dataclasses import fields, replace
from itertools import islice

import numpy as np
import pytest
import recordings

from msg_defs import wire
from msg_defs.errors import InputError
from msg_defs.types import EncodedObservations, PoseSample, Sightings
from multi_robot_slam.filter.settings import RejuvenationSettings
from multi_robot_slam.filter.state import State
from multi_robot_slam.pipeline import going_on, offline
from multi_robot_slam.pipeline.pipeline import Pipeline
from sim_world.scenario import Scenario

OFTEN = RejuvenationSettings(ancestors_below=0.5, delay_s=1.0, unknowns=150)
STEPS = 45


@pytest.fixture(scope="module", params=["known", "unknown"])
def recording(tmp_path_factory, request):
    """Configuration and events of a team that learns what it can, and whose frames settle."""
    bag = tmp_path_factory.mktemp("going_on") / "bag"
    scenario = Scenario(robots=2, observations=8)
    _, config = recordings.record(bag, scenario, steps=STEPS, particles=40, rejuvenation=OFTEN)
    noise = replace(config.filter.motion, scale_sigma=0.02)
    config = replace(
        config,
        start_sigma=(0.05, 0.02),
        sightings=True,
        filter=replace(config.filter, motion=noise),
    )
    if request.param == "unknown":  # the second robot is a piece of its own
        config = replace(config, start_poses=(config.start_poses[0], "unknown"))
    return config, list(with_sightings(offline.events(bag, config)))


def with_sightings(events):
    """Each robot also says that it sees nobody, with every other cloud; and one jumps."""
    for number, event in enumerate(events):
        yield event
        if not isinstance(event, PoseSample) and number % 2:
            nothing = np.empty((0, 3), np.float32), np.empty((0, 6), np.float32)
            yield Sightings(event.robot, event.stamp_ns, np.empty(0, np.uint32), *nothing)
        elif isinstance(event, PoseSample) and number % 50 == 30:
            yield replace(event, stamp_ns=event.stamp_ns + 1, pose=event.pose + 100)


def step_bytes(step):
    return wire.encode_step(replace(step, duration_ms=0.0))


def run(config, events, through=lambda number, pipeline: pipeline):
    """The steps as bytes, and all that is left at the end."""
    pipeline = Pipeline(config)
    steps = []
    for number, event in enumerate(events):
        steps += pipeline.handle(event)
        pipeline = through(number, pipeline)
    steps += pipeline.finish()
    rest = [wire.encode_map(pipeline.landmark_map(), 0), repr(sorted(pipeline.dropped.items()))]
    rest += [path.poses.tobytes() for path in pipeline.mean_trajectories().values()]
    rest += [repr(pipeline.frames()), repr(pipeline.lost()), repr(pipeline.settled)]
    return [*map(step_bytes, steps), *rest]


def there_and_back(pipeline):
    taken = going_on.taken_apart(pipeline)
    return going_on.put_back(taken.parts(), pipeline.warn)


def test_saved_and_loaded_in_its_middle_it_is_the_same_run(recording):
    config, events = recording
    whole = run(config, events)
    begun = []
    places = set(random.Random(0).sample(range(len(events)), 25))

    def through(number, pipeline):
        if number not in places:
            return pipeline
        begun.append(pipeline._particles._begun is not None)
        return there_and_back(pipeline)

    assert run(config, events, through) == whole
    assert set(begun) == {False, True}  # with a rejuvenation under way, and without
    assert run(replace(config, seed=1), events) != whole
    pipeline = Pipeline(config)
    for event in events:
        pipeline.handle(event)
    assert pipeline.settled
    assert (pipeline.noise.factors != 1).any()
    assert (pipeline._particles.state.scales.factors != 1).any()
    assert pipeline.dropped


def test_taking_apart_changes_nothing_and_what_comes_later_has_no_effect(recording):
    config, events = recording
    taken, others = deque(), []

    def through(number, pipeline):
        if number % 20 == 7:
            taken.append(going_on.taken_apart(pipeline))
            others.append(pipeline)
        if number % 20 == 17:  # the pipeline has gone on, as beside a thread that writes
            late, other = taken.popleft().parts(), others.pop()
            assert other is pipeline
            replay = going_on.put_back(late, pipeline.warn)
            steps = [s for event in events[number - 9 : number + 1] for s in replay.handle(event)]
            assert replay._particles.state.steps == pipeline._particles.state.steps
            same = replay._particles.state.poses.tobytes()
            assert same == pipeline._particles.state.poses.tobytes()
            assert all(step.frames for step in steps)
        return pipeline

    assert run(config, events, through) == run(config, events)


def whole_graph(pipeline):
    parts = going_on.taken_apart(pipeline).parts()
    return parts.table, {dtype: own.tobytes() for dtype, own in parts.buffers.items()}


def test_put_together_it_is_taken_apart_into_the_same(recording):
    config, events = recording
    pipeline = Pipeline(config)
    for event in islice(events, 150):
        pipeline.handle(event)
    assert whole_graph(there_and_back(pipeline)) == whole_graph(pipeline)


def test_no_attribute_is_forgotten(recording):
    """Whatever is added to the state is kept; who says what to keep says all there is."""
    config, events = recording
    pipeline = Pipeline(config)
    for event in islice(events, 60):
        pipeline.handle(event)
    table = json.loads(going_on.taken_apart(pipeline).parts().table)
    kept = {row[1]: {name for name, _ in row[2:]} for row in table if row[0] == "object"}
    assert kept["state.State"] == {field.name for field in fields(State)}
    particles = pipeline._particles
    for one in (particles, particles.state.landmarks, particles.state.history):
        assert one.__getstate__().keys() == vars(one).keys()
    assert kept["pipeline.Pipeline"] == vars(pipeline).keys()


def test_a_state_of_other_attributes_is_refused(recording):
    config, _ = recording
    parts = going_on.taken_apart(Pipeline(config)).parts()
    for text in ('["origin_step",', '["log_weights",'):
        assert text in parts.table
        other = parts._replace(table=parts.table.replace(text, '["of_old",'))
        with pytest.raises(InputError, match="has other attributes"):
            going_on.put_back(other, print)


def test_pictures_that_wait_cannot_be_saved(recording):
    config, events = recording
    pipeline = Pipeline(config)
    seen = next(event for event in events if isinstance(event, EncodedObservations))
    pipeline.handle(replace(seen, decode=lambda: None))
    with pytest.raises(InputError, match="cannot be saved now"):
        going_on.taken_apart(pipeline)


def test_what_is_no_pipeline_is_refused(recording):
    config, _ = recording
    parts = going_on.Taken(config, going_on.KNOWN, {}).parts()
    with pytest.raises(InputError, match="no pipeline"):
        going_on.put_back(parts, print)
