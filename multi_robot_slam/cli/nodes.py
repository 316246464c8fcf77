"""`camera`, `fusion`, `record`, `replay`: the ROS nodes, with parameters as any node has them."""

import typer

from msg_defs import cli


def camera(context: typer.Context) -> None:
    """ROS node: pictures of the robots' stereo cameras in, observations of landmarks out.

    Parameters as for any node: multi_robot_slam camera --ros-args -p scenario:=FILE
    """
    cli.start_node("multi_robot_slam.nodes.camera", context.args)


def fusion(context: typer.Context) -> None:
    """ROS node: the team's odometry and observations in, poses and the landmark map out.

    Parameters as for any node: multi_robot_slam fusion --ros-args -p scenario:=FILE
    """
    cli.start_node("multi_robot_slam.nodes.fusion", context.args)


def record(context: typer.Context) -> None:
    """ROS node: records all topics of the team, the simulator and the fusion into a bag.

    Parameters as for any node: multi_robot_slam record --ros-args -p out:=FOLDER -p robots:=[...]
    """
    cli.start_node("multi_robot_slam.nodes.recorder", context.args)


def replay(context: typer.Context) -> None:
    """ROS node: publishes what was recorded in a bag, at its pace, with /clock.

    By default all but what a fusion made of it, so that another fusion can run on it.
    Parameters as for any node: multi_robot_slam replay --ros-args -p bag:=FOLDER -p rate:=5.0
    """
    cli.start_node("multi_robot_slam.nodes.replay", context.args)
