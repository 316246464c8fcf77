"""Messages that never arrived: what is missing in a stream that is regular."""

from typing import NamedTuple

from multi_robot_slam.pipeline.intervals import Intervals

LONGEST_NS = 60 * 10**9
"""Who is silent for longer was switched off: nothing of that was sent."""


LEAST_SHARE = 0.5
"""Of the messages expected afterwards: fewer are another rate, of which nothing was lost."""


class Missing(NamedTuple):
    """Messages that have not come."""

    after_ns: int
    """Stamp of the last one before them."""
    until_ns: int
    """Stamp of the first one after."""
    messages: int


class _Doubted(NamedTuple):
    """What is missing, and may not be lost."""

    missing: Missing
    usual_ns: int
    """How far apart messages were before it."""
    heard: int
    """Messages until then."""


class Losses:
    """Counts what is missing between the stamps of one stream, whatever their order.

    What is missing may still come, or may have come under a wrong stamp: so much is not lost. It is
    lost once the stream is `patience_ns` further, and still comes nearly as often as before.

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
        self._heard = 0
        self._doubted: list[_Doubted] = []

    def hear(self, stamp_ns: int) -> list[Missing]:
        """A message arrived; what is certain to be lost by now."""
        self._heard += 1
        if stamp_ns <= self._newest_ns:
            self._find(stamp_ns)
            return []
        if self._newest_ns >= 0:
            self._note(Missing(self._newest_ns, stamp_ns, 0))
        self._newest_ns = stamp_ns
        return self._lost(stamp_ns - self._patience_ns)

    def pause(self) -> None:
        """Nobody listened for a while: what came meanwhile is not missed."""
        self._newest_ns = -1

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
            places = round(interval_ns / usual_ns) - 1
            count = max(places - self._elsewhere, 0)
            self._elsewhere -= places - count
            missing = between._replace(messages=count)
            self._doubted.append(_Doubted(missing, usual_ns, self._heard))
        intervals.add(interval_ns)

    def _find(self, stamp_ns: int) -> None:
        """One of those that are missing there has come."""
        for place, doubted in enumerate(self._doubted):
            one = doubted.missing
            if one.after_ns <= stamp_ns <= one.until_ns:
                found = one._replace(messages=one.messages - 1)
                self._doubted[place] = doubted._replace(missing=found)
                return

    def _lost(self, until_ns: int) -> list[Missing]:
        """Those until then that came neither late nor, by now, at another rate."""
        due = [own for own in self._doubted if own.missing.until_ns <= until_ns]
        self._doubted = self._doubted[len(due) :]
        lost = [own.missing for own in due if own.missing.messages > 0 and self._goes_on(own)]
        self.total += sum(one.messages for one in lost)
        return lost

    def _goes_on(self, since: _Doubted) -> bool:
        """Messages have come since then, nearly as often as before."""
        expected = (self._newest_ns - since.missing.until_ns) / since.usual_ns
        return self._heard - since.heard >= max(LEAST_SHARE * expected, 1)
