"""Pictures of left and right become pairs by their stamps."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from multi_robot_slam.front_end.sync import MOST_WAITING, SIDES, StereoSync


def fed(sync, messages):
    """The pairs that come of (side, stamp) messages, each of which is its own bytes."""
    pairs = (
        sync.take(side, stamp, b"%s %d" % (side[:1].encode(), stamp)) for side, stamp in messages
    )
    return [pair for pair in pairs if pair]


@given(st.permutations([(side, stamp) for stamp in range(4) for side in SIDES]))
def test_pairs_have_equal_stamps_ascend_and_nothing_is_uncounted(messages):
    sync = StereoSync()
    pairs = fed(sync, messages)
    assert all((p.left, p.right) == (b"l %d" % p.stamp_ns, b"r %d" % p.stamp_ns) for p in pairs)
    sync.give_up()
    assert 2 * len(pairs) + sync.unmatched == len(messages)
    assert sync.pairs == len(pairs)


def test_a_lost_picture_costs_one_pair():
    messages = [(side, 10 * n) for n in range(6) for side in SIDES]
    messages.remove(("right", 20))
    sync = StereoSync()
    assert [pair.stamp_ns for pair in fed(sync, messages)] == [0, 10, 30, 40, 50]
    assert sync.unmatched == 1


def test_stamps_that_never_agree_make_no_pair_and_the_smallest_difference_is_known():
    sync = StereoSync()
    messages = [(side, 100 * n + 7 * (side == "right")) for n in range(100) for side in SIDES]
    assert fed(sync, messages) == []
    assert sync.smallest_ns == 7
    assert sync.unmatched == 2 * (100 - MOST_WAITING)


@pytest.mark.parametrize("first", SIDES)
def test_stamps_that_nearly_agree_are_a_pair_where_that_is_allowed(first):
    sync = StereoSync(slack_ns=10)
    order = sorted(SIDES, key=lambda side: side != first)
    messages = [(side, 100 * n + 7 * (side == "right")) for n in range(5) for side in order]
    pairs = fed(sync, messages)
    assert [pair.stamp_ns for pair in pairs] == [0, 100, 200, 300, 400]
    assert [pair.right for pair in pairs] == [b"r %d" % (100 * n + 7) for n in range(5)]


def test_no_pair_is_further_apart_than_allowed():
    sync = StereoSync(slack_ns=5)
    assert fed(sync, [("left", 0), ("right", 6), ("left", 12)]) == []
    assert sync.smallest_ns == 6


def test_time_that_goes_back_makes_pairs_again():
    sync = StereoSync()
    messages = [(side, n) for n in (1000, 2000, 5, 6) for side in SIDES]
    assert [pair.stamp_ns for pair in fed(sync, messages)] == [1000, 2000, 5, 6]
