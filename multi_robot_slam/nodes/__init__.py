"""The ROS nodes: fusion, recorder, replay."""
