"""Notices that a team's time went back: a recording is played again, a simulation was reset."""

from collections import deque

from msg_defs.types import Event
from multi_robot_slam.pipeline.time_guard import Stream, TimeGuard, stream_of

MOST_KEPT = 2000
"""Events kept of those that may be the beginning of another run."""


class Rewind:
    """Watches the stamps of all events of one run.

    One late message, or a robot that is late altogether, is no rewind: the last message of every
    stream that has been heard of lately must lie `window_ns` before the newest of its stream. Once
    the clock went back, one message that is not newer than the last of its stream is enough: what
    is newer may have been sent before and taken later than the clock.

    Parameters
    ----------
    window_ns : how far back everyone must go; no stamp is believed that is further ahead
        (`TimeGuard`) [ns].

    """

    def __init__(self, window_ns: int) -> None:
        self._window_ns = window_ns
        self._guard = TimeGuard(window_ns)
        self._clock_went_back = False
        self._newest_ns: dict[Stream, int] = {}
        self._back: set[Stream] = set()
        self._kept: deque[Event] = deque(maxlen=MOST_KEPT)

    def clock_went_back(self) -> None:
        """The next message that is not newer begins another run."""
        self._clock_went_back = True

    def note(self, event: Event) -> bool:
        """Take one event; True when with it the whole team's time has gone back."""
        are_back = [self._is_back(admitted) for admitted in self._guard.admit(event)]
        return any(are_back)

    def _is_back(self, event: Event) -> bool:
        stream = stream_of(event)
        newest_ns = self._newest_ns.get(stream, -1)
        is_far_back = event.stamp_ns < newest_ns - self._window_ns
        if is_far_back or (self._clock_went_back and event.stamp_ns <= newest_ns):
            self._back.add(stream)
            self._kept.append(event)
            return self._clock_went_back or self._is_everyone_back()
        self._newest_ns[stream] = max(newest_ns, event.stamp_ns)
        if stream in self._back:
            self._back.remove(stream)
            kept = (e for e in self._kept if stream_of(e) != stream)
            self._kept = deque(kept, maxlen=MOST_KEPT)
        return False

    def _is_everyone_back(self) -> bool:
        horizon_ns = max(self._newest_ns.values()) - self._window_ns
        return all(s in self._back for s, ns in self._newest_ns.items() if ns >= horizon_ns)

    def beginning(self) -> list[Event]:
        """The events that belong to the run that begins, in the order they came."""
        return list(self._kept)
