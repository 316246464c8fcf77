"""Whose place in `map` was unknown, until when, and what told it."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from msg_defs.types import PLACE_UNKNOWN, WRONG, StepRecord, Tied
from multi_robot_slam.config import UNKNOWN, Config


class Placed(NamedTuple):
    """A robot's place in `map` became known."""

    stamp_ns: int
    """Of the step."""
    tied: Tied


def placed(steps: Sequence[StepRecord]) -> dict[str, Placed]:
    """When and how places became known, of each robot the last time."""
    found: dict[str, Placed] = {}
    for step in steps:
        if step.tied is not None and step.tied.is_in_map:
            found |= dict.fromkeys(step.tied.robots, Placed(step.stamp_ns, step.tied))
    return found


def of_robot(config: Config, steps: Sequence[StepRecord], robot: str) -> dict[str, Any]:
    """The figures of one robot.

    `place_known_from_s`: after the first step, and since it was lost last, if it was; 0 where it
    was told, None where it is not known at the end. What told it, None where nothing had to:
    `tied_landmarks`, `tied_places` that agree, `tied_runner_up`, places that agree on the best
    other pose, and `tied_after_s`, how long after eight landmarks were common.
    """
    names = ("tied_landmarks", "tied_places", "tied_runner_up", "tied_after_s")
    is_told = config.start_poses[config.robots.index(robot)] != UNKNOWN
    own = placed(steps).get(robot)
    verdicts = (told for step in reversed(steps) for told in step.verdicts)
    levels = (told.level for told in verdicts if told.robot == robot)
    if next(levels, "consistent") in (PLACE_UNKNOWN, *WRONG):
        own, is_told = None, False
    if own is None:
        return {"place_known_from_s": 0.0 if is_told else None, **dict.fromkeys(names)}
    tied, from_s = own.tied, (own.stamp_ns - steps[0].stamp_ns) / 1e9
    values = (tied.landmarks, tied.places, tied.runner_up, tied.seconds)
    return {"place_known_from_s": from_s, **dict(zip(names, values, strict=True))}
