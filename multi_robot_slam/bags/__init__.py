"""rosbag2 folders and files, written and read without ROS."""

from multi_robot_slam.bags.bag import BagReader, BagWriter, absolute

__all__ = ["BagReader", "BagWriter", "absolute"]
