"""The node that shows a fusion: what it listens to, when, and what it makes of it."""

import os
import urllib.request

import pytest

from msg_defs import topics, wire
from multi_robot_slam.watch import address
from multi_robot_slam.watch.inputs import inputs
from test.helpers import fake_run
from test.watch import published

nodes = pytest.importorskip("nodes")
watch = pytest.importorskip("multi_robot_slam.nodes.watch")

pytestmark = pytest.mark.usefixtures("ros_domain_id")

RUN = fake_run(robots=2, steps=5)
FIRST = [m[1:] for m in published.messages(RUN) if m[1] == topics.FUSION_CONFIG]
STREAMS = [topics.STEPS, topics.pose("robot_1"), topics.pose("robot_2")]


class Sender(nodes.Listener):
    """Publishes what a fusion of `RUN` would, and knows who listens."""

    def __init__(self):
        super().__init__(name="sender")
        wanted = [topics.FUSION_CONFIG, *inputs(RUN.config.robots)]
        self.outputs = {topic: nodes.endpoints.publisher(self, topic) for topic in wanted}

    def publish(self, messages):
        for topic, data in messages:
            self.outputs[topic].publish(data)

    def listeners(self, topic):
        return self.outputs[topic].get_subscription_count()


@pytest.fixture
def started():
    """The node and a sender, and a function that spins both until a condition."""
    with nodes.ros("-p", "port:=18180"):
        node, sender = watch.Watch(), Sender()
        yield node, sender, lambda condition: nodes.spin_until(condition, node, sender)
        node.close()
        node.destroy_node()
        sender.destroy_node()


def test_it_is_no_subscriber_to_streams_before_there_is_a_map(started):
    node, sender, spin_until = started
    sender.publish(FIRST)
    spin_until(lambda: sender.listeners(topics.MAP_LANDMARKS) == 1)
    spin_until(nodes.rounds(50))
    assert [sender.listeners(topic) for topic in STREAMS] == [0, 0, 0]
    sender.publish([(topics.MAP_LANDMARKS, wire.encode_map(RUN.landmarks, 1))])
    spin_until(lambda: all(sender.listeners(topic) == 1 for topic in STREAMS))
    assert len(node._watched.landmarks.ids) == len(RUN.landmarks.ids)


def test_what_is_published_is_known(started):
    node, sender, spin_until = started
    sender.publish([*FIRST, (topics.MAP_LANDMARKS, wire.encode_map(RUN.landmarks, 1))])
    streams = [*STREAMS, topics.path("robot_2"), topics.DIAGNOSTICS]
    spin_until(lambda: all(sender.listeners(topic) == 1 for topic in streams))
    sender.publish([(topic, data) for _, topic, data in published.messages(RUN)][1:])
    spin_until(lambda: node._watched.robots["robot_2"].path is not None)
    known = node._watched
    assert [step.step for step in known.steps] == [step.step for step in RUN.steps]
    assert known.robots["robot_1"].estimate.stamp_ns == RUN.steps[-1].stamp_ns
    assert known.statuses["fusion"].message == "messages were dropped"
    assert known.walls is not None


def test_a_damaged_message_is_told_of_and_passed_over(started, capfd):
    node, sender, spin_until = started
    sender.publish([(topics.FUSION_CONFIG, wire.encode_text("multi_robot_slam: {robots: 7}"))])
    spin_until(nodes.rounds(50))
    assert node._watched is None
    sender.publish(FIRST)
    spin_until(lambda: sender.listeners(topics.MAP_LANDMARKS) == 1)
    damaged = wire.encode_map(RUN.landmarks, 1)[:-40]
    sender.publish([(topics.MAP_LANDMARKS, damaged)])
    spin_until(nodes.rounds(50))
    assert node._watched.landmarks is None
    sender.publish([(topics.MAP_LANDMARKS, wire.encode_map(RUN.landmarks, 1))])
    spin_until(lambda: node._watched.landmarks is not None)
    said = capfd.readouterr().err
    assert "robots" in said


def test_it_says_where_it_is_and_is_there(capfd):
    with nodes.ros("-p", "port:=18230"):
        node = watch.Watch()
        where = str(node._page.address)
        with urllib.request.urlopen(where, timeout=nodes.PATIENCE_S) as answer:
            assert b"<html" in answer.read()
        node.close()
        node.destroy_node()
    said = capfd.readouterr()
    assert f"{where} shows the fusion" in said.err
    assert "without password" not in said.err
    assert said.out == ""


def test_an_address_that_others_can_reach_is_warned_of(capfd):
    with nodes.ros("-p", "host:=0.0.0.0", "-p", "port:=18280"):
        node = watch.Watch()
        node.close()
        node.destroy_node()
    assert "without password" in capfd.readouterr().err


@pytest.mark.parametrize(("parent", "is_over"), [(0, False), (os.getppid(), False), (1, True)])
def test_it_ends_with_the_process_that_started_it(parent, is_over):
    if os.getppid() == 1:
        pytest.skip("this process has no parent to speak of")
    with nodes.ros("-p", "port:=18330", "-p", f"ends_with:={parent}"):
        node = watch.Watch()
        node.work()
        assert node.done == is_over
        node.close()
        node.destroy_node()


def test_without_viser_it_is_one_line(monkeypatch, capfd):
    monkeypatch.setattr(address, "find_spec", lambda name: None)
    assert watch.main([]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("error: no module 'viser'")
