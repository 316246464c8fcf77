"""The command `multi_robot_slam`."""
