"""Where a robot's way is broken."""

import numpy as np
import pytest

from multi_robot_slam.filter.losing import Misled
from multi_robot_slam.monitor.continuity import HOLD, LEAST, Continuity

SEEN = 8


class Way:
    """Frames that match some landmarks, and make the others."""

    def __init__(self):
        self.continuity, self.next_id, self.stamp_ns = Continuity(), 0, 0

    def see(self, known, count=SEEN):
        self.stamp_ns += 10
        new_ids = np.arange(self.next_id, self.next_id + count, dtype=np.int32)
        matches = new_ids.copy()
        matches[: len(known)] = known
        self.next_id += count
        self.continuity.note(self.stamp_ns, matches, new_ids)
        return new_ids.tolist()

    @property
    def breaks(self):
        return [own.stamp_ns for own in self.continuity.breaks]


def test_who_sees_something_again_is_where_it_was():
    way = Way()
    seen = way.see([])
    for _ in range(5):
        seen = way.see(seen[:HOLD])
    assert not way.breaks


def test_the_first_frame_is_no_break():
    way = Way()
    way.see([])
    assert not way.breaks


@pytest.mark.parametrize("again", range(HOLD))
def test_a_frame_that_sees_next_to_nothing_again_is_one(again):
    way = Way()
    seen = way.see([])
    way.see(seen[:again])
    assert way.breaks == [20]


def test_few_observations_tell_nothing():
    way = Way()
    way.see([])
    way.see([], LEAST - 1)
    assert not way.breaks


def test_it_is_mended_by_what_is_older_and_by_that_alone():
    way = Way()
    old = way.see([])
    since = way.see([])
    since = way.see(since[-HOLD:])
    assert way.breaks == [20]
    way.see([*old[: HOLD - 1], *since[-HOLD:]])
    assert way.breaks == [20]
    way.see(old[:HOLD])
    assert not way.breaks


def test_where_it_was_misled():
    """From the last break before something was held against it, to the last of all."""
    way = Way()
    way.see([])
    for _ in range(3):
        way.see([])
    assert way.breaks == [20, 30, 40]
    assert way.continuity.misled(35) == Misled(30, 40)
    assert way.continuity.misled(40) == Misled(40, 40)
    assert way.continuity.misled(15) == Misled(15, 40)
    assert way.continuity.is_broken_at(40)
    assert not way.continuity.is_broken_at(30)
    assert Continuity().misled(7) == Misled(7, 7)
