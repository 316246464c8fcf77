"""One filter on the benchmark's world: runs steps, times their parts, checks what was matched."""

from collections.abc import Callable
from dataclasses import replace
from time import process_time
from typing import Any, Literal, NamedTuple, TypeVar
from unittest.mock import patch

import numpy as np

from multi_robot_slam.filter import rbpf
from multi_robot_slam.filter.settings import NO_REJUVENATION, FilterSettings
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.studies.workload import World

SURVEY_SPEED = 5.0
"""Landmarks passed in a step while the map is made."""

SPEED = 0.5
"""Landmarks passed in a step while time is taken: each is observed in about 30 steps."""

LAST = 150
"""Landmarks found at that pace before time is taken, so that the ancestry is that of a long run."""

LEAST_RIGHT = 0.95
"""Share of right matches below which a run is no workload."""


Name = TypeVar("Name")
Proposal = Literal["motion", "informed"]


class Clock(NamedTuple):
    """Seconds of one step, of the proposal in it, and of the lazy copies in the proposal."""

    step: float
    proposal: float
    gather: float


class Session:
    """A team in a world of its own, resampling every step, whose map holds `landmarks` already.

    The map is made with the informed proposal; from then on the filter uses `proposal`. Most of it
    is made in a hurry, the last part at the pace at which time is taken. The world has `ring`
    landmarks, by default enough for the map and some hundred steps.
    """

    def __init__(
        self,
        landmarks: int,
        robots: int,
        particles: int,
        observations: int,
        proposal: Proposal,
        seed: int = 0,
        ring: int | None = None,
    ) -> None:
        self.settings = FilterSettings(
            particles=particles, resample_below=1.0, threads=1, rejuvenation=NO_REJUVENATION
        )
        ring = ring or 2 * landmarks + 1000
        self.world = World(ring, robots, self.settings.motion, observations, seed)
        self.state = rbpf.init(self.world.poses(), self.settings)
        self._rng = np.random.default_rng(seed)
        self._origins = np.zeros(0, int)
        self._right: list[float] = []
        self.survey(landmarks - LAST)
        while len(self.world.seen) < landmarks:
            self.step()
        self._right.clear()
        self.settings = replace(self.settings, proposal=proposal)

    def survey(self, landmarks: int) -> list[Clock]:
        """Drive fast until so many landmarks have been observed: the clock of each step."""
        clocks = []
        while len(self.world.seen) < landmarks:
            clocks.append(self.process(self.world.drive(SURVEY_SPEED), self._rng)[0])
        return clocks

    def step(self) -> Clock:
        """Drive on at the pace at which time is taken."""
        return self.process(self.world.drive(SPEED), self._rng)[0]

    def process(
        self, frames: list[RobotFrame], rng: np.random.Generator
    ) -> tuple[Clock, rbpf.StepInfo]:
        """One step of the filter with the latest `frames` of the world."""
        name, landmarks = self.settings.proposal, self.state.landmarks
        proposal = _Timer(rbpf.PROPOSALS[name])
        gather = _Timer(landmarks.bring_up_to_date)
        whole = _Timer(rbpf.step)
        with (
            patch.dict(rbpf.PROPOSALS, {name: proposal}),
            patch.object(landmarks, "bring_up_to_date", gather),
        ):
            info = whole(self.state, frames, self.settings, rng)
        self._judge(info)
        return Clock(whole.seconds, proposal.seconds, gather.seconds), info

    def size(self) -> int:
        """Landmarks of the best particle."""
        return len(self.state.landmarks.of_particle(rbpf.best_particle(self.state))[0])

    def right_share(self) -> float:
        """Share of right matches since the map was made, over the survivors of each step.

        Right is a landmark that the same true one created, or a new one for a true one never
        observed before. A share below LEAST_RIGHT is an error.
        """
        return require(float(np.mean(self._right)), "right matches")

    def _judge(self, info: rbpf.StepInfo) -> None:
        known = self.world.seen_before
        for frame, numbers in zip(info.frames, self.world.latest, strict=True):
            missing = frame.new_ids.max() + 1 - len(self._origins)
            self._origins = np.append(self._origins, np.zeros(max(missing, 0), int))
            self._origins[frame.new_ids] = numbers
            matches = frame.matches
            if info.ancestors is not None:
                matches = matches[:, info.ancestors]
            is_new = matches == frame.new_ids[:, None]
            should_be_new = np.array([n not in known for n in numbers])[:, None]
            right = (self._origins[matches] == numbers[:, None]) & (is_new == should_be_new)
            self._right.append(right.mean())


def take_turns(sessions: dict[Name, Session], steps: int) -> dict[Name, list[Clock]]:
    """So many steps of every session, one after the other, after one that does not count."""
    for session in sessions.values():
        session.step()
    clocks: dict[Name, list[Clock]] = {name: [] for name in sessions}
    for _ in range(steps):
        for name, session in sessions.items():
            clocks[name].append(session.step())
    return clocks


def require(share: float, what: str) -> float:
    """`share`, which must not be below LEAST_RIGHT for a figure to mean anything."""
    if not share >= LEAST_RIGHT:
        raise RuntimeError(f"{100 * share:.1f} % {what}: the benchmark measures a broken run")
    return float(share)


class _Timer:
    """A function that adds up how long its calls take [s]."""

    def __init__(self, function: Callable) -> None:
        self._function = function
        self.seconds = 0.0

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        start = process_time()
        result = self._function(*args, **kwargs)
        self.seconds += process_time() - start
        return result
