"""A simulated team that reports as a live one does, and a filter that takes it message by message.

Messages are bytes, decoded as a fusion decodes them. Time is processor time of this process: the
filter's own thread while it takes a message, and all other threads, which are the filter's too.
"""

from collections.abc import Iterator
from dataclasses import replace
from time import process_time, thread_time
from typing import NamedTuple

import numpy as np

from msg_defs import topics, wire
from msg_defs.types import Estimate, StepRecord
from multi_robot_slam.pipeline.decoding import inputs
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.pipeline.thinning import thinned
from sim_world import messages
from sim_world.messages import Message
from sim_world.robot import RobotStep
from sim_world.scenario import Scenario
from sim_world.simulator import Simulation


def team(scenario: Scenario, robots: int, rate_hz: float, seconds: float) -> Scenario:
    """The scenario with so many robots and frames in a second, in as many laps as `seconds` take.

    A lap takes as long as before, of more and smaller movements.
    """
    movements = round(scenario.movements * scenario.period_s * rate_hz)
    laps = int(np.ceil(seconds * rate_hz * robots / movements))
    return replace(
        scenario, robots=robots, period_s=1 / rate_hz, movements=movements, laps=max(laps, 1)
    )


def sent(instant: tuple[RobotStep, ...]) -> list[Message]:
    """What a team sends to its fusion at one instant."""
    return [message for step in instant for message in messages.reported(step)]


class Spent(NamedTuple):
    """What the filter took since it was last asked; processor time [s]."""

    whole: float
    """Of all threads, for all messages."""
    stepping: float
    """Of all threads, but in the filter's own thread only for messages that made it step."""
    own_stepping: float
    """Of the filter's own thread, for these messages."""
    steps: int
    observations: int
    """In the frames of these steps."""
    longest_ms: float
    """Of a step, by the time that passed [ms]."""


class Taken(NamedTuple):
    """What came of a message."""

    steps: list[StepRecord]
    prediction: Estimate | None


class LiveFilter:
    """A pipeline that is fed with bytes, and what it takes."""

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline = pipeline
        self._decoders = inputs(pipeline.config)
        self._own = self._own_stepping = 0.0
        self._steps: list[StepRecord] = []
        self._others = _other_threads()

    def take(self, topic: topics.Topic, data: bytes) -> Taken:
        """Hand one message over, as a fusion does."""
        _, decode = self._decoders[topic]
        start = thread_time()
        event = decode(data)
        steps = self.pipeline.handle(event)
        prediction = self.pipeline.predict(event)
        took = thread_time() - start
        self._own += took
        if steps:
            self._own_stepping += took
            self._steps += steps
        return Taken(steps, prediction)

    def spent(self) -> Spent:
        """Since it was last asked."""
        others = _other_threads()
        beside = others - self._others
        found = Spent(
            whole=self._own + beside,
            stepping=self._own_stepping + beside,
            own_stepping=self._own_stepping,
            steps=len(self._steps),
            observations=sum(len(f.landmarks) for step in self._steps for f in step.frames),
            longest_ms=max((step.duration_ms for step in self._steps), default=0.0),
        )
        self._own = self._own_stepping = 0.0
        self._steps, self._others = [], others
        return found

    def pictures(self, stamp_ns: int) -> int:
        """Make map, markers and paths as bytes, as a fusion does once a second; the landmarks."""
        landmarks = self.pipeline.landmark_map()
        paths = {name: thinned(path) for name, path in self.pipeline.trajectories().items()}
        wire.encode_map(landmarks, stamp_ns)
        wire.encode_markers(landmarks, paths, stamp_ns)
        for path in paths.values():
            wire.encode_path(path, stamp_ns)
        return len(landmarks.ids)


def _other_threads() -> float:
    """Processor time of all threads of this process but the one that asks [s]."""
    return process_time() - thread_time()


def instants(simulation: Simulation, seconds: float) -> Iterator[tuple[RobotStep, ...]]:
    """The first `seconds` of a simulation."""
    count = round(seconds / simulation.scenario.odometry_period_s)
    return (instant for _, instant in zip(range(count), simulation.steps(), strict=False))
