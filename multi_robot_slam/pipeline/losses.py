"""Messages that never arrived: what is missing in a stream that is regular."""

from typing import NamedTuple

from multi_robot_slam.pipeline.intervals import Intervals

LONGEST_NS = 60 * 10**9
"""Who is silent for longer was switched off: nothing of that was sent."""


class Missing(NamedTuple):
    """Messages that have not come."""

    after_ns: int
    """Stamp of the last one before them."""
    until_ns: int
    """Stamp of the first one after."""
    messages: int


class Losses:
    """Counts what is missing between the stamps of one stream, whatever their order.

    What is missing may still come, or may have come under a wrong stamp: so much is not lost. It is
    lost once the stream is `patience_ns` further, and still comes as often as before.

    Parameters
    ----------
    patience_ns : how late a message may come in message time [ns].

    """

    def __init__(self, patience_ns: int) -> None:
        self.total = 0
        self._patience_ns = patience_ns
        self._intervals = Intervals()
        self._newest_ns = -1
        self._elsewhere = 0
        self._missing: list[tuple[Missing, int]] = []
        """And how far apart messages were before it [ns]."""

    def hear(self, stamp_ns: int) -> list[Missing]:
        """A message arrived; what is lost since the last one that did."""
        if stamp_ns <= self._newest_ns:
            self._find(stamp_ns)
            return []
        if self._newest_ns >= 0:
            self._note(Missing(self._newest_ns, stamp_ns, 0))
        self._newest_ns = stamp_ns
        return self._lost(stamp_ns - self._patience_ns)

    def excuse(self) -> None:
        """A message came under a wrong stamp: it will be missing where it belongs."""
        self._elsewhere += 1

    def end(self) -> list[Missing]:
        """No more messages come: what is lost."""
        return self._lost(self._newest_ns)

    def _note(self, between: Missing) -> None:
        """Note what is missing between two successive stamps."""
        intervals = self._intervals
        interval_ns, usual_ns = between.until_ns - between.after_ns, intervals.usual_ns
        if intervals.are_regular and intervals.longest_ns < interval_ns <= LONGEST_NS:
            missing = round(interval_ns / usual_ns) - 1
            count = max(missing - self._elsewhere, 0)
            self._elsewhere -= missing - count
            self._missing.append((between._replace(messages=count), usual_ns))
        intervals.add(interval_ns)

    def _find(self, stamp_ns: int) -> None:
        """One of those that are missing there has come."""
        for place, (one, usual_ns) in enumerate(self._missing):
            if one.after_ns <= stamp_ns <= one.until_ns:
                self._missing[place] = one._replace(messages=one.messages - 1), usual_ns
                return

    def _lost(self, until_ns: int) -> list[Missing]:
        """Those until then that came neither late nor at another rate."""
        due = [own for own in self._missing if own[0].until_ns <= until_ns]
        self._missing = self._missing[len(due) :]
        now_ns = self._intervals.usual_ns
        lost = [one for one, usual_ns in due if one.messages > 0 and now_ns <= 1.5 * usual_ns]
        self.total += sum(one.messages for one in lost)
        return lost
