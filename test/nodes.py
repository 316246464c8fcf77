"""What the tests of the ROS nodes share: running them in this process, and watching others."""

import time
from contextlib import contextmanager

import pytest
from patience import PATIENCE_S

rclpy = pytest.importorskip("rclpy")
endpoints = pytest.importorskip("msg_defs.ros.endpoints")
spin = pytest.importorskip("msg_defs.ros.spin")
EventsExecutor = pytest.importorskip("rclpy.experimental").EventsExecutor


@contextmanager
def ros(*arguments):
    """ROS in this process: `ros("-p", "seed:=1")`."""
    rclpy.init(args=["--ros-args", *arguments])
    try:
        yield
    finally:
        rclpy.shutdown()


class Listener(spin.EdgeNode):
    """Keeps the bytes of every message on `topics`, by topic, and sends what a test wants."""

    def __init__(self, *topics, name="listener"):
        super().__init__(name)
        self.heard = {topic: [] for topic in topics}
        self.readers = {t: endpoints.subscribe(self, t, self.heard[t].append) for t in topics}
        self._outbox = []

    def is_connected(self):
        """Somebody publishes each of the topics."""
        return all(reader.is_matched for reader in self.readers.values())

    def send(self, messages):
        """Publish (topic, bytes) once everybody spins, so that they arrive in this order."""
        outputs = {topic: endpoints.publisher(self, topic) for topic, _ in messages}
        for publisher in outputs.values():
            wait_until(lambda p=publisher: p.get_subscription_count() > 0)
        self._outbox += [(outputs[topic], data) for topic, data in messages]

    def work(self):
        for publisher, data in self._outbox:
            publisher.publish(data)
        self._outbox.clear()
        return 0.0


class Clock:
    """Goes on when it is told to [s]."""

    now_s = 0.0

    def __call__(self):
        return self.now_s


def rounds(count):
    """A condition for `spin_until` that is met when it has been asked so often."""
    left = iter(range(count))
    return lambda: next(left, None) is None


def seconds_taken(make):
    """How long the node `make(clock)` takes, by a clock that goes on by what it waits."""
    clock = Clock()
    node = make(clock)
    while not node.done:
        clock.now_s += node.work()
    return clock.now_s


def spin_until(condition, *nodes, timeout_s=PATIENCE_S):
    """Run `nodes` as `msg_defs.ros.spin.spin` does, until `condition()`.

    What has come in and was not handled by then is not heard of by a later call.
    """
    executor = EventsExecutor()
    for one in nodes:
        for each in [one, *one.companions]:
            executor.add_node(each)

    def spun():
        for one in nodes:
            one.work()
            spin.take_waiting(one, executor)
        return condition()

    wait_until(spun, timeout_s)


def wait_until(condition, timeout_s=PATIENCE_S):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.001)


def wait_for_line(process, text):
    """Read the standard error of `process` up to the line that contains `text`."""
    lines = []
    for line in process.stderr:
        lines.append(line)
        if text in line:
            return
    pytest.fail(f"{text!r} is not in: {''.join(lines)}")
