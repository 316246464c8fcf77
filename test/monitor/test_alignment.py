"""The rigid motion that most pairs agree on."""

import numpy as np
import pytest

from multi_robot_slam.models.motion import move
from multi_robot_slam.monitor.alignment import align


def pairs(count, wrong, seed, motion=(1.2, -0.4, 0.5), sigma=0.03):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-5, 5, (count, 2))
    poses = np.zeros((3, count)) + np.array(motion)[:, None]
    move(poses, np.vstack([points.T, np.zeros(count)]))
    places = poses[:2].T + rng.normal(0, sigma, (count, 2))
    places[:wrong] = rng.uniform(-5, 5, (wrong, 2))
    return points, places, np.full(count, sigma)


@pytest.mark.parametrize("seed", range(5))
def test_the_motion_is_found_among_wrong_pairs(seed):
    found = align(*pairs(20, 8, seed))
    assert (abs(found.motion - [1.2, -0.4, 0.5]) < [0.05, 0.05, 0.02]).all()
    assert 11 <= found.inliers <= 13
    assert found.pairs == 20


def test_half_a_turn_is_found():
    found = align(*pairs(10, 0, 0, motion=(3.0, 1.0, 3.1)))
    assert (abs(found.motion - [3.0, 1.0, 3.1]) < [0.06, 0.06, 0.02]).all()


def test_nothing_is_found_where_less_than_half_agree():
    assert align(*pairs(20, 12, 1)) is None


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_pairs_say_nothing(count):
    assert align(*pairs(count, 0, 0)) is None
