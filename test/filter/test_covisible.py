"""Landmarks seen together."""

from types import SimpleNamespace

import numpy as np
import pytest

from multi_robot_slam.filter.covisible import Covisible
from multi_robot_slam.smoothing.aliases import Aliases

FRAMES = [np.array(own, np.int32) for own in ([4, 2], [2, 9], [7], [], [9, 1, 2])]


def records(frames):
    """A record of robot 0, of robot 1, of robot 0 and so on."""
    return [SimpleNamespace(robot=i % 2) for i in range(len(frames))]


@pytest.mark.parametrize("parts", [[5], [2, 3], [1, 1, 1, 1, 1]])
def test_near_is_what_some_frame_saw_with_it(parts):
    found, first = Covisible.nothing(), 0
    for count in parts:
        found = found.also(
            records(FRAMES)[first : first + count], FRAMES[first : first + count], Aliases()
        )
        first += count
    for ids in ([4], [2], [9, 7], [7], [5], []):
        together = [set(own.tolist()) for own in FRAMES if set(own.tolist()) & set(ids)]
        assert set(found.near(np.array(ids, int)).tolist()) == set().union(*together)


def test_joined_landmarks_are_near_what_either_was():
    found = Covisible.nothing().also(records(FRAMES), FRAMES, Aliases())
    found = found.also([], [], Aliases().joined(np.array([[4, 7], [1, 9]])))
    np.testing.assert_array_equal(found.ids, [1, 2, 4])
    np.testing.assert_array_equal(found.near(np.array([4])), [2, 4])
    np.testing.assert_array_equal(found.near(np.array([1])), [1, 2])


def test_what_each_robot_saw_last_is_known_by_its_name_of_today():
    found = Covisible.nothing().also(records(FRAMES), FRAMES, Aliases())
    np.testing.assert_array_equal(found.last[0], [9, 1, 2])
    np.testing.assert_array_equal(found.last[1], [2, 9])  # its last frame saw nothing
    found = found.also([], [], Aliases().joined(np.array([[1, 9]])))
    np.testing.assert_array_equal(found.last[1], [2, 1])


def test_forgotten_landmarks_are_near_nothing():
    found = Covisible.nothing().also(records(FRAMES), FRAMES, Aliases()).only(np.array([2, 4, 7]))
    np.testing.assert_array_equal(found.ids, [2, 4, 7])
    np.testing.assert_array_equal(found.near(np.array([4])), [2, 4])
