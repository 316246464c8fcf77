"""What the monitor said of each robot, and when."""

from typing import NamedTuple

from msg_defs.types import Verdict
from multi_robot_slam.runs import Run
from multi_robot_slam.runs.levels import ORDER


class Change(NamedTuple):
    """The level of a robot is another one from here on."""

    stamp_ns: int
    told: str
    """The level; of a robot whose place was unknown, that it is known."""


class Worst(NamedTuple):
    """The worst level a robot ever had."""

    verdict: Verdict
    """The last of that level: it had most to go by."""
    since_ns: int
    """Stamp of the first of that level."""
    is_last: bool
    """The robot has that level at the end of the run."""


def changes(run: Run) -> dict[str, list[Change]]:
    """When each robot's level changed; before its first verdict it was consistent."""
    found: dict[str, list[Change]] = {name: [] for name in run.robots}
    levels = dict.fromkeys(run.robots, "consistent")
    for step in run.steps:
        for verdict in step.verdicts:
            before, now = levels[verdict.robot], verdict.level
            if now != before:
                is_placed = (before, now) == ("place unknown", "consistent")
                told = "place known" if is_placed else now
                found[verdict.robot].append(Change(step.stamp_ns, told))
                levels[verdict.robot] = now
    return found


def worst(run: Run) -> dict[str, Worst]:
    """The worst level of each robot on which there are verdicts."""
    found: dict[str, Worst] = {}
    for step in run.steps:
        for verdict in step.verdicts:
            before, rank = found.get(verdict.robot), ORDER.index(verdict.level)
            known = -1 if before is None else ORDER.index(before.verdict.level)
            if before is None or rank > known:
                found[verdict.robot] = Worst(verdict, step.stamp_ns, True)
            elif rank == known:
                found[verdict.robot] = Worst(verdict, before.since_ns, True)
            else:
                found[verdict.robot] = before._replace(is_last=False)
    return found
