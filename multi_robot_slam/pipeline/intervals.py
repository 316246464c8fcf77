"""How far apart the stamps of a stream usually are."""

from bisect import bisect_left, insort
from collections import deque

WINDOW = 31
"""Intervals remembered; a new rate is usual after half as many."""

LEAST = 11
"""Intervals from which on something is usual."""

USUAL = 0.55
"""Share of the intervals that are no longer than what is usual: more than half, so that of two that
alternate it is the longer; with three in ten messages lost it is still the rate, 19 times in 20."""


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
        """0 as long as nothing is usual [ns]."""
        count = len(self._sorted)
        return self._sorted[int(USUAL * count)] if count >= LEAST else 0

    @property
    def longest_ns(self) -> float:
        """Longer ones are gaps; infinite as long as nothing is usual [ns].

        Half as long again as usual; and where stamps jitter, three times as far above that as the
        second shortest of 31 is below, which is some five standard deviations: messages that are
        lost make intervals longer, none shorter.
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
