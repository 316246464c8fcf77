"""Whoever publishes is heard, and whoever publishes reliably is heard without a gap."""

import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from msg_defs import topics, wire
from msg_defs.errors import InputError

nodes = pytest.importorskip("nodes")
endpoints, spin = nodes.endpoints, nodes.spin

pytestmark = pytest.mark.usefixtures("ros_domain_id")

STREAM = topics.Topic("stream", "std_msgs/msg/String")
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=1000)


class Sender(spin.EdgeNode):
    """Publishes numbers as soon as somebody hears them."""

    def __init__(self, qos, name="sender"):
        super().__init__(name)
        self.publisher = self.create_publisher(String, STREAM.name, qos)
        self.sent = []

    def work(self):
        if self.publisher.get_subscription_count() and len(self.sent) < 500:
            self.sent.append(wire.encode_text(f"{self.get_name()} {len(self.sent)}"))
            self.publisher.publish(self.sent[-1])
        return 0.0


class Impatient(Sender):
    """Does not wait for a subscriber."""

    def work(self):
        self.publisher.publish(wire.encode_text(f"{self.get_name()}"))
        return 0.0


@pytest.mark.parametrize("qos", [BEST_EFFORT, RELIABLE])
def test_every_publisher_is_heard(qos):
    with nodes.ros():
        listener, sender = nodes.Listener(STREAM), Impatient(qos)
        nodes.spin_until(lambda: len(listener.heard[STREAM]) > 10, listener, sender)


def test_a_reliable_publisher_after_a_best_effort_one_is_heard_reliably():
    with nodes.ros():
        listener, camera = nodes.Listener(STREAM), Impatient(BEST_EFFORT, "camera")
        nodes.spin_until(lambda: len(listener.heard[STREAM]) > 10, listener, camera)
        camera.destroy_node()
        sender = Sender(RELIABLE)
        reader = listener.readers[STREAM]

        def is_followed():
            reader.follow()
            return reader.reliability == ReliabilityPolicy.RELIABLE

        nodes.spin_until(is_followed, listener)
        nodes.spin_until(lambda: len(sender.sent) == 500, listener, sender)
        nodes.spin_until(lambda: listener.heard[STREAM][-1] == sender.sent[-1], listener)
        assert [d for d in listener.heard[STREAM] if b"sender" in d] == sender.sent


def override(what, value):
    return "-p", f"qos_overrides./stream.{what}:={value}"


def test_the_user_may_choose_another_quality_of_service():
    chosen = (
        *override("subscription.reliability", "best_effort"),
        *override("subscription.depth", 7),
        *override("publisher.depth", 9),
    )
    with nodes.ros(*chosen):
        listener, sender = nodes.Listener(STREAM), Sender(RELIABLE)
        output = endpoints.publisher(sender, STREAM)
        (found,) = sender.get_subscriptions_info_by_topic("/stream")
        assert found.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        nodes.spin_until(lambda: len(listener.heard[STREAM]) > 10, listener, sender)
        listener.readers[STREAM].follow()
        assert listener.readers[STREAM].reliability == ReliabilityPolicy.BEST_EFFORT
        assert sender.get_parameter("qos_overrides./stream.publisher.depth").value == 9
        assert output.topic_name == "/stream"


@pytest.mark.parametrize("what", ["subscription.reliability", "subscription.history"])
def test_a_quality_of_service_that_there_is_none_of_is_refused(what):
    with nodes.ros(*override(what, "perfect")), pytest.raises(InputError, match="perfect"):
        nodes.Listener(STREAM)
