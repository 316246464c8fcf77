"""The inbox keeps the order, and never more than it may."""

from hypothesis import given
from hypothesis import strategies as st

from msg_defs import topics
from multi_robot_slam.nodes.inbox import Inbox, Message

SIZES = st.integers(1, 40)


def message(size, may_be_lost):
    topic = (topics.observations if may_be_lost else topics.odometry)("robot_1")
    return Message(0.0, topic, bytes, bytes(size), may_be_lost)


@given(
    st.lists(st.one_of(st.tuples(SIZES, st.booleans()), st.just("get")), max_size=80),
    st.integers(1, 200),
)
def test_what_is_put_comes_out_in_order_or_is_lost_oldest_frame_first(actions, most_bytes):
    """Against a list that does the same slowly."""
    lost, got, expected, expected_lost, expected_got = [], [], [], [], []
    inbox = Inbox(most_bytes, lost.append)
    for action in actions:
        if action == "get":
            if expected:
                got.append(inbox.get())
                expected_got.append(expected.pop(0))
        else:
            inbox.put(one := message(*action))
            expected.append(one)
            while sum(len(m.data) for m in expected) > most_bytes and len(expected) > 1:
                victim = next((m for m in expected if m.may_be_lost), expected[0])
                expected.remove(victim)
                expected_lost.append(victim)
        assert len(inbox) == len(expected)
    assert got == expected_got
    assert lost == expected_lost
    assert [inbox.get() for _ in expected] == expected
    assert len(inbox) == 0


def test_odometry_outlives_any_number_of_frames():
    lost = []
    inbox = Inbox(1000, lost.append)
    for _ in range(50):
        inbox.put(message(10, False))
        inbox.put(message(100, True))
    kept = [inbox.get() for _ in range(len(inbox))]
    assert sum(not m.may_be_lost for m in kept) == 50
    assert all(m.may_be_lost for m in lost)
