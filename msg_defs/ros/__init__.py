"""The ROS edge every node shares."""
