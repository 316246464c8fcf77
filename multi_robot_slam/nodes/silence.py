"""Topics on which nothing was ever heard, and what the user may have meant instead."""

import time
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches

from msg_defs.topics import Topic

MOST_SIMILAR = 3


class Silence:
    """Notices once, after `wait_s`, that an expected topic has been silent all the time.

    Parameters
    ----------
    expected : topics by whole names.
    clock : a monotonic clock [s].

    """

    def __init__(
        self, expected: Iterable[Topic], wait_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._unheard = {topic.name: topic for topic in expected}
        self.wait_s = wait_s
        self._clock = clock
        self._began_s = clock()
        self.told: dict[str, str] = {}
        """What was said of each topic that is silent still, by its whole name."""

    def hear(self, name: str) -> None:
        """A message came on a topic."""
        if self._unheard.pop(name, None):
            self.told.pop(name, None)

    def news(self, published: Callable[[], Mapping[str, str]]) -> list[str]:
        """A line for each topic that is overdue and was not told of.

        Parameters
        ----------
        published : gives the type of every topic that somebody publishes, by whole name.

        """
        overdue = self._unheard.keys() - self.told.keys()
        if not overdue or self._clock() - self._began_s < self.wait_s:
            return []
        found = published()
        lines = {
            name: f"nothing heard on {name} for {self.wait_s:g} s: {_reason(topic, found)}"
            for name, topic in self._unheard.items()
            if name in overdue
        }
        self.told |= lines
        return list(lines.values())


def _reason(topic: Topic, published: Mapping[str, str]) -> str:
    kind = published.get(topic.name)
    if kind is not None and kind != topic.type:
        return f"it is published as {kind}; publish {topic.type}"
    if kind is not None:
        return "its publisher sends nothing"
    same_type = [name for name, kind in published.items() if kind == topic.type]
    similar = get_close_matches(topic.name, same_type, MOST_SIMILAR)
    if not similar:
        return f"nobody publishes it or one like it as {topic.type}"
    return f"nobody publishes it; {', '.join(similar)} would fit: remap, or correct `robots`"
