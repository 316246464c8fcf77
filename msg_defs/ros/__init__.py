"""The ROS edge every node shares: a node's life, its parameters, and its publishers and readers."""
