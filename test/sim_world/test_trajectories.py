"""Tours through the building and a team's share of them."""

from typing import get_args, get_type_hints

import numpy as np
import pytest

from msg_defs.errors import InputError
from sim_world import trajectories, world
from sim_world.scenario import Scenario
from sim_world.trajectories import TOURS, TURN_M_PER_RAD

tours = pytest.mark.parametrize("tour", TOURS)


def turns(path):
    return (np.diff(path[:, 2]) + np.pi) % (2 * np.pi) - np.pi


def test_the_scenario_knows_every_tour():
    assert set(get_args(get_type_hints(Scenario)["trajectory"])) == set(TOURS)
    assert len(TOURS) >= 3


@tours
def test_tours_keep_clear_of_the_walls(tour):
    points = trajectories.poses(tour, 1, 2000)[0, :, None, :2]
    starts, ends = np.hsplit(world.building().segments, 2)
    along = ends - starts
    share = ((points - starts) * along).sum(2) / (along**2).sum(1)
    nearest = starts + np.clip(share, 0, 1)[..., None] * along
    assert np.linalg.norm(points - nearest, axis=2).min() > 1.0


@tours
@pytest.mark.parametrize("block", [(8.0, 15.0), (22.0, 14.5)])
def test_tours_go_around_both_blocks(tour, block):
    path = trajectories.poses(tour, 1, 2000)[0, :, :2] - block
    angle = np.unwrap(np.arctan2(path[:, 1], path[:, 0]))
    assert abs(angle[-1] - angle[0]) == pytest.approx(2 * np.pi * round(_rounds(angle)))
    assert round(_rounds(angle)) >= 1


def _rounds(angle):
    return abs(angle[-1] - angle[0]) / (2 * np.pi)


@tours
def test_tours_are_closed(tour):
    first, last = trajectories.poses(tour, 1, 450)[0, [0, -1]]
    np.testing.assert_allclose(first, last, atol=1e-9)


@tours
def test_movements_take_equal_time_and_turning_is_bounded(tour):
    path = trajectories.poses(tour, 1, 900)[0]
    turned = turns(path)
    distance = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1)
    # On an arc the chord is shorter than the way.
    way = distance * np.divide(
        turned / 2, np.sin(turned / 2), where=turned != 0, out=1 + 0 * turned
    )
    effort = np.hypot(way, TURN_M_PER_RAD * turned)
    straight = effort[turned == 0]
    np.testing.assert_allclose(straight, straight.max(), rtol=1e-6)
    # A movement that begins straight and ends in a corner is cut across.
    assert effort.max() < 1.001 * straight.max()
    assert effort.min() > 0.7 * straight.max()
    assert np.abs(turned).max() < 1.001 * straight.max() / TURN_M_PER_RAD


@tours
def test_robots_look_where_they_go(tour):
    path = trajectories.poses(tour, 1, 900)[0]
    dx, dy = np.diff(path[:, :2], axis=0).T
    halfway = path[:-1, 2] + turns(path) / 2
    off = np.arctan2(dy, dx) - halfway
    np.testing.assert_allclose(np.sin(off), 0, atol=0.06)
    np.testing.assert_allclose(np.cos(off), 1, atol=0.01)


@tours
@pytest.mark.parametrize("robots", [2, 3, 5])
def test_a_team_shares_the_tour_of_one(tour, robots):
    alone = trajectories.poses(tour, 1, 450)[0]
    team = trajectories.poses(tour, robots, 450)
    assert team.shape == (robots, 450 // robots + 1, 3)
    np.testing.assert_allclose(team[:, :-1].reshape(-1, 3), alone[:-1], atol=1e-9)
    np.testing.assert_allclose(team[:-1, -1], team[1:, 0], atol=1e-9)


def test_a_remainder_shortens_no_robot():
    team = trajectories.poses("ring", 7, 450)
    assert team.shape == (7, 450 // 7 + 1, 3)
    np.testing.assert_allclose(team[-1, -1], team[0, 0], atol=1e-9)


@tours
def test_the_start_offset_moves_the_parts_along_the_tour(tour):
    path = trajectories.poses(tour, 1, 400)[0, :-1]
    moved = trajectories.poses(tour, 1, 400, start_offset=0.25)[0, :-1]
    np.testing.assert_allclose(moved, np.roll(path, -100, axis=0), atol=1e-9)


def test_every_robot_needs_a_movement():
    with pytest.raises(InputError, match=r"movements = 2 for robots = 3"):
        trajectories.poses("ring", 3, 2)
