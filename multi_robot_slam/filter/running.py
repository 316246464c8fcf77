"""The filter as it runs: Algorithm 1 step by step, and rejuvenation beside it.

A rejuvenation takes a snapshot of the state after a step. While it is worked on, the filter goes on
from the old state, for as long as `delay_s` of message time; then the filter takes the new state,
repeats in it the steps that were done meanwhile, and goes on from there. So whatever it does is as
if every rejuvenation had been done at once, and depends on stamps alone: not on how fast the worker
is, nor on whether there is one.
"""

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from multi_robot_slam.filter import losing, rbpf, rejuvenation, snapshot, tying
from multi_robot_slam.filter.kept import KeptMap, closed, independent, opened
from multi_robot_slam.filter.losing import Lost, Misled
from multi_robot_slam.filter.published import are_there
from multi_robot_slam.filter.rbpf import StepInfo
from multi_robot_slam.filter.rejuvenation import FAILURES, Rejuvenated
from multi_robot_slam.filter.settings import LEAST_UNKNOWNS, FilterSettings
from multi_robot_slam.filter.snapshot import Snapshot
from multi_robot_slam.filter.state import State
from multi_robot_slam.models.frames import RobotFrame

Result = tuple[State | None, Rejuvenated]


@dataclass
class _Begun:
    """A rejuvenation that does not count yet."""

    stamp_ns: int
    old: Snapshot
    own: np.random.Generator
    """Of the rejuvenation, as it was when that began."""
    rng: np.random.Generator
    """As it was after the step at which it began."""
    result: Future[Result]
    steps: list[list[RobotFrame]] = field(default_factory=list)
    """The frames of each step since."""


class ParticleFilter:
    """The particles of a team, stepped and rejuvenated.

    Parameters
    ----------
    start_poses, keeps_frames, are_known : as of `rbpf.init`.
    kept : the map to begin with; none by default.

    """

    def __init__(
        self,
        start_poses: np.ndarray,
        settings: FilterSettings,
        rng: np.random.Generator,
        keeps_frames: bool = True,
        are_known: np.ndarray | None = None,
        kept: KeptMap | None = None,
    ) -> None:
        self.state = rbpf.init(
            start_poses, settings, keeps_frames=keeps_frames, are_known=are_known
        )
        if kept is not None:
            opened(self.state, kept, settings)
        self._settings = settings
        self._rng = rng
        self._begun: _Begun | None = None
        self._losing: dict[int, Misled | None] = {}
        self._worker = _worker(settings)

    def lose(self, robot: int, misled: Misled | None) -> None:
        """Have a robot go on as another one as soon as no rejuvenation is under way.

        `misled` as of `losing.lose`.
        """
        self._losing[robot] = misled

    def step(self, frames: list[RobotFrame]) -> StepInfo:
        """One step over the frames of one instant; raises as `rbpf.step` does."""
        info = rbpf.step(self.state, frames, self._settings, self._rng)
        now_ns = frames[0].stamp_ns
        if self._begun is not None:
            self._begun.steps.append(frames)
            if now_ns - self._begun.stamp_ns >= self._settings.rejuvenation.delay_s * 1e9:
                begun, self._begun = self._begun, None
                info = self._take_over(begun, info)
        if self._begun is None:
            lost = self._lose()
            tied = next((own.tie for own in lost if own.tie is not None), None)
            if not lost:
                tied = tying.tie(self.state, self._settings, self._rng)
            info = info._replace(tied=tied, lost=lost)
            if self._is_due(tied is not None or len(lost) > 0):
                self._begin(now_ns)
        return info

    def _lose(self) -> tuple[Lost, ...]:
        lost = [
            losing.lose(self.state, robot, misled, self._settings, self._rng)
            for robot, misled in self._losing.items()
        ]
        self._losing.clear()
        return tuple(one for one in lost if one is not None)

    def _is_due(self, is_other: bool) -> bool:
        """A rejuvenation begins after this step; `is_other`: there are other pieces since."""
        rest = self._settings.rejuvenation
        if not self._settings.mapping:
            return False
        return rejuvenation.is_due(self.state, rest) or (is_other and rest.ancestors_below > 0)

    def closing(self) -> Callable[[], KeptMap]:
        """What makes the map of all steps so far, elsewhere; it changes nothing here.

        It raises `SmoothingError` where it cannot.
        """
        if self._settings.rejuvenation.ancestors_below == 0:
            return partial(independent, deepcopy(self.state), self._settings)
        own = deepcopy(self._rng).spawn(1)[0]
        return partial(closed, snapshot.taken(self.state, self._settings, own), self._settings, own)

    def __getstate__(self) -> dict[str, Any]:
        """All but the thread: a rejuvenation that does not count yet is told by what it is of."""
        begun = self._begun
        told = begun and (begun.stamp_ns, begun.old, begun.own, begun.rng, [*begun.steps])
        return {**self.__dict__, "_worker": None, "_begun": told}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """As it was; what had begun begins once more, with the same result."""
        self.__dict__.update(state, _worker=_worker(state["_settings"]))
        if self._begun is not None:
            stamp_ns, old, own, rng, steps = state["_begun"]
            result = self._submit(old, deepcopy(own))
            self._begun = _Begun(stamp_ns, old, own, rng, result, steps)

    def close(self) -> None:
        """Let go of the thread; what it works on is not waited for."""
        if self._worker is not None:
            self._worker.shutdown(wait=False, cancel_futures=True)

    def _begin(self, stamp_ns: int) -> None:
        own = self._rng.spawn(1)[0]
        old = snapshot.taken(self.state, self._settings, own)
        result = self._submit(old, deepcopy(own))
        self.state.begin_origins()
        self._begun = _Begun(stamp_ns, old, own, deepcopy(self._rng), result)

    def _submit(self, old: Snapshot, rng: np.random.Generator) -> Future[Result]:
        if self._worker is not None:
            return self._worker.submit(rejuvenation.rejuvenate, old, self._settings, rng)
        done: Future[Result] = Future()
        done.set_result(rejuvenation.rejuvenate(old, self._settings, rng))
        return done

    def _take_over(self, begun: _Begun, info: StepInfo) -> StepInfo:
        """Go on from the new state; what the last step is there."""
        state, rejuvenated = begun.result.result()
        if state is not None:
            try:
                for frames in begun.steps:
                    repeated = rbpf.step(state, frames, self._settings, begun.rng)
            except FAILURES as error:
                told = f"a step cannot be repeated ({error})"
                rejuvenated = rejuvenated._replace(failures=(*rejuvenated.failures, told))
            else:
                self.state, self._rng = state, begun.rng
                return repeated._replace(rejuvenated=rejuvenated)
        return info._replace(rejuvenated=rejuvenated._replace(groups=0))


def _worker(settings: FilterSettings) -> ThreadPoolExecutor | None:
    """A thread for rejuvenation where there is a core for it."""
    if settings.threads == 1 or len(os.sched_getaffinity(0)) < 2:
        return None
    return ThreadPoolExecutor(1, thread_name_prefix="rejuvenation")


def warm_up(settings: FilterSettings) -> State:
    """Compile every kernel or load it from the cache, those of frames that settle as well.

    The state of two robots that `rbpf.two_robots` led to, in a map that they make.
    """
    settings = replace(settings, mapping=True)
    state = rbpf.warm_up(settings)
    weights = np.full(settings.particles, 1 / settings.particles)
    state.landmarks.mixture(state.landmarks.alive(), weights)
    lineage = list(state.history.lineage(0))[::-1]
    are_there(state, lineage, *state.landmarks.of_particle(0), settings)
    if settings.rejuvenation.ancestors_below == 0:
        return state
    small = replace(settings, rejuvenation=replace(settings.rejuvenation, unknowns=LEAST_UNKNOWNS))
    rng = np.random.default_rng(0)
    for _ in range(2):
        for _ in range(LEAST_UNKNOWNS // 6 + 1):  # of two robots, three each
            rbpf.step(state, rbpf.two_robots(), small, rng)
        old = snapshot.taken(state, small, rng)
        state = rejuvenation.rejuvenate(old, small, rng)[0] or state
    return state
