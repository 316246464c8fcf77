"""People who walk through the pictures."""

import numpy as np
import pytest
from rendered import PERFECT, ROOM, at, changed, grey, renderer, walls

from sim_world import trajectories
from sim_world.rendering import people
from sim_world.rendering.people import Crowd, Walker
from sim_world.world import building

HALL = walls(((0, 0), (30, 0), (30, 30), (0, 30)))
SEED = np.random.SeedSequence(3)


class Still:
    """Someone who stands at one place."""

    def __init__(self, x, y):
        self.place = np.array([x, y], float)

    def at(self, seconds):
        return self.place

    def phase(self, seconds):
        return 0


def with_people(*places, room=HALL, light=250):
    """A renderer of white walls, with someone at each place."""
    shot = renderer(room, grey(room, light), changed(people=len(places)))
    shot._crowd.walkers = [Still(*place) for place in places]
    return shot


def silhouettes(shot, pose):
    """Where people are in both pictures: pixels that differ from those without them."""
    empty = renderer(HALL, grey(HALL, 250)).pair(at(*pose))
    return [eye != bare for eye, bare in zip(shot.pair(at(*pose)), empty, strict=True)]


@pytest.mark.parametrize("distance", [2.0, 5.0, 9.0])
def test_both_eyes_see_a_person_at_the_persons_depth(distance):
    left, right = silhouettes(with_people((5 + distance, 15)), (5, 15, 0.0))
    middles = [np.average(np.arange(640), weights=eye.sum(0)) for eye in (left, right)]
    assert middles[0] - middles[1] == pytest.approx(500 * 0.12 / distance, rel=0.02)
    assert middles[0] == pytest.approx(320 + 500 * 0.06 / distance, abs=1)
    rows = np.flatnonzero(left.any(1))
    tall = 500 * people.HEIGHT_M / distance
    assert rows[-1] - rows[0] == pytest.approx(tall, rel=0.04)
    feet = 240 + 500 * 1.0 / distance
    assert rows[-1] == pytest.approx(min(feet, 479), abs=0.03 * tall)


def test_the_nearer_person_hides_the_farther_one():
    behind, before = (9, 15), (7, 15)
    near = with_people(before)
    near._crowd = with_people(behind, before)._crowd
    pose = (5, 15, 0.0)
    both = near.pair(at(*pose)).left
    order = with_people(behind, before)
    order._crowd.walkers.reverse()
    assert np.mean(both != order.pair(at(*pose)).left) > 0  # the two look different
    alone = with_people((30, 15), before)
    alone._crowd.walkers[0] = Still(4, 15)  # behind the camera
    hides = silhouettes(alone, pose)[0]
    solid = hides & (np.abs(both.astype(int) - alone.pair(at(*pose)).left) == 0)
    assert solid.sum() > 0.9 * hides.sum()


def test_walls_hide_people():
    room = walls(ROOM)
    crowd = changed(people=2)
    shot = renderer(room, grey(room, 250), crowd)
    shot._crowd.walkers = [Still(9, 3), Still(3, 8)]  # outside
    bare = renderer(room, grey(room, 250))
    for yaw in (0.0, 1.5):
        np.testing.assert_array_equal(
            np.stack(shot.pair(at(3, 3, yaw))), np.stack(bare.pair(at(3, 3, yaw)))
        )


def test_people_walk():
    """In the pictures of one pose they are elsewhere a second later, and then elsewhere again."""
    shot = renderer(HALL, grey(HALL, 250), changed(people=20))
    seen = [shot.pair(at(15, 15, 0.0, stamp_ns=i * 10**9)).left for i in range(1, 4)]
    assert (seen[0] != seen[1]).any()
    assert (seen[1] != seen[2]).any()


def test_people_are_the_same_for_all_robots():
    images = changed(people=20)
    pairs = [
        renderer(HALL, grey(HALL, 250), images).pair(at(15, 15, 0.0, robot=robot)).left
        for robot in ("robot_1", "robot_2")
    ]
    np.testing.assert_array_equal(*pairs)


def test_more_people_leave_the_others_where_they_were():
    few, many = (Crowd(count, np.random.SeedSequence(3)) for count in (3, 9))
    for one, same in zip(few.walkers, many.walkers[:3], strict=True):
        np.testing.assert_array_equal(one.at(12.5), same.at(12.5))


@pytest.mark.parametrize("walker", Crowd(12, SEED).walkers, ids=range(12))
def test_nobody_walks_through_walls_or_faster_than_people_walk(walker: Walker):
    times = np.arange(0, abs(walker.duration_s) + 1, 0.25)
    places = np.array([walker.at(seconds) for seconds in times])
    speeds = np.hypot(*np.diff(places, axis=0).T) / 0.25
    assert np.quantile(speeds, 0.95) < 2.5
    assert speeds.max() < 4
    starts, ends = building().segments[:, :2], building().segments[:, 2:]
    along = ends - starts
    share = ((places[:, None] - starts) * along).sum(2) / (along**2).sum(1)
    nearest = starts + np.clip(share, 0, 1)[..., None] * along
    clear = np.linalg.norm(places[:, None] - nearest, axis=2).min()
    assert clear > 0.2  # half the breadth of the shoulders, with arms


def test_walkers_keep_beside_the_way_of_the_robots():
    tours = {name: trajectories.poses(name, 1, 4000)[0] for name in trajectories.TOURS}
    for walker in Crowd(12, SEED).walkers:
        path = next(tour for tour in tours.values() if np.array_equal(tour, walker.path))
        places = np.array([walker.at(s) for s in np.arange(0, 60, 1.0)])
        clear = np.linalg.norm(places[:, None] - path[:, :2], axis=2).min(1)
        assert np.median(clear) == pytest.approx(abs(walker.left_m), abs=0.05)


def test_nobody_is_in_the_pictures_by_default():
    assert PERFECT.people == 0
    assert not Crowd(0, SEED).seen_from(np.zeros(2), 0.0).segments.size
