"""Every topic and frame id, written once. Names are relative, so that namespaces work."""

import re
from collections.abc import Iterable
from typing import NamedTuple

from msg_defs.errors import InputError

STREAM = "stream"
"""Reliable, keep the last 1000: nothing may be lost."""
BULKY = "bulky"
"""Reliable, keep the last 10: of what is so large that 1000 would fill the memory."""
LATCHED = "latched"
"""Reliable and transient local, depth 1: late subscribers get the last message."""
SENSOR = "sensor"
"""Best effort, depth 1: only the newest counts."""

MAP_FRAME = "map"
PIECE_FRAME = "piece"
"""Of landmarks whose place in `map` is not known: a frame for each piece, which /tf does not have,
so that nobody draws them in `map` by mistake."""
CAMERA_FRAME = "{robot}/camera_left_optical"
"""Where a robot's clouds are, by default."""


class Topic(NamedTuple):
    """A topic's name, its ROS message type and its quality of service."""

    name: str
    type: str
    qos: str = STREAM


GROUND_TRUTH_LANDMARKS = Topic("ground_truth/landmarks", "sensor_msgs/msg/PointCloud2", LATCHED)
GROUND_TRUTH_WALLS = Topic("ground_truth/walls", "visualization_msgs/msg/Marker", LATCHED)
MAP_LANDMARKS = Topic("map/landmarks", "sensor_msgs/msg/PointCloud2", LATCHED)
REFINED_LANDMARKS = Topic("map/refined_landmarks", "sensor_msgs/msg/PointCloud2", LATCHED)
PIECES = Topic("fusion/pieces", "sensor_msgs/msg/PointCloud2", LATCHED)
MAP_MARKERS = Topic("map/markers", "visualization_msgs/msg/MarkerArray", LATCHED)
STEPS = Topic("fusion/steps", "diagnostic_msgs/msg/DiagnosticArray")
FUSION_CONFIG = Topic("fusion/config", "std_msgs/msg/String", LATCHED)
WORLD_CONFIG = Topic("sim_world/config", "std_msgs/msg/String", LATCHED)
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
TF = Topic("/tf", "tf2_msgs/msg/TFMessage")
TF_STATIC = Topic("/tf_static", "tf2_msgs/msg/TFMessage", LATCHED)


def odometry(robot: str) -> Topic:
    return Topic(f"{robot}/odom", "nav_msgs/msg/Odometry")


def observations(robot: str) -> Topic:
    return Topic(f"{robot}/stereo/landmarks", "sensor_msgs/msg/PointCloud2")


def sightings(robot: str) -> Topic:
    return Topic(f"{robot}/sightings", "sensor_msgs/msg/PointCloud2")


def image(robot: str, side: str, name: str = "image_rect") -> Topic:
    """Pictures of the `side` (left, right) camera; stereo_image_proc's names."""
    return Topic(f"{robot}/{side}/{name}", "sensor_msgs/msg/Image", BULKY)


def compressed_image(robot: str, side: str, name: str = "image_rect") -> Topic:
    """The same, compressed, under image_transport's name."""
    return Topic(f"{robot}/{side}/{name}/compressed", "sensor_msgs/msg/CompressedImage", BULKY)


def camera_info(robot: str, side: str) -> Topic:
    return Topic(f"{robot}/{side}/camera_info", "sensor_msgs/msg/CameraInfo", BULKY)


def preview(robot: str) -> Topic:
    """The left picture of each pair that was looked at, rectified, grey and small."""
    return Topic(f"{robot}/preview/image/compressed", "sensor_msgs/msg/CompressedImage")


def preview_info(robot: str) -> Topic:
    """The calibration of the preview, as stamped as each."""
    return Topic(f"{robot}/preview/camera_info", "sensor_msgs/msg/CameraInfo")


def observation_truth(robot: str) -> Topic:
    return Topic(f"{robot}/stereo/truth", "sensor_msgs/msg/PointCloud2")


def ground_truth(robot: str) -> Topic:
    return Topic(f"{robot}/ground_truth", "nav_msgs/msg/Odometry")


def pose(robot: str) -> Topic:
    return Topic(f"{robot}/pose", "geometry_msgs/msg/PoseWithCovarianceStamped")


def mean_pose(robot: str) -> Topic:
    return Topic(f"{robot}/mean_pose", "geometry_msgs/msg/PoseWithCovarianceStamped")


def path(robot: str) -> Topic:
    return Topic(f"{robot}/path", "nav_msgs/msg/Path", LATCHED)


def mean_path(robot: str) -> Topic:
    return Topic(f"{robot}/mean_path", "nav_msgs/msg/Path", LATCHED)


def refined_path(robot: str) -> Topic:
    return Topic(f"{robot}/refined_path", "nav_msgs/msg/Path", LATCHED)


def yardstick_path(robot: str) -> Topic:
    return Topic(f"{robot}/yardstick_path", "nav_msgs/msg/Path", LATCHED)


def particles(robot: str) -> Topic:
    return Topic(f"{robot}/particles", "geometry_msgs/msg/PoseArray", SENSOR)


def fusion_outputs(robots: Iterable[str]) -> list[Topic]:
    """Everything the fusion of the team `robots` publishes."""
    singles = [FUSION_CONFIG, STEPS, MAP_LANDMARKS, PIECES, MAP_MARKERS, DIAGNOSTICS, TF]
    kinds = (pose, mean_pose, path, particles)
    return singles + [kind(robot) for robot in robots for kind in kinds]


def odom_frame(robot: str) -> str:
    return f"{robot}/odom"


def base_frame(robot: str) -> str:
    return f"{robot}/base_link"


def camera_frame(robot: str, template: str = CAMERA_FRAME) -> str:
    return template.replace("{robot}", robot)


def robot_name(index: int) -> str:
    """Default name of the team's robot `index`, counted from 0."""
    return f"robot_{index + 1}"


def require_robot_name(name: str) -> None:
    """`InputError` where a name cannot be one part of a topic."""
    if not re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", name):
        raise InputError(
            f"robot name {name!r}: use letters, digits and _, and no digit first; a namespace, as "
            "in team/alice, is given to the node: --ros-args -r __ns:=/team"
        )
