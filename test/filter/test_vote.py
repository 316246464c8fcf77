"""A vote finds where one piece lies in another, and believes nothing that chance or copies do."""

from itertools import combinations

import numpy as np
import pytest

from multi_robot_slam.filter import vote as votes
from multi_robot_slam.filter.vote import FALSE_RATE, IN_HEIGHT, IN_PLANE, THING_M, Points, vote
from multi_robot_slam.models.motion import wrap
from multi_robot_slam.models.symmetric import pack

HALL = np.array([30.0, 30.0, 2.0])
ALONE = 60
"""Landmarks of each piece that look like none of the other."""


def turned_by(yaw):
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def seen_from(pose, places):
    return (places - [pose[0], pose[1], 0]) @ turned_by(pose[2])


def mapped(rng, places, sigma):
    """Landmarks at `places` (n, 3) as a robot maps them."""
    roots = rng.normal(0, sigma / np.sqrt(3), (len(places), 3, 3))
    covariances = roots @ roots.transpose(0, 2, 1) + (0.3 * sigma) ** 2 * np.eye(3)
    noise = np.linalg.cholesky(covariances) @ rng.normal(size=(len(places), 3, 1))
    return Points(places + noise[:, :, 0], pack(covariances))


def pieces(seed, right, wrong, sigma=0.04):
    """Two pieces, pairs that look alike, of which so many are right, and the pose."""
    rng = np.random.default_rng(seed)
    pose = np.array([*rng.uniform(-20, 20, 2), rng.uniform(-np.pi, np.pi)])
    count = right + wrong
    ours = rng.uniform(0, HALL, (count + ALONE, 3))
    theirs = rng.uniform(0, HALL, (count + ALONE, 3))
    theirs[:right] = ours[:right]
    alike = rng.permutation(np.repeat(np.arange(count)[:, None], 2, axis=1))
    return mapped(rng, ours, sigma), mapped(rng, seen_from(pose, theirs), sigma), alike, pose


def off(found, pose):
    """How far a pose is from another [m, m, rad]."""
    error = found - pose
    error[2] = wrap(error[2])
    return error


@pytest.mark.parametrize(
    ("right", "wrong", "sigma", "found", "believed"),
    [(3, 27, 0.04, 57, 0), (5, 95, 0.04, 59, 45), (8, 92, 0.1, 59, 50), (20, 280, 0.15, 59, 59)],
)
def test_the_pose_is_found_among_wrong_pairs(right, wrong, sigma, found, believed):
    """Of 60 seeds so many at least; a wrong one is never believed."""
    errors, squared = 0, []
    for seed in range(60):
        ours, theirs, alike, pose = pieces(seed, right, wrong, sigma)
        result = vote(ours, theirs, alike)
        if result is None:
            errors += 1
            continue
        error = off(result.pose, pose)
        if np.hypot(*error[:2]) < 1 and np.abs(error[2]) < 0.1:
            squared.append(error @ np.linalg.solve(result.covariance, error))
            believed -= result.is_believed
        else:
            errors += 1
            assert not result.is_believed
    assert 60 - errors >= found
    assert believed <= 0
    assert 2 < np.mean(squared) < 4.2  # three degrees of freedom


@pytest.mark.parametrize(("alike", "sigma"), [(30, 0.05), (100, 0.05), (100, 0.2)])
def test_what_has_nothing_in_common_is_not_believed(alike, sigma):
    """Nor is (Q1) ever much smaller than what so many tries may have."""
    chances = []
    for seed in range(150):
        result = vote(*pieces(1000 + seed, 0, alike, sigma)[:3])
        chances.append(1.0 if result is None else result.chance)
    assert min(chances) > 1 / 1500


def test_no_pair_and_one_pair_say_nothing():
    ours, theirs, alike, _ = pieces(0, 5, 0)
    assert vote(ours, theirs, alike[:0]) is None
    assert vote(ours, theirs, alike[:1]) is None


def posters(rng, places):
    """Six landmarks each of a poster at (x, y, yaw) in `places`, the same on all of them."""
    design = np.column_stack([rng.uniform(0, 1.1, 6), np.zeros(6), rng.uniform(0.5, 1.8, 6)])
    return [design @ turned_by(yaw).T + [x, y, 0] for x, y, yaw in places]


def of_walls(rng, copies):
    """A place and a direction of each of so many copies."""
    return np.column_stack([rng.uniform(0, 30, (copies, 2)), rng.choice([0, np.pi / 2], copies)])


def every(ours, theirs):
    """All pairs of one landmark of a kind with another, (n,) kinds each."""
    return np.argwhere(ours[:, None] == theirs)


@pytest.mark.parametrize("seed", range(10))
def test_one_poster_on_three_walls_ties_nothing(seed):
    """Whether both pieces have the same copy of it or not: only together with other things."""
    rng = np.random.default_rng(seed)
    copies = posters(rng, of_walls(rng, 3))
    own = rng.uniform(0, HALL, (ALONE, 3))
    kinds = np.concatenate([np.arange(6), np.full(ALONE, -2)])
    others = np.where(kinds < 0, -3, kinds)
    for ours, theirs in ((copies[0], copies[0]), (copies[0], copies[1])):
        one = mapped(rng, np.concatenate([ours, own]), 0.03)
        other = mapped(rng, np.concatenate([theirs, own + 40]), 0.03)
        result = vote(one, other, every(kinds, others))
        assert result is None or not result.is_believed


@pytest.mark.parametrize("seed", range(5))
def test_a_room_with_a_copy_elsewhere_is_not_believed(seed):
    """All things are there twice in the same arrangement: either pose may be it."""
    rng = np.random.default_rng(seed)
    room = rng.uniform(0, [14, 10, 2], (16, 3))
    ours = np.concatenate([room, seen_from(np.array([-20.0, 5, 1.0]), room)])
    one, other = mapped(rng, ours, 0.03), mapped(rng, room, 0.03)
    kinds = np.arange(16)
    twice = vote(one, other, every(np.tile(kinds, 2), kinds))
    assert not twice.is_believed
    assert twice.runner_up >= twice.things - 2
    once = vote(one.of(kinds), other, every(kinds, kinds))
    assert once.is_believed


@pytest.mark.parametrize("seed", range(5))
def test_posters_on_three_walls_are_told_apart_by_where_they_hang(seed):
    """Twelve posters with three copies each, and nothing else: right, or not believed."""
    rng = np.random.default_rng(seed)
    pose = np.array([3.0, -7.0, 2.0])
    seen, all_kinds = [], []
    for number in range(12):
        seen += posters(rng, of_walls(rng, 3))
        all_kinds += [6 * number + np.arange(6)] * 3
    there = np.concatenate(seen)
    kinds = np.concatenate(all_kinds)
    part = np.flatnonzero(there[:, 0] > 15)
    one = mapped(rng, there, 0.03)
    other = mapped(rng, seen_from(pose, there[part]), 0.03)
    alike = rng.permutation(every(kinds, kinds[part]))
    result = vote(one, other, alike)
    assert result.is_believed
    assert np.abs(off(result.pose, pose)).max() < 0.1
    strangers = mapped(rng, rng.uniform(0, HALL, there[part].shape), 0.03)
    result = vote(one, strangers, alike)
    assert result is None or not result.is_believed


@pytest.mark.parametrize("seed", range(5))
def test_turning_a_piece_turns_the_answer(seed):
    ours, theirs, alike, _ = pieces(seed, 8, 30)
    by = np.array([4.0, -2.0, 2.5])
    turn = turned_by(by[2])
    places = ours.places @ turn.T + [by[0], by[1], 0]
    covariances = turn @ votes.unpack(ours.covariances) @ turn.T
    before, after = (
        vote(ours, theirs, alike),
        vote(Points(places, pack(covariances)), theirs, alike),
    )
    np.testing.assert_array_equal(before.pairs, after.pairs)
    assert (before.things, before.runner_up) == (after.things, after.runner_up)
    expected = turn @ [*before.pose[:2], 0] + [by[0], by[1], before.pose[2] + by[2]]
    np.testing.assert_allclose(off(after.pose, expected), 0, atol=1e-9)
    np.testing.assert_allclose(after.covariance, turn @ before.covariance @ turn.T, atol=1e-9)


def test_the_law_of_chance():
    """(Q1) by hand, for a binomial of three trials."""
    assert votes._tail(0, 3, 0.1) == 1
    assert votes._tail(2, 3, 0.1) == pytest.approx(3 * 0.01 * 0.9 + 0.001)
    assert votes._tail(3, 3, 0.1) == pytest.approx(0.001)
    assert votes._tail(4, 3, 0.1) == 0
    assert FALSE_RATE == 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_the_slow_and_obvious_way_finds_the_same(seed):
    ours, theirs, alike, _ = pieces(seed, 6, 14, 0.08)
    result = vote(ours, theirs, alike)
    np.testing.assert_array_equal(result.pairs, slow_winner(ours, theirs, alike))


def slow_winner(ours, theirs, alike):
    """Each two pairs propose a pose; rows of what agrees with the best after least squares."""
    alike = [
        (a, b)
        for a, b in alike
        if (ours.places[a, 2] - theirs.places[b, 2]) ** 2
        <= IN_HEIGHT * (ours.covariances[a, 5] + theirs.covariances[b, 5])
    ]

    def plane(points, row):
        return votes.unpack(points.covariances[row])[:2, :2]

    def variance(a, b):
        return sum(np.linalg.eigvalsh(plane(p, r))[-1] for p, r in ((ours, a), (theirs, b)))

    def near(a):
        places = [ours.places[other, :2] for other, _ in alike]
        return sum(np.linalg.norm(place - ours.places[a, :2]) < THING_M for place in places)

    everywhere = 2 * np.var(np.array([ours.places[a, :2] for a, _ in alike]), axis=0).sum()
    best, winner = -1.0, None
    for (a, b), (c, d) in combinations(alike, 2):
        here, there = ours.places[c] - ours.places[a], theirs.places[d] - theirs.places[b]
        far, as_far = np.hypot(*here[:2]), np.hypot(*there[:2])
        both = variance(a, b) + variance(c, d)
        if min(far, as_far) < THING_M or (far - as_far) ** 2 > IN_HEIGHT * both:
            continue
        turn = turned_by(np.arctan2(here[1], here[0]) - np.arctan2(there[1], there[0]))
        middle = (theirs.places[b] + theirs.places[d]) / 2
        evidence, agree = 0.0, []
        for e, f in alike:
            moved = turn @ (theirs.places[f] - middle) + (ours.places[a] + ours.places[c]) / 2
            lever = np.hypot(*(theirs.places[f] - middle)[:2])
            own = variance(e, f) + both / 4 + both / as_far**2 * lever**2
            if np.sum((ours.places[e] - moved)[:2] ** 2) <= IN_PLANE * own:
                evidence += max(0, np.log(everywhere / (IN_PLANE * own))) / near(e)
                agree.append((e, f))
        if evidence > best:
            best, winner = evidence, agree
    return slow_fit(ours, theirs, alike, winner)


def slow_fit(ours, theirs, alike, agree):
    from scipy.optimize import least_squares

    def residual(pose, a, b):
        turn = turned_by(pose[2])
        apart = ours.places[a] - turn @ theirs.places[b] - [pose[0], pose[1], 0]
        spread = votes.unpack(ours.covariances[a]) + turn @ votes.unpack(theirs.covariances[b]) @ (
            turn.T
        )
        return np.linalg.solve(np.linalg.cholesky(spread), apart)

    here = np.array([ours.places[a, :2] for a, _ in agree])
    there = np.array([theirs.places[b, :2] for _, b in agree])
    cross = (there - there.mean(axis=0)).T @ (here - here.mean(axis=0))
    yaw = np.arctan2(cross[0, 1] - cross[1, 0], cross[0, 0] + cross[1, 1])
    pose = np.append(here.mean(axis=0) - turned_by(yaw)[:2, :2] @ there.mean(axis=0), yaw)
    for _ in range(5):
        fit = least_squares(
            lambda p: np.concatenate([residual(p, a, b) for a, b in agree]),  # noqa: B023
            pose,
        )
        pose, covariance = fit.x, np.linalg.inv(fit.jac.T @ fit.jac)
        agree = []
        for a, b in alike:
            turned = turned_by(pose[2]) @ theirs.places[b]
            by_pose = np.array([[-1, 0, turned[1]], [0, -1, -turned[0]], [0, 0, 0]])
            spread = (
                votes.unpack(ours.covariances[a])
                + turned_by(pose[2]) @ votes.unpack(theirs.covariances[b]) @ turned_by(pose[2]).T
            )
            spread += by_pose @ covariance @ by_pose.T
            apart = ours.places[a] - turned - [pose[0], pose[1], 0]
            if apart @ np.linalg.solve(spread, apart) <= votes.IN_SPACE:
                agree.append((a, b))
    return np.array(agree)
