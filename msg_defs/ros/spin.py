"""A node's life: ROS starts, the node works until it is done or asked to end, and says goodbye."""

import signal
import sys
from collections.abc import Callable, Iterable

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import NameValidationException
from rclpy.executors import Executor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.timer import Timer
from rclpy.utilities import remove_ros_args

from msg_defs.errors import InputError
from msg_defs.ros import environment
from msg_defs.ros.parameters import QOS_OVERRIDES
from msg_defs.ros.usage import Usage

SPIN_TIMEOUT_S = 0.1
"""The longest a signal waits before it is noticed."""

MESSAGES_AT_ONCE = 1000
"""The most messages taken before a node may work on them."""


class EdgeNode(Node):
    """A node that `spin` runs until it is `done` or the process is asked to end."""

    def __init__(self, name: str) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self.overridden = frozenset(self.get_parameters_by_prefix(""))
        """Names of the parameters the user gave."""
        self.companions: list[Node] = []
        """Nodes that live and die with this one."""
        self.received = 0
        """Messages taken so far."""
        self.done = False
        self.exit_code = 0

    def every(self, period_s: float, callback: Callable[[], None]) -> Timer:
        """Have `callback` called every `period_s` of our time, whatever /clock says."""
        return self.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def work(self) -> float:
        """Do one piece of what is due; the seconds until more is due."""
        return SPIN_TIMEOUT_S

    def close(self) -> None:
        """Say and release what remains; publishers still work."""


def spin(make_node: Callable[[], EdgeNode], args: list[str] | None, usage: Usage) -> int:
    """Run the node until it is done, or until SIGINT or SIGTERM; the exit code.

    What `usage` answers, such as --help, is printed without starting ROS. An `InputError` ends in
    one line on stderr and exit code 2.
    """
    words = sys.argv[1:] if args is None else args
    # Noted, not raised: an exception in the middle of Numba's compilation is lost or breaks it.
    stops: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stops.append(number))
    try:
        answer = usage.answer(words)
        if answer is not None:
            print(answer, end="")
            return 0
        environment.prepare()
        _init(words)
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
    _refuse_unused_overrides(node.overridden, nodes)
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


def _refuse_unused_overrides(given: Iterable[str], nodes: list[Node]) -> None:
    """A quality of service that is given for a topic these nodes do not have changes nothing."""
    names = {
        f"{QOS_OVERRIDES}{endpoint.topic_name}.{kind}."
        for node in nodes
        for kind, endpoints in (
            ("publisher", node.publishers),
            ("subscription", node.subscriptions),
        )
        for endpoint in endpoints
    }
    for name in given:
        if name.startswith(QOS_OVERRIDES) and not name.startswith(tuple(names)):
            raise InputError(
                f"parameter '{name}': no such topic; write {QOS_OVERRIDES}/TOPIC.subscription."
                "reliability, or publisher, and depth, history"
            )


def take_waiting(node: EdgeNode, executor: Executor) -> None:
    """Take what has come in meanwhile; what stays in the middleware is lost in the end.

    One `spin_once` handles one event.
    """
    for _ in range(MESSAGES_AT_ONCE):
        received = node.received
        executor.spin_once(timeout_sec=0)
        if node.received == received:
            return
