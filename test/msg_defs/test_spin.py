import os
import signal
import time
from typing import Annotated

import pytest
from annotated_types import Ge

from msg_defs import topics, wire
from msg_defs.types import settings

nodes = pytest.importorskip("nodes")
endpoints, spin = nodes.endpoints, nodes.spin
parameters = pytest.importorskip("msg_defs.ros.parameters")
Usage = pytest.importorskip("msg_defs.ros.usage").Usage

pytestmark = pytest.mark.usefixtures("ros_domain_id")

NOTHING = Usage("test", "A test's node.", ())


@settings
class Edge:
    speed: Annotated[float, Ge(0), "speed [m/s]"] = 1.0


FLOOD = topics.Topic("flood", "std_msgs/msg/String")


class Flooded(spin.EdgeNode):
    """Is sent ten times what a subscription keeps, 300 messages while it does one piece of work."""

    def __init__(self):
        super().__init__("flooded")
        self.heard = []
        endpoints.subscribe(self, FLOOD, self.heard.append)
        self._output = endpoints.publisher(self, FLOOD)
        self._sent = []
        self._deadline = time.monotonic() + nodes.PATIENCE_S

    def work(self):
        if len(self._sent) < 10_000:
            texts = [wire.encode_text(str(len(self._sent) + i)) for i in range(300)]
            self._sent += texts
            for text in texts:
                self._output.publish(text)
        self.done = len(self.heard) >= len(self._sent) or time.monotonic() > self._deadline
        self.done &= len(self._sent) >= 10_000
        return 0.0

    def close(self):
        assert self.heard == self._sent


@pytest.fixture
def signal_handlers():
    """`spin` takes SIGINT and SIGTERM for itself; give them back."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("signal_handlers")
def test_busy_node_takes_what_waits_and_loses_nothing():
    assert spin.spin(Flooded, [], NOTHING) == 0


class Interrupted(spin.EdgeNode):
    """Is sent signals while it works, and once more while it closes."""

    closed = 0

    def __init__(self, *signals):
        super().__init__("interrupted")
        self._signals = signals
        self._output = endpoints.publisher(self, FLOOD)

    def work(self):
        for number in self._signals:
            os.kill(os.getpid(), number)
        return 0.0

    def close(self):
        os.kill(os.getpid(), self._signals[0])
        self._output.publish(wire.encode_text("the last word"))
        Interrupted.closed += 1


@pytest.mark.usefixtures("signal_handlers")
@pytest.mark.parametrize(
    "signals", [[signal.SIGINT], [signal.SIGTERM], [signal.SIGINT, signal.SIGINT, signal.SIGTERM]]
)
def test_signals_end_a_node_once_and_cleanly(signals):
    closed = Interrupted.closed
    assert spin.spin(lambda: Interrupted(*signals), [], NOTHING) == 0
    assert Interrupted.closed == closed + 1
    assert not nodes.rclpy.ok()


@pytest.mark.usefixtures("signal_handlers")
@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["speed:=1"], "unexpected argument 'speed:=1'"),
        (["--ros-args", "-p", "speed:="], "speed"),
        (["--ros-args", "-p", "speed:=[1, a]"], "speed"),
        (["--ros-args", "-p", "speed:=-1.0"], "speed = -1.0"),
        (["--ros-args", "-r", "__ns:=/a b"], "a b"),
        (["--ros-args", "-p", "qos_overrides./odom.subscription.depth:=3"], "no such topic"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments, reason, capfd):
    def make():
        made = spin.EdgeNode("declaring")
        parameters.declare(made, Edge)
        return made

    assert spin.spin(make, arguments, NOTHING) == 2
    said = [line for line in capfd.readouterr().err.splitlines() if "[rcl]" not in line]
    assert len(said) == 1
    assert said[0].startswith("error: ")
    assert reason in said[0]
