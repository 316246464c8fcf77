"""Publishers and subscriptions of CDR bytes, their quality of service, and whether all is heard.

What nodes publish was encoded by `msg_defs.wire`, what they receive is decoded by it, so that live
and recorded data take the same path.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from importlib.util import find_spec

from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.subscription import Subscription

from msg_defs import topics, wire
from msg_defs.errors import InputError
from msg_defs.ros.parameters import QOS_OVERRIDES
from msg_defs.ros.spin import EdgeNode

FOLLOW_PERIOD_S = 0.5
"""Time between two looks at the publishers' quality of service."""

ACKNOWLEDGE_S = 5.0
"""How long a subscriber that acknowledges nothing holds up the others."""

TELL_PERIOD_S = 5.0

_RELIABLE, _BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT

_QOS = {
    topics.STREAM: QoSProfile(depth=1000),
    topics.BULKY: QoSProfile(depth=10),
    topics.LATCHED: QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    topics.SENSOR: QoSProfile(depth=1, reliability=_BEST_EFFORT),
}


def is_available(topic: topics.Topic) -> bool:
    """ROS's class of the topic's messages is installed."""
    return find_spec(topic.type.partition("/")[0]) is not None


def publisher(node: Node, topic: topics.Topic) -> Publisher:
    """A publisher of `topic` that takes CDR bytes."""
    try:
        return node.create_publisher(
            wire.message_class(topic.type),
            topic.name,
            copy(_QOS[topic.qos]),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
    except (InvalidQosOverridesError, RuntimeError) as error:
        raise InputError(f"{QOS_OVERRIDES}{topic.name}: {error}") from None


def subscribe(node: EdgeNode, topic: topics.Topic, callback: Callable[[bytes], None]) -> "Reader":
    """Have `callback` called with the CDR bytes of every message on `topic`."""

    def take(data: bytes) -> None:
        node.received += 1
        callback(data)

    return Reader(node, topic, take)


_FOLLOWING = (topics.STREAM, topics.BULKY)
"""What is read as reliably as it is published."""


class Reader:
    """A subscription; of a stream or pictures it is as reliable as the publishers are.

    DDS gives a reliable reader nothing of a best-effort writer, as cameras are, and repairs no
    losses of a best-effort reader. So these are read reliably until all its publishers are best
    effort, and again as soon as one is not. What the user chose by `qos_overrides` stays.
    """

    def __init__(
        self, node: EdgeNode, topic: topics.Topic, callback: Callable[[bytes], None]
    ) -> None:
        self._node, self._topic, self._callback = node, topic, callback
        self._qos = copy(_QOS[topic.qos])
        self._is_mixed = False
        try:
            self._subscription = self._create(QoSOverridingOptions.with_default_policies())
        except (InvalidQosOverridesError, RuntimeError) as error:
            raise InputError(f"{QOS_OVERRIDES}{topic.name}: {error}") from None
        self._follows = topic.qos in _FOLLOWING and not self._is_chosen()
        self._following = node.every(FOLLOW_PERIOD_S, self.follow) if self._follows else None

    @property
    def topic_name(self) -> str:
        """The name with its namespace, remapped."""
        return self._subscription.topic_name

    @property
    def is_matched(self) -> bool:
        """What a publisher sends from now on is heard."""
        return self._subscription.get_publisher_count() > 0

    @property
    def reliability(self) -> ReliabilityPolicy:
        """How it reads at present."""
        return self._qos.reliability

    def follow(self) -> None:
        """Read as reliably as the publishers write, where the user left it open."""
        if not self._follows:
            return
        found = self._node.get_publishers_info_by_topic(self.topic_name)
        kinds = {endpoint.qos_profile.reliability for endpoint in found}
        self._tell_of_mixture(len(kinds) > 1)
        wanted = _BEST_EFFORT if kinds == {_BEST_EFFORT} else _RELIABLE
        if kinds and wanted != self._qos.reliability:
            self._qos.reliability = wanted
            before, self._subscription = self._subscription, self._create(None)
            self._node.destroy_subscription(before)

    def close(self) -> None:
        """Hear nothing any more."""
        if self._following is not None:
            self._node.destroy_timer(self._following)
        self._node.destroy_subscription(self._subscription)

    def _create(self, overriding: QoSOverridingOptions | None) -> Subscription:
        # The defaults would warn of publishers that `follow` is about to hear.
        warns = self._topic.qos not in _FOLLOWING
        return self._node.create_subscription(
            wire.message_class(self._topic.type),
            self._topic.name,
            self._callback,
            self._qos,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=warns),
            qos_overriding_options=overriding,
        )

    def _is_chosen(self) -> bool:
        """The user said how reliable the subscription is to be."""
        name = f"{QOS_OVERRIDES}{self.topic_name}.subscription.reliability"
        return name in self._node.overridden

    def _tell_of_mixture(self, is_mixed: bool) -> None:
        if is_mixed and not self._is_mixed:
            self._node.get_logger().warning(
                f"{self.topic_name} has reliable and best-effort publishers: the latter are not "
                "heard; give each robot's topic one publisher"
            )
        self._is_mixed = is_mixed


class Audience:
    """The subscribers to wait for: what is published before they know of it is lost to them."""

    def __init__(
        self, node: Node, expected: Iterable[tuple[Publisher, int]], wait_s: float = 0.0
    ) -> None:
        """Each publisher with its number of subscribers; 0 `wait_s` waits forever [s]."""
        self._node = node
        self._expected = list(expected)
        self._wait_s = wait_s
        self._deadline_s = time.monotonic() + wait_s if wait_s else float("inf")
        self._is_complete = False

    def is_missing(self) -> bool:
        """Some are not there yet, and the wait is not over."""
        if self._is_complete:
            return False
        missing = ", ".join(
            publisher.topic_name
            for publisher, count in self._expected
            if publisher.get_subscription_count() < count
        )
        log = self._node.get_logger()
        if missing and time.monotonic() < self._deadline_s:
            log.info(f"waiting for subscribers of {missing}", throttle_duration_sec=TELL_PERIOD_S)
            return True
        if missing:
            log.warning(f"starting without subscribers of {missing}")
        self._is_complete = True
        return False


class InFlight:
    """What was published and is not acknowledged: no more than subscribers keep in store."""

    def __init__(self, node: Node, publishers: Sequence[Publisher]) -> None:
        self._node, self._publishers = node, publishers
        self._count = 0
        self._held_up_s: float | None = None

    def add(self, count: int = 1) -> None:
        """So much more was published."""
        self._count += count

    def is_above(self, limit: int) -> bool:
        """More than `limit` is in flight; a subscriber that acknowledges nothing is given up."""
        if self._count > limit // 2 and all(map(_is_acknowledged, self._publishers)):
            self._count, self._held_up_s = 0, None
        if self._count <= limit:
            return False
        now_s = time.monotonic()
        self._held_up_s = self._held_up_s or now_s
        if now_s - self._held_up_s < ACKNOWLEDGE_S:
            return True
        self._node.get_logger().warning("a subscriber does not acknowledge: it may lose messages")
        self._count, self._held_up_s = 0, None
        return False


def _is_acknowledged(publisher: Publisher) -> bool:
    return publisher.wait_for_all_acked(Duration(nanoseconds=1))
