"""What `/diagnostics` tells of the fusion."""

import time
from collections import Counter
from collections.abc import Callable, Mapping

import numpy as np

from msg_defs import wire
from msg_defs.types import FrameCount, StepRecord, Tied, Verdict
from multi_robot_slam.pipeline.pipeline import FAILED_STEP


class Health:
    """How the fusion and each robot are.

    Parameters
    ----------
    silent_s : silence after which a robot is reported; so long may nothing but losses happen [s].
    clock : a monotonic clock [s].

    """

    def __init__(
        self, robots: tuple[str, ...], silent_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.lag_s = 0.0
        self.why_idle = ""
        """Why nothing that arrives is used; empty: it is."""
        self.rival = ""
        """What to say of another fusion that publishes on the same topics, if there is one."""
        self.silent_s = silent_s
        self._clock = clock
        self._heard_s = dict.fromkeys(robots, -np.inf)
        self.start_over()

    def start_over(self) -> None:
        """Forget the steps."""
        self.landmarks = 0
        self._verdicts: dict[str, Verdict] = {}
        self._tied: dict[str, Tied] = {}
        self.step: StepRecord | None = None
        self._frames_told = 0
        self._failed_told = 0
        self._forgive(0)

    def hear(self, robot: str) -> None:
        """A message of `robot` arrived now."""
        self._heard_s[robot] = self._clock()

    def note(self, step: StepRecord, lost: int) -> None:
        """A step was done, and so much was lost by then."""
        self.step = step
        self._verdicts |= {verdict.robot: verdict for verdict in step.verdicts}
        if step.tied is not None:
            self._tied |= dict.fromkeys(step.tied.robots, step.tied)
        self._forgive(lost)

    def progress(self) -> str:
        """One line about the last step."""
        step = self.step
        if step is None:
            return "no step yet"
        return (
            f"step {step.step}, {len(step.frames)} robots, {self.landmarks} landmarks, "
            f"{step.effective_particles:.0f} effective particles, lag {self.lag_s:.2f} s"
        )

    def silence_s(self) -> float:
        """Time since the last message of any robot [s]."""
        return self._clock() - max(self._heard_s.values())

    def statuses(
        self,
        queued: int,
        pending: int,
        dropped: Counter[str],
        unheard: dict[str, str],
        frames: Mapping[str, FrameCount],
        lost: Mapping[str, Mapping[str, int]],
    ) -> list[wire.Status]:
        """One status for the filter, one for each robot.

        Parameters
        ----------
        unheard : what to say of topics on which nothing was ever heard, by name.
        frames : what became of each robot's frames.
        lost : how many messages of each robot never arrived, by kind.

        """
        self._note_frames(sum(count.seen for count in frames.values()), dropped.total())
        values = {
            "steps": self.step.step if self.step else 0,
            "landmarks": self.landmarks,
            "effective particles": f"{self.step.effective_particles:.1f}" if self.step else "",
            "step duration [ms]": f"{self.step.duration_ms:.1f}" if self.step else "",
            "messages in the queue": queued,
            "frames held back": pending,
            "lag [s]": f"{self.lag_s if queued else 0:.3f}",
            **{f"dropped: {reason}": count for reason, count in sorted(dropped.items())},
            **{f"unheard: {name}": text for name, text in sorted(unheard.items())},
        }
        filter_status = wire.Status("fusion", _texts(values), *self._level(dropped))
        robots = [self._robot_status(robot, frames[robot], lost[robot]) for robot in self._heard_s]
        return [filter_status, *robots]

    def _note_frames(self, seen: int, lost: int) -> None:
        """Frames that could be used are no losses, whether or not they became steps."""
        if seen > self._frames_told:
            self._forgive(lost)
        self._frames_told = seen

    def _level(self, dropped: Counter[str]) -> tuple[int, str]:
        """Level and message: the worst first."""
        failed, self._failed_told = dropped[FAILED_STEP] - self._failed_told, dropped[FAILED_STEP]
        if failed:
            return wire.ERROR, "a step failed: the estimate is as before"
        if self.step and not np.isfinite(self.step.effective_particles):
            return wire.ERROR, "the particles' weights are not finite: start over"
        if self.rival:
            return wire.ERROR, self.rival
        if self.why_idle:
            return wire.WARN, f"{self.why_idle}: nothing that arrives is used"
        if self._nothing_but_losses(dropped.total()):
            return wire.ERROR, "nothing but losses: see what is dropped, and why"
        return (wire.WARN, "messages were dropped") if dropped else (wire.OK, "running")

    def _forgive(self, lost: int) -> None:
        """What was `lost` so far says nothing about what is to come."""
        self._lost_told = lost
        self._loses_since_s, self._lost_last_s = np.inf, -np.inf

    def _nothing_but_losses(self, lost: int) -> bool:
        """Losses have gone on for a while without a step, and have not stopped since."""
        now_s = self._clock()
        if lost > self._lost_told:
            self._lost_told, self._lost_last_s = lost, now_s
            self._loses_since_s = min(self._loses_since_s, now_s)
        elif now_s - self._lost_last_s > self.silent_s:
            self._forgive(lost)
        return self._lost_last_s - self._loses_since_s > self.silent_s

    def _robot_status(self, robot: str, frames: FrameCount, lost: Mapping[str, int]) -> wire.Status:
        silence_s = self._clock() - self._heard_s[robot]
        is_silent = silence_s > self.silent_s
        level, message = (wire.WARN, "silent") if is_silent else (wire.OK, "heard")
        verdict = self._verdicts.get(robot)
        judged = {} if verdict is None else wire.verdict_values(verdict)
        if verdict is not None and wire.LEVELS[verdict.level] >= max(level, wire.WARN):
            level = wire.LEVELS[verdict.level]
            message = f"{verdict.level}: {verdict.cause}; {verdict.remedy}"
        values = {
            "last heard [s ago]": f"{silence_s:.1f}",
            "frames": frames.seen,
            "keyframes": frames.used,
            **lost,
            **judged,
            **(wire.tied_values(self._tied[robot]) if robot in self._tied else {}),
        }
        return wire.Status(f"fusion: {robot}", _texts(values), level, message, robot)


def _texts(values: dict[str, object]) -> dict[str, str]:
    return {key: str(value) for key, value in values.items()}
