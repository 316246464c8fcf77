"""Says when the verdict on a robot changes its level."""

from collections.abc import Callable, Iterable

from msg_defs.types import Level, Verdict


class Levels:
    """The level of each robot, `consistent` at first.

    Parameters
    ----------
    warn : called with a line for each change.

    """

    def __init__(self, warn: Callable[[str], None]) -> None:
        self._warn = warn
        self._levels: dict[str, Level] = {}

    def tell(self, stamp_ns: int, verdicts: Iterable[Verdict]) -> None:
        """Say which levels have changed since the last step."""
        for verdict in verdicts:
            before = self._levels.get(verdict.robot, "consistent")
            self._levels[verdict.robot] = verdict.level
            if verdict.level != before:
                self._warn(f"{verdict.robot} at {stamp_ns / 1e9:.3f} s: {_told(verdict)}")


def _told(verdict: Verdict) -> str:
    if verdict.level == "consistent":
        return "consistent from now on"
    return f"{verdict.level}: {verdict.cause}. Remedy: {verdict.remedy}"
