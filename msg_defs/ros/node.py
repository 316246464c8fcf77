"""The ROS edge every node shares: quality of service, parameters, raw topics, a clean end.

Nodes carry CDR bytes: what they publish was encoded by `msg_defs.wire`, what they receive is
decoded by it, so that live and recorded data take the same path.
"""

import os
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from importlib.util import find_spec
from math import inf
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import rclpy
from pydantic import TypeAdapter
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import NameValidationException
from rclpy.executors import Executor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.utilities import remove_ros_args

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError

ENVIRONMENT = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "FASTRTPS_DEFAULT_PROFILES_FILE": str(Path(__file__).with_name("fastdds.xml")),
}
"""What the process runs under where the user has not said otherwise."""

SPIN_TIMEOUT_S = 0.1
"""The longest a signal waits before it is noticed."""

MESSAGES_AT_ONCE = 1000
"""The most messages taken before a node may work on them."""

_ROS_PARAMETERS = ("use_sim_time", "start_type_description_service")
_INT64_MAX = 2**63 - 1
_QOS = {
    topics.STREAM: QoSProfile(depth=1000),
    topics.LATCHED: QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    topics.SENSOR: QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
}


class EdgeNode(Node):
    """A node that `spin` runs until it is `done` or the process is asked to end."""

    def __init__(self, name: str) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self.companions: list[Node] = []
        """Nodes that live and die with this one."""
        self.received = 0
        """Messages taken so far."""
        self.done = False
        self.exit_code = 0

    def work(self) -> float:
        """Do one piece of what is due; the seconds until more is due."""
        return SPIN_TIMEOUT_S

    def close(self) -> None:
        """Say and release what remains; publishers still work."""


def publisher(node: Node, topic: topics.Topic) -> Publisher:
    """A publisher of `topic` that takes CDR bytes."""
    return node.create_publisher(wire.message_class(topic.type), topic.name, _QOS[topic.qos])


def subscribe(
    node: EdgeNode, topic: topics.Topic, callback: Callable[[bytes], None]
) -> Subscription:
    """Have `callback` called with the CDR bytes of every message on `topic`."""

    def take(data: bytes) -> None:
        node.received += 1
        callback(data)

    message_class = wire.message_class(topic.type)
    return node.create_subscription(message_class, topic.name, take, _QOS[topic.qos], raw=True)


def is_available(topic: topics.Topic) -> bool:
    """ROS's class of the topic's messages is installed."""
    return find_spec(topic.type.partition("/")[0]) is not None


def declare(node: EdgeNode, *classes: type, section: str | None = None) -> list[Any]:
    """Declare every field of the settings `classes` as a read-only parameter; their values.

    Nested settings get dotted names, a tuple of tuples becomes one flat array. With `section`, a
    parameter `scenario` names a scenario (`settings.find_scenario`) whose `section` supplies the
    defaults of the first class. Unknown parameters and values out of range raise `InputError`.
    """
    given = {name: p.value for name, p in node.get_parameters_by_prefix("").items()}
    defaults = [cls() for cls in classes]
    if section is not None:
        scenario = given.get("scenario", "")
        _declare_one(node, "scenario", scenario, _describe(str, ("scenario, a file or a name",)))
        if scenario:
            path = scenario_file.find_scenario(str(scenario))
            defaults[0] = scenario_file.from_file(classes[0], path, section)
    records = [_override(default, given) for default in defaults]
    for record in records:
        for leaf in _leaves(type(record)):
            value = _flat(attrgetter(leaf.name)(record))
            _declare_one(node, leaf.name, value, _describe(leaf.type, leaf.metadata))
    _refuse_unknown(node, given)
    return records


def spin(make_node: Callable[[], EdgeNode], args: list[str] | None = None) -> int:
    """Run the node until it is done, or until SIGINT or SIGTERM; the exit code.

    An `InputError` ends in one line on stderr and exit code 2.
    """
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    # Noted, not raised: an exception in the middle of Numba's compilation is lost or breaks it.
    stops: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stops.append(number))
    try:
        _init(sys.argv[1:] if args is None else args)
        return _run(make_node(), stops)
    except (InputError, NameValidationException) as error:
        print("error:", "; ".join(str(error).splitlines()), file=sys.stderr)
        return 2
    finally:
        rclpy.try_shutdown()


def _init(args: list[str]) -> None:
    try:
        unexpected = remove_ros_args(args)
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise InputError(str(error)) from None
    if unexpected:
        raise InputError(
            f"unexpected argument '{unexpected[0]}'; give parameters as --ros-args -p name:=value"
        )


def _run(node: EdgeNode, stops: list[int]) -> int:
    nodes = [node, *node.companions]
    executor = EventsExecutor()
    for one in nodes:
        executor.add_node(one)
    try:
        wait_s = 0.0
        while rclpy.ok() and not (stops or node.done):
            executor.spin_once(timeout_sec=min(wait_s, SPIN_TIMEOUT_S))
            take_waiting(node, executor)
            wait_s = node.work()
        take_waiting(node, executor)
    finally:
        node.close()
        for one in nodes:
            one.destroy_node()
    return node.exit_code


def take_waiting(node: EdgeNode, executor: Executor) -> None:
    """Take what has come in meanwhile; what stays in the middleware is lost in the end.

    One `spin_once` handles one event.
    """
    for _ in range(MESSAGES_AT_ONCE):
        received = node.received
        executor.spin_once(timeout_sec=0)
        if node.received == received:
            return


class _Leaf(NamedTuple):
    """One parameter: its dotted name and what its `Annotated` field says."""

    name: str
    type: Any
    metadata: tuple


def _leaves(cls: type, prefix: str = "") -> Iterator[_Leaf]:
    for name, hint in get_type_hints(cls, include_extras=True).items():
        kind, *metadata = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        if is_dataclass(kind):
            yield from _leaves(kind, f"{prefix}{name}.")
        else:
            yield _Leaf(prefix + name, kind, tuple(metadata))


def _override(default: Any, given: dict[str, Any]) -> Any:
    """`default` with the given parameters in place of its own values."""
    values = TypeAdapter(type(default)).dump_python(default)
    for leaf in _leaves(type(default)):
        if leaf.name in given:
            *parents, key = leaf.name.split(".")
            inner = values
            for parent in parents:
                inner = inner[parent]
            inner[key] = _unflat(leaf, given[leaf.name])
    return scenario_file.from_mapping(type(default), values, "parameter")


def _row_size(kind: Any) -> int:
    """Length of the inner tuples of a tuple of tuples, else 0."""
    inner = get_args(kind)[:1]
    return len(get_args(inner[0])) if inner and get_origin(inner[0]) is tuple else 0


def _flat(value: Any) -> Any:
    if not isinstance(value, tuple):
        return value
    rows = [row if isinstance(row, tuple) else (row,) for row in value]
    return [element for row in rows for element in row]


def _unflat(leaf: _Leaf, value: Any) -> Any:
    size = _row_size(leaf.type)
    if not isinstance(value, str | bytes) and hasattr(value, "__len__"):
        value = list(value)
    if not size or not isinstance(value, list):
        return value
    if len(value) % size:
        raise InputError(f"parameter: {leaf.name}: {len(value)} numbers do not make rows of {size}")
    return [value[i : i + size] for i in range(0, len(value), size)]


def _declare_one(node: Node, name: str, value: Any, descriptor: ParameterDescriptor) -> None:
    if node.has_parameter(name):
        node.undeclare_parameter(name)
    node.declare_parameter(name, value, descriptor, ignore_override=True)


def _describe(kind: Any, metadata: tuple) -> ParameterDescriptor:
    """Description, unit and closed range; `from_mapping` has checked the open bounds already."""
    text = "; ".join(m for m in metadata if isinstance(m, str))
    descriptor = ParameterDescriptor(description=text, read_only=True, dynamic_typing=True)
    low, high = _bound(metadata, "ge", "gt"), _bound(metadata, "le", "lt")
    if low is None and high is None:
        return descriptor
    if kind is float:
        low = -inf if low is None else float(low)
        high = inf if high is None else float(high)
        descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    if kind is int:
        low = -_INT64_MAX if low is None else int(low)
        high = _INT64_MAX if high is None else int(high)
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    return descriptor


def _bound(metadata: tuple, *names: str) -> float | None:
    bounds = (getattr(limit, name, None) for limit in metadata for name in names)
    return next((bound for bound in bounds if bound is not None), None)


def _refuse_unknown(node: Node, given: dict[str, Any]) -> None:
    for name in given:
        is_ros_own = name in _ROS_PARAMETERS or name.startswith("qos_overrides.")
        if not is_ros_own and not node.describe_parameter(name).read_only:
            raise InputError(
                f"unknown parameter '{name}' of node {node.get_name()}; "
                "remove it or correct its spelling"
            )
