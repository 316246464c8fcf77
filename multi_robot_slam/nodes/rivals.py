"""Does another fusion publish on the same topics? Who listens would hear both."""

from msg_defs.ros.spin import EdgeNode


def rival(node: EdgeNode, name: str) -> str:
    """What to say of another publisher of the topic `name`, which `node` publishes; or nothing."""
    if node.count_publishers(name) <= 1:
        return ""
    return (
        f"another fusion publishes {name}: who listens hears both, mixed; end one of them, or give "
        "it its own ROS_DOMAIN_ID, or a namespace: --ros-args -r __ns:=/other"
    )
