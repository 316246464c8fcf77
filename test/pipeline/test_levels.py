"""A change of level is told once."""

from msg_defs.types import Verdict
from multi_robot_slam.pipeline.levels import Levels


def test_a_level_is_told_when_it_changes_and_when_it_ends():
    told = []
    levels = Levels(told.append)
    lost = Verdict("robot_2", "lost", "slipped", "start anew")
    good = [Verdict(name, "consistent") for name in ("robot_1", "robot_2")]
    for stamp, verdicts in enumerate([good, [good[0], lost], [lost], good, good], start=1):
        levels.tell(stamp * 10**9, verdicts)
    assert told == [
        "robot_2 at 2.000 s: lost: slipped. Remedy: start anew",
        "robot_2 at 4.000 s: consistent from now on",
    ]
