"""Pictures of the two cameras of one robot -> pairs, by their stamps."""

from typing import Literal, NamedTuple

Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")

MOST_WAITING = 30
"""Pictures of one side that wait for their other side: a second at the usual rates."""


class Pair(NamedTuple):
    """Two pictures of one instant, as they were sent."""

    stamp_ns: int
    """The left picture's."""
    left: bytes
    right: bytes


class StereoSync:
    """Keeps each picture until that of the other side comes, or a later pair has formed.

    Parameters
    ----------
    slack_ns : by how much the stamps of a pair may differ, less than half the time between two
        pictures of one side; 0: they are equal [ns].

    """

    def __init__(self, slack_ns: int = 0) -> None:
        self._slack_ns = slack_ns
        self._waiting: dict[Side, dict[int, bytes]] = {side: {} for side in SIDES}
        self.pairs = 0
        self.unmatched = 0
        """Pictures that were given up: no other side came for them."""
        self.smallest_ns: int | None = None
        """The smallest difference that was too large; None where there was none [ns]."""

    def take(self, side: Side, stamp_ns: int, data: bytes) -> Pair | None:
        """Take a picture; the pair that it completes."""
        others = self._waiting[SIDES[side == "left"]]
        nearest_ns = min(others, key=lambda other_ns: abs(other_ns - stamp_ns), default=None)
        if nearest_ns is None or abs(nearest_ns - stamp_ns) > self._slack_ns:
            if nearest_ns is not None:
                self._note(abs(nearest_ns - stamp_ns))
            self._keep(side, stamp_ns, data)
            return None
        other = others.pop(nearest_ns)
        left_ns, left, right = (
            (stamp_ns, data, other) if side == "left" else (nearest_ns, other, data)
        )
        self._give_up_before(max(stamp_ns, nearest_ns))
        self.pairs += 1
        return Pair(left_ns, left, right)

    def give_up(self) -> None:
        """No more pictures come: those that wait stay without their other side."""
        for waiting in self._waiting.values():
            self.unmatched += len(waiting)
            waiting.clear()

    def _note(self, difference_ns: int) -> None:
        if self.smallest_ns is None or difference_ns < self.smallest_ns:
            self.smallest_ns = difference_ns

    def _keep(self, side: Side, stamp_ns: int, data: bytes) -> None:
        waiting = self._waiting[side]
        self.unmatched += waiting.pop(stamp_ns, None) is not None
        waiting[stamp_ns] = data
        if len(waiting) > MOST_WAITING:
            del waiting[next(iter(waiting))]
            self.unmatched += 1

    def _give_up_before(self, stamp_ns: int) -> None:
        for waiting in self._waiting.values():
            for old_ns in [ns for ns in waiting if ns < stamp_ns]:
                del waiting[old_ns]
                self.unmatched += 1
