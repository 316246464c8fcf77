"""What `/diagnostics` tells of one robot's camera: why nothing comes out, if nothing does."""

import time
from collections import Counter
from collections.abc import Callable, Iterable

import numpy as np

from msg_defs import wire
from msg_defs.errors import InputError
from msg_defs.topics import Topic
from multi_robot_slam.front_end.front_end import Seen
from multi_robot_slam.pipeline.cameras import Camera

FEW = 10
"""Observations of a pair below which something is likely to be wrong with the pictures."""

AGAIN_S = 30.0
"""After so long the same complaint is made once more [s]."""


class CameraHealth:
    """How one robot's camera is.

    Parameters
    ----------
    silent_s : silence after which a camera is reported [s].
    clock : a monotonic clock [s].

    """

    def __init__(
        self, camera: Camera, silent_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.dropped = 0
        """Pairs that were replaced by newer ones while another was looked at."""
        self.refused: Counter[str] = Counter()
        """Messages and pairs that could not be used, by what they are."""
        self._camera, self._silent_s, self._clock = camera, silent_s, clock
        self._pictures = {t.name for t in camera.inputs if not t.type.endswith("CameraInfo")}
        self._heard_s: dict[str, float] = dict.fromkeys(self._pictures, -np.inf)
        self._began_s = clock()
        self._paired_s = self._seen_s = self._refused_s = -np.inf
        self._pairs = self._seen = 0
        self._refusal = ""
        self._last: Seen | None = None
        self._took_ms = 0.0
        self._told: dict[str, float] = {}

    def hear(self, topic: Topic) -> None:
        """A message came on an input."""
        if topic.name in self._heard_s:
            self._heard_s[topic.name] = self._clock()
        if self._camera.sync.pairs > self._pairs:
            self._pairs, self._paired_s = self._camera.sync.pairs, self._clock()

    def refuse(self, error: InputError) -> None:
        """A message or a pair could not be used."""
        self.refused[str(error).partition(":")[0]] += 1
        self._refusal, self._refused_s = str(error), self._clock()

    def see(self, seen: Seen, took_ms: float) -> None:
        """A pair was looked at."""
        self._last, self._took_ms, self._seen_s = seen, took_ms, self._clock()
        self._seen += 1

    def status(self, unheard: Iterable[str]) -> wire.Status:
        """The robot's entry in `/diagnostics`.

        Parameters
        ----------
        unheard : what to say of its topics on which nothing was ever heard.

        """
        level, message = self._level([*unheard])
        return wire.Status(
            f"camera: {self._camera.robot}", self._values(), level, message, self._camera.robot
        )

    def news(self, status: wire.Status) -> str:
        """What to say of a status on the console: complaints, each once in a while."""
        now_s = self._clock()
        is_new = now_s - self._told.get(status.message, -np.inf) > AGAIN_S
        if status.level == wire.OK or status.message == WAITING or not is_new:
            return ""
        self._told[status.message] = now_s
        return f"{self._camera.robot}: {status.message}"

    def _level(self, unheard: list[str]) -> tuple[int, str]:
        """Level and message: what explains the most comes first."""
        now_s = self._clock()
        if unheard:
            return wire.ERROR, "; ".join(unheard)
        both_s = now_s - min(self._heard_s.values())
        if both_s > self._silent_s:
            return wire.WARN, self._silence(now_s)
        if now_s - max(self._paired_s, self._began_s) > self._silent_s:
            return wire.ERROR, f"left and right never match: {self._camera.mismatch()}"
        if self._refused_s > self._seen_s and self._is_to_blame():
            return wire.ERROR, self._refusal
        if self._last is None:
            return wire.WARN, WAITING
        if sides_m := self._last.tags.other_sides_m.tolist():
            return wire.WARN, (
                f"tags: {len(sides_m)} in view are no squares of camera.tags.size_m; the sides "
                f"look {', '.join(f'{side:.3f}' for side in sides_m)} m; measure the black square"
            )
        if len(self._last.positions) < FEW:
            return wire.WARN, (
                f"few points: {len(self._last.positions)} of {self._last.counts.keypoints} "
                "keypoints have a place in both pictures; look at exposure, focus and calibration, "
                "and whether left and right are swapped"
            )
        return wire.OK, "running"

    def _is_to_blame(self) -> bool:
        """What was refused last is why nothing was seen since: not a single unmatched picture."""
        return not self._refusal.startswith("unmatched")

    def _silence(self, now_s: float) -> str:
        if max(self._heard_s.values()) == -np.inf:
            return WAITING
        silent = [n for n, heard_s in self._heard_s.items() if now_s - heard_s > self._silent_s]
        return f"no picture for {self._silent_s:g} s on {' and '.join(sorted(silent))}"

    def _values(self) -> dict[str, str]:
        sync, counts = self._camera.sync, self._last.counts if self._last else None
        nearest = "" if sync.smallest_ns is None else f"{sync.smallest_ns / 1e6:.3f}"
        values: dict[str, object] = {
            "pairs": sync.pairs,
            "unmatched": sync.unmatched,
            "smallest difference of unmatched stamps [ms]": nearest,
            "passed over": self._camera.due.passed_over,
            "dropped": self.dropped,
            "looked at": self._seen,
            "features": counts.keypoints if counts else "",
            "matches": counts.kept + counts.surplus if counts else "",
            "observations": len(self._last.positions) if self._last else "",
            **self._tags(),
            "duration [ms]": f"{self._took_ms:.1f}",
            "changes of calibration": self._camera.calibration.changes,
            **{f"refused: {what}": count for what, count in sorted(self.refused.items())},
        }
        return {key: str(value) for key, value in values.items()}

    def _tags(self) -> dict[str, int]:
        """What became of the tags in view; nothing where there are none."""
        counts = vars(self._last.tags.counts) if self._last else {}
        return {f"tags {what.replace('_', ' ')}": count for what, count in counts.items() if count}


WAITING = "waiting for pictures"
"""Said before there are any."""
