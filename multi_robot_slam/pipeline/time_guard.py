"""One robot's wrong stamp is that robot's fault: it moves nobody else's time."""

from collections.abc import Callable

from msg_defs.types import Event, Frame

MOST_HELD = 1000
"""Events held back while others speak; the clock of a robot that fills this is wrong for good."""

MOST_UNANSWERED = 5000
"""Events held back of a robot that goes on while all others are silent."""

_NEVER_NS = -(2**62)

Stream = tuple[str, type]
"""What one robot sends of one kind; its stamps ascend."""


def stream_of(event: Event) -> Stream:
    """The stream the event belongs to."""
    return event.robot, type(event)


class TimeGuard:
    """Holds back what is stamped far ahead of everything else until it is believed.

    An event is far ahead when it is more than `limit_ns` ahead of the other robots' newest; where
    these have been silent for so long, of its own robot's newest. It is believed when another
    robot's stamps leap as far, when its stream goes on while the others stay silent, or when the
    others catch up. It is dropped when its stream goes on from where it was before, and at the end
    where nothing speaks for it.

    Parameters
    ----------
    limit_ns : how far ahead a stamp may be [ns].
    drop : called with each event that is not believed.

    """

    def __init__(self, limit_ns: int, drop: Callable[[Event], None] = lambda event: None) -> None:
        self._limit_ns = limit_ns
        self._drop = drop
        self._newest_ns: dict[str, int] = {}
        self._held: list[Event] = []
        self._unanswered_since_ns: dict[Stream, int] = {}
        """Stamp of the first event of each stream held since another robot spoke."""

    @property
    def pending(self) -> int:
        """Frames held back."""
        return sum(isinstance(event, Frame) for event in self._held)

    def admit(self, event: Event) -> list[Event]:
        """Take one event; those that are believed now, in the order they came."""
        if event.stamp_ns > self._latest_ns(event.robot):
            self._held.append(event)
            self._unanswered_since_ns.setdefault(stream_of(event), event.stamp_ns)
            believed_ns = event.stamp_ns + self._limit_ns if self._is_confirmed(event) else -1
            admitted = self._release(dict.fromkeys(self._holding(), believed_ns))
        else:
            self._refute(event)
            self._note(event)
            latest_ns = {robot: self._latest_ns(robot) for robot in self._holding()}
            admitted = [event, *self._release(latest_ns)]
        self._drop_what_is_too_much()
        return admitted

    def rest(self) -> list[Event]:
        """What is held at the end: believed where a stream goes on, and nobody else has spoken.

        Where nothing was let through at all, there is no time that the held could be ahead of.
        """
        everything = dict.fromkeys(self._holding(), 2**63)
        admitted = self._release(self._went_on_until_ns() if self._newest_ns else everything)
        for event in self._held:
            self._drop(event)
        self._held.clear()
        self._unanswered_since_ns.clear()
        return admitted

    def _went_on_until_ns(self) -> dict[str, int]:
        """Up to where each robot is believed: where a stream of it goes on, unanswered."""
        until_ns: dict[str, int] = {}
        before_ns: dict[Stream, int] = {}
        for held in self._held:
            stream, last_ns = stream_of(held), until_ns.get(held.robot, _NEVER_NS)
            apart_ns = held.stamp_ns - before_ns.get(stream, _NEVER_NS)
            if stream in self._unanswered_since_ns and 0 < apart_ns <= self._limit_ns:
                until_ns[held.robot] = max(last_ns, held.stamp_ns + self._limit_ns)
            before_ns[stream] = held.stamp_ns
        return until_ns

    def _latest_ns(self, robot: str) -> int:
        """The latest stamp of a robot that is not far ahead; before the first event none is."""
        own_ns, others_ns = self._own_and_others_ns(robot)
        reference_ns = others_ns if others_ns >= own_ns - self._limit_ns else own_ns
        return reference_ns + self._limit_ns

    def _own_and_others_ns(self, robot: str) -> tuple[int, int]:
        """Newest stamp of the robot and of all others."""
        others = (ns for other, ns in self._newest_ns.items() if other != robot)
        return self._newest_ns.get(robot, _NEVER_NS), max(others, default=_NEVER_NS)

    def _is_confirmed(self, event: Event) -> bool:
        """Another robot agrees, or all others have been silent while the stream went on.

        The first event of all is confirmed by any other near it.
        """
        is_first = not self._newest_ns
        for held in self._held:
            speaks_for_it = held.robot != event.robot or (is_first and held is not event)
            if speaks_for_it and abs(held.stamp_ns - event.stamp_ns) <= self._limit_ns:
                return True
        own_ns, others_ns = self._own_and_others_ns(event.robot)
        went_on_ns = event.stamp_ns - self._unanswered_since_ns[stream_of(event)]
        is_alone_ns = max(own_ns - others_ns, 0)
        return not is_first and went_on_ns > 0 and went_on_ns + is_alone_ns >= self._limit_ns

    def _refute(self, event: Event) -> None:
        """Drop what the event proves wrong, and note that its robot has spoken."""
        stream = stream_of(event)
        kept: list[Event] = []
        for held in self._held:
            if held.stamp_ns > event.stamp_ns and stream_of(held) == stream:
                self._drop(held)
                self._unanswered_since_ns.pop(stream, None)
            else:
                kept.append(held)
        self._held = kept
        since = self._unanswered_since_ns
        self._unanswered_since_ns = {s: ns for s, ns in since.items() if s[0] == event.robot}

    def _drop_what_is_too_much(self) -> None:
        """Drop the oldest, frames before odometry: their memory is a multiple of a sample's."""
        most = MOST_HELD if self._held and self._is_answered(self._held[0]) else MOST_UNANSWERED
        excess = len(self._held) - most
        if excess > 0:
            frames_first = sorted(self._held, key=lambda e: not isinstance(e, Frame))
            too_much = set(map(id, frames_first[:excess]))
            for event in frames_first[:excess]:
                self._drop(event)
            self._held = [held for held in self._held if id(held) not in too_much]

    def _is_answered(self, event: Event) -> bool:
        """Another robot has spoken since the event was held back."""
        since_ns = self._unanswered_since_ns.get(stream_of(event))
        return since_ns is None or event.stamp_ns < since_ns

    def _note(self, event: Event) -> None:
        newest_ns = self._newest_ns.get(event.robot, _NEVER_NS)
        self._newest_ns[event.robot] = max(newest_ns, event.stamp_ns)

    def _holding(self) -> set[str]:
        return {held.robot for held in self._held}

    def _release(self, until_ns: dict[str, int]) -> list[Event]:
        """Let go of each robot's events up to `until_ns`."""
        released: list[Event] = []
        kept: list[Event] = []
        for held in self._held:
            is_believed = held.stamp_ns <= until_ns.get(held.robot, _NEVER_NS)
            (released if is_believed else kept).append(held)
        self._held = kept
        for event in released:
            self._note(event)
            self._unanswered_since_ns.pop(stream_of(event), None)
        return released
