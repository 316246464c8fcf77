"""What the monitor said in a run: the last level of each robot, and the worst with its remedy."""

from collections.abc import Sequence
from typing import Any

from msg_defs import wire
from msg_defs.types import Level, StepRecord

ORDER: list[Level] = list(wire.LEVELS)
"""The best first."""


def of_robot(steps: Sequence[StepRecord], robot: str) -> dict[str, Any]:
    """The figures of one robot; None where nothing was said.

    `level`: at the end. `worst_level`: of the run; of equals the first, `worst_level_at_s` after
    the first step, with its `..._cause` and `..._remedy`.
    """
    said = [(step.stamp_ns, v) for step in steps for v in step.verdicts if v.robot == robot]
    names = (
        "level",
        "worst_level",
        *(f"worst_level_{what}" for what in ("at_s", "cause", "remedy")),
    )
    if not said:
        return dict.fromkeys(names)
    stamp_ns, worst = max(said, key=lambda one: ORDER.index(one[1].level))
    at_s = (stamp_ns - steps[0].stamp_ns) / 1e9
    values = (said[-1][1].level, worst.level, at_s, worst.cause, worst.remedy)
    return dict(zip(names, values, strict=True))


def of_team(steps: Sequence[StepRecord]) -> dict[str, Any]:
    """`worst_level` of any robot; None where nothing was said."""
    levels = {verdict.level for step in steps for verdict in step.verdicts}
    return {"worst_level": max(levels, key=ORDER.index) if levels else None}
