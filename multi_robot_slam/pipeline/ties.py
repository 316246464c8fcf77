"""What is told of two pieces of the map that have become one."""

from multi_robot_slam.config import Config
from multi_robot_slam.filter.tying import Tie


def tied_in(config: Config, tie: Tie) -> str:
    """A line with the numbers of a tie."""
    names = " and ".join(config.robots[robot] for robot in tie.robots)
    x, y, yaw = tie.vote.pose.tolist()
    where = f"the origin of its first keyframe lies at [{x:.2f}, {y:.2f}, {yaw:.3f}]"
    if tie.is_in_map:
        told = f"the place of {names} in map is known from now on; {where}"
    else:
        told = f"{names} and robots whose place in map is not known either have one map; {where}"
    return (
        f"{told}, by {len(tie.vote.pairs)} landmarks of {tie.vote.things} places that agree, "
        f"{tie.vote.runner_up} do by another pose; {tie.seconds:.1f} s after eight were common"
    )
