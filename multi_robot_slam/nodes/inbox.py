"""What has come in and waits to be filtered."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from msg_defs.topics import Topic
from msg_defs.types import Event


@dataclass(eq=False)
class Message:
    """One message as it came in."""

    arrived_s: float
    """Monotonic clock [s]."""
    topic: Topic
    decode: Callable[[bytes], Event]
    data: bytes
    may_be_lost: bool
    """It is one frame among many; odometry is what the frames hang on."""


class Inbox:
    """Messages in the order they came; the oldest frames are lost when there are too many.

    Parameters
    ----------
    most_bytes : of all messages together.
    lose : called with each message that is lost.

    """

    def __init__(self, most_bytes: float, lose: Callable[[Message], None]) -> None:
        self._most_bytes = most_bytes
        self._lose = lose
        self._messages: deque[Message | None] = deque()
        self._first = 0
        """Number of the oldest message; each that comes has the next number."""
        self._frames: deque[int] = deque()
        """Numbers of those that may be lost, oldest first."""
        self._bytes = self._count = 0

    def __len__(self) -> int:
        return self._count

    def put(self, message: Message) -> None:
        """Take a message, and lose old ones if it is one too many."""
        if message.may_be_lost:
            self._frames.append(self._first + len(self._messages))
        self._messages.append(message)
        self._bytes += len(message.data)
        self._count += 1
        while self._bytes > self._most_bytes and self._count > 1:
            self._lose(self._remove_oldest_frame() if self._frames else self.get())

    def get(self) -> Message:
        """The oldest message, which leaves; `IndexError` when there is none."""
        while True:
            message = self._messages.popleft()
            self._first += 1
            if message is not None:
                if message.may_be_lost:
                    self._frames.popleft()
                self._account_for(message)
                return message

    def _remove_oldest_frame(self) -> Message:
        place = self._frames.popleft() - self._first
        message = self._messages[place]
        assert message is not None
        self._messages[place] = None
        self._account_for(message)
        return message

    def _account_for(self, message: Message) -> None:
        self._bytes -= len(message.data)
        self._count -= 1
