"""What is told of two pieces of the map that have become one."""

import numpy as np

from msg_defs.types import Tied
from multi_robot_slam.config import Config
from multi_robot_slam.filter.tying import Tie


def told(config: Config, tie: Tie, team: np.ndarray) -> Tied:
    """Who was tied in, and the numbers; `team` (K,): which robot each is (`filter.pieces`)."""
    return Tied(
        robots=tuple(config.robots[robot] for robot in np.unique(team[list(tie.robots)])),
        is_in_map=tie.is_in_map,
        pose=tie.vote.pose,
        landmarks=len(tie.vote.pairs),
        places=tie.vote.things,
        runner_up=tie.vote.runner_up,
        seconds=tie.seconds,
    )


def line(tied: Tied) -> str:
    """All of it in words."""
    names = " and ".join(tied.robots)
    x, y, yaw = tied.pose.tolist()
    where = f"its own frame lies at [{x:.2f}, {y:.2f}, {yaw:.3f}]"
    if tied.is_in_map:
        who = f"the place of {names} in map is known from now on; {where}"
    else:
        who = f"{names} and robots whose place in map is not known either have one map; {where}"
    return (
        f"{who}, by {tied.landmarks} landmarks of {tied.places} places that agree, "
        f"{tied.runner_up} do by another pose; {tied.seconds:.1f} s after eight were common"
    )
