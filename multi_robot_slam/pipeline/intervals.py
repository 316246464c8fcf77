"""How far apart the stamps of a stream usually are."""

from bisect import bisect_left, insort
from collections import deque

WINDOW = 31
"""Intervals remembered: an odd number, with a median of its own; a new rate is usual after half."""

LEAST = 5
"""Intervals from which on something is usual."""


class Intervals:
    """The last intervals of a stream [ns]."""

    def __init__(self) -> None:
        self._recent: deque[int] = deque()
        self._sorted: list[int] = []

    def add(self, interval_ns: int) -> None:
        """One more; the oldest of more than WINDOW is forgotten."""
        self._recent.append(interval_ns)
        insort(self._sorted, interval_ns)
        if len(self._recent) > WINDOW:
            self._forget(self._recent.popleft())

    def take_back(self) -> None:
        """Forget the last one."""
        if self._recent:
            self._forget(self._recent.pop())

    @property
    def usual_ns(self) -> int:
        """The median, 0 as long as nothing is usual [ns]."""
        return self._sorted[len(self._sorted) // 2] if len(self._sorted) >= LEAST else 0

    @property
    def longest_ns(self) -> float:
        """Longer ones are gaps; infinite as long as nothing is usual [ns].

        Half as long again as the median; and where stamps jitter, three times as far above it as
        the 20th is below, which is five times their standard deviation: messages that are lost make
        intervals longer, none shorter.
        """
        usual_ns = self.usual_ns
        if not usual_ns:
            return float("inf")
        return usual_ns + max(usual_ns / 2, 3 * (usual_ns - self._short_ns))

    @property
    def are_regular(self) -> bool:
        """Messages come at a rate: what is missing can be counted."""
        return self.usual_ns > 0 and self._short_ns >= 0.75 * self.usual_ns

    @property
    def _short_ns(self) -> int:
        return self._sorted[len(self._sorted) // 20]

    def _forget(self, interval_ns: int) -> None:
        del self._sorted[bisect_left(self._sorted, interval_ns)]
