"""What `/diagnostics` tells of the fusion."""

import time
from collections import Counter

import numpy as np

from msg_defs import wire
from msg_defs.types import StepRecord


class Health:
    """What `/diagnostics` tells."""

    def __init__(self, robots: tuple[str, ...], silent_s: float) -> None:
        self.lag_s = 0.0
        self.landmarks = 0
        self.step: StepRecord | None = None
        self._silent_s = silent_s
        self._heard_s = dict.fromkeys(robots, -np.inf)
        self._frames = dict.fromkeys(robots, 0)

    def start_over(self) -> None:
        """Forget the steps."""
        self.landmarks, self.step = 0, None
        self._frames = dict.fromkeys(self._frames, 0)

    def hear(self, robot: str) -> None:
        """A message of `robot` arrived now."""
        self._heard_s[robot] = time.monotonic()

    def note(self, step: StepRecord) -> None:
        """A step was done."""
        self.step = step
        for frame in step.frames:
            self._frames[frame.robot] += 1

    def progress(self) -> str:
        """One line about the last step."""
        step = self.step
        return (
            f"step {step.step}, {len(step.frames)} robots, {self.landmarks} landmarks, "
            f"{step.effective_particles:.0f} effective particles, lag {self.lag_s:.2f} s"
        )

    def silence_s(self) -> float:
        """Time since the last message of any robot [s]."""
        return time.monotonic() - max(self._heard_s.values())

    def statuses(self, queued: int, pending: int, dropped: Counter[str]) -> list[wire.Status]:
        """One status for the filter, one for each robot."""
        values = {
            "steps": self.step.step if self.step else 0,
            "landmarks": self.landmarks,
            "effective particles": f"{self.step.effective_particles:.1f}" if self.step else "",
            "step duration [ms]": f"{self.step.duration_ms:.1f}" if self.step else "",
            "messages in the queue": queued,
            "frames held back": pending,
            "lag [s]": f"{self.lag_s if queued else 0:.3f}",
            **{f"dropped: {reason}": count for reason, count in sorted(dropped.items())},
        }
        level, message = (wire.WARN, "messages were dropped") if dropped else (wire.OK, "running")
        filter_status = wire.Status("fusion", _texts(values), level, message)
        return [filter_status, *(self._robot_status(robot) for robot in self._heard_s)]

    def _robot_status(self, robot: str) -> wire.Status:
        silence_s = time.monotonic() - self._heard_s[robot]
        is_silent = silence_s > self._silent_s
        level, message = (wire.WARN, "silent") if is_silent else (wire.OK, "heard")
        values = {"last heard [s ago]": f"{silence_s:.1f}", "frames": self._frames[robot]}
        return wire.Status(f"fusion: {robot}", _texts(values), level, message, robot)


def _texts(values: dict[str, object]) -> dict[str, str]:
    return {key: str(value) for key, value in values.items()}
