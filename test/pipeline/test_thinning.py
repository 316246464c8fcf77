"""A thinned path is bounded, has both ends and all that is new, and holds still."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from msg_defs.types import Trajectory
from multi_robot_slam.pipeline.thinning import thinned


def path(count):
    return Trajectory(np.arange(count) * 7, np.random.default_rng(0).normal(size=(count, 3)))


@given(st.integers(0, 3000), st.integers(4, 100))
def test_laws(count, most):
    whole = path(count)
    some = thinned(whole, most)
    rows = some.stamps_ns // 7
    assert len(rows) == len(some.poses) <= most
    assert len(rows) == count or len(rows) > most // 2
    np.testing.assert_array_equal(some.poses, whole.poses[rows])
    assert (np.diff(rows) > 0).all()
    if count:
        assert (rows[0], rows[-1]) == (0, count - 1)
    newest = min(count, most // 2)
    assert rows[len(rows) - newest :].tolist() == list(range(count - newest, count))


def test_a_short_path_is_whole():
    whole = path(10)
    assert thinned(whole, 10) is whole


@pytest.mark.parametrize("count", [200, 1000, 5000])
def test_a_new_pose_drops_no_old_one_that_is_left_but_when_the_step_doubles(count):
    before, after = (set(thinned(path(n), 100).stamps_ns.tolist()) for n in (count, count + 1))
    assert len(before - after) <= 1 or len(before - after) >= 24
