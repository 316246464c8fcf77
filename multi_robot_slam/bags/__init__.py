"""rosbag2 folders and files, written and read without ROS."""

from multi_robot_slam.bags.chunks import Record
from multi_robot_slam.bags.files import Summary
from multi_robot_slam.bags.names import absolute, namespaces
from multi_robot_slam.bags.reader import BagReader
from multi_robot_slam.bags.writer import FLUSH_PERIOD_S, BagWriter

__all__ = [
    "FLUSH_PERIOD_S",
    "BagReader",
    "BagWriter",
    "Record",
    "Summary",
    "absolute",
    "namespaces",
]
