"""The nodes of a team, for those who have `ros2 launch`; examples/spawn_team.py does without.

ros2 launch multi_robot_slam team.launch.py scenario:=my_team.yaml cameras:=true
ros2 launch multi_robot_slam team.launch.py scenario:=team.yaml simulate:=true watch:=true

Where robots send landmarks instead of pictures, leave `cameras` out. With `record` name the robots,
too: record:=drive robots:="[alice, bob]".
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution
from launch_ros.actions import Node

ARGUMENTS = {
    "scenario": ("calibrated", "YAML file with the settings of all nodes, or a scenario's name"),
    "cameras": ("false", "find landmarks in the robots' pictures"),
    "watch": ("false", "serve a page to watch the fusion in the browser"),
    "record": ("", "bag folder to record into; empty: no recording"),
    "robots": ("[robot_1]", "names of the robots to record"),
    "simulate": ("false", "simulate the robots of the scenario, too"),
    "speed": ("1.0", "times real time, of simulated robots"),
}
"""Name: default, description."""


def generate_launch_description() -> LaunchDescription:
    given = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    scenario = {"scenario": given["scenario"]}
    is_recorded = IfCondition(NotEqualsSubstitution(given["record"], ""))
    recording = {"out": given["record"], "robots": given["robots"]}
    played = {**scenario, "speed": given["speed"]}
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            _node("multi_robot_slam", "record", recording, is_recorded),
            _node("multi_robot_slam", "watch", {}, IfCondition(given["watch"])),
            _node("multi_robot_slam", "fusion", scenario),
            _node("multi_robot_slam", "camera", scenario, IfCondition(given["cameras"])),
            _node("sim_world", "robots", played, IfCondition(given["simulate"])),
        ]
    )


def _node(
    package: str, executable: str, parameters: dict, condition: IfCondition | None = None
) -> Node:
    return Node(
        package=package,
        executable=executable,
        parameters=[parameters],
        condition=condition,
        output="screen",
    )
