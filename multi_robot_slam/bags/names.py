"""Names of topics in a bag: absolute, and under the namespace the team was recorded in.

Topics are relative (`msg_defs.topics`), so a team that is started in a namespace is recorded as
`/fleet/robot_1/odom`. ROS puts no namespace before frames: they stay as they are.
"""

from collections.abc import Iterable

from msg_defs.topics import Topic


def absolute(name: str, namespace: str = "") -> str:
    """A topic's name as bags have it: `robot_1/odom` in `/fleet` is `/fleet/robot_1/odom`.

    A name that is absolute already, as `/diagnostics`, is in no namespace.
    """
    return name if name.startswith("/") else f"{clean(namespace)}/{name}"


def clean(namespace: str) -> str:
    """`fleet`, `/fleet` and `/fleet/` are `/fleet`; the root `/` is the empty string."""
    path = namespace.strip("/")
    return f"/{path}" if path else ""


def namespaces(recorded: Iterable[Topic], wanted: Iterable[Topic]) -> tuple[str, ...]:
    """Every namespace of `recorded` topics in which one or more that are `wanted` lie, sorted.

    The root is the empty string.
    """
    ends = tuple(f"/{topic.name}" for topic in wanted if not topic.name.startswith("/"))
    found = {
        topic.name.removesuffix(end)
        for topic in recorded
        for end in ends
        if topic.name.endswith(end)
    }
    return tuple(sorted(found))
