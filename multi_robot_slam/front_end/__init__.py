"""Images in, observations out: pure functions on arrays, without ROS."""
