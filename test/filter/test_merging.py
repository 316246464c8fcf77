"""Two maps of teams that knew nothing of each other: merged, they are what one team would know."""

from dataclasses import replace

import numpy as np
import pytest
import worlds

from multi_robot_slam.filter import merging, vote
from multi_robot_slam.filter.running import ParticleFilter
from multi_robot_slam.filter.settings import ExistenceSettings, RejuvenationSettings
from multi_robot_slam.filter.tying import VAGUER
from multi_robot_slam.models.frames import Start
from multi_robot_slam.models.motion import move, wrap
from multi_robot_slam.models.symmetric import unpack

NOWHERE = np.zeros(3)


def settings(**changes):
    rest = RejuvenationSettings(ancestors_below=0.5, delay_s=0.0)
    changes = {"particles": 60, "rejuvenation": rest, "learn_noise": False} | changes
    return worlds.settings(
        proposal="informed",
        resample_below=0.5,
        exclusive=True,
        existence=ExistenceSettings(),
        **changes,
    )


def drive(robot, steps=30, seed=3, seen=8):
    """The frames of one robot of a team, as if it were alone."""
    made = []
    for frames in worlds.drive(seed, steps, 3, seen):
        (own,) = (frame for frame in frames if frame.robot == robot)
        made.append([replace(own, robot=0, stamp_ns=len(made) * 10**9)])
    return made


def map_of(steps, starts, own=None):
    own = own or settings()
    particles = ParticleFilter(starts, own, np.random.default_rng(1))
    for frames in steps:
        particles.step(frames)
    return particles.closing()()


@pytest.fixture(scope="module")
def maps():
    """Of two robots, each by itself: the first in the true frame, the second in its own."""
    first = map_of(drive(0), worlds.START[:1])
    second = map_of(drive(1), NOWHERE[None])
    return first, replace(second, robots=second.robots << 1)


def merged(one, other):
    pairs = vote.pairs_alike(one.descriptors, other.descriptors, settings().descriptor_gate)
    found = merging.voted(one, other, pairs)
    assert found.is_believed
    return found, merging.merged(one, other, found, pairs, settings())


def whole_covariance(kept):
    """(3 n, 3 n): of all landmarks."""
    count = len(kept.ids)
    whole = np.zeros((count, 3, count, 3))
    whole[:, :2, :, :2] = kept.joint.reshape(count, 2, count, 2)
    own = np.arange(count)
    whole[own, :, own] += np.linalg.inv(unpack(kept.information))
    return whole.reshape(3 * count, -1)


def literally_merged(one, other, pose, covariance, pairs):
    """Means and covariance of all landmarks of both, by one dense update in three dimensions."""
    first, count = 3 * len(one.ids), 3 * (len(one.ids) + len(other.ids))
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    turns = np.kron(np.eye(len(other.ids)), turn)
    theirs = other.positions @ turn.T
    by_pose = np.zeros((len(other.ids), 3, 3))
    by_pose[:, 0, 0] = by_pose[:, 1, 1] = 1
    by_pose[:, 0, 2], by_pose[:, 1, 2] = -theirs[:, 1], theirs[:, 0]
    by_pose = by_pose.reshape(-1, 3)
    theirs = theirs + np.array([pose[0], pose[1], 0])
    whole = np.zeros((count, count))
    whole[:first, :first] = whole_covariance(one)
    whole[first:, first:] = turns @ whole_covariance(other) @ turns.T
    whole[first:, first:] += by_pose @ (VAGUER * covariance) @ by_pose.T
    means = np.concatenate([one.positions.ravel(), theirs.ravel()])
    for a, b in pairs:
        observed = np.zeros((3, count))
        observed[:, 3 * a : 3 * a + 3] = np.eye(3)
        observed[:, first + 3 * b : first + 3 * b + 3] = -np.eye(3)
        gain = whole @ observed.T
        gain = gain @ np.linalg.inv(observed @ gain + 1e-14 * np.eye(3))
        means = means - gain @ observed @ means
        whole = whole - gain @ observed @ whole
    return means.reshape(-1, 3), whole


def without_leaning(kept):
    """The map with errors in the plane that do not depend on those in height."""
    information = kept.information.copy()
    information[:, [2, 4]] = 0
    return replace(kept, information=information)


def test_it_is_one_dense_update_of_both(maps):
    """Where heights err by themselves, exactly; the pose is linearised where it ends."""
    one, other = map(without_leaning, maps)
    found, first = merged(one, other)
    found = found._replace(pose=first.pose)
    result = merging.merged(one, other, found, np.empty((0, 2), int), settings())
    assert result.joined == len(found.pairs) > 10
    means, whole = literally_merged(one, other, result.pose, found.covariance, found.pairs)
    rows = rows_of(one, other, result.kept)
    np.testing.assert_allclose(result.kept.positions, means[rows], atol=1e-4)
    own = (3 * rows[:, None] + np.arange(3)).ravel()
    expected = whole[np.ix_(own, own)]
    apart = np.abs(whole_covariance(result.kept) - expected).max()
    assert apart < 1e-3 * np.diag(expected).max()


def rows_of(one, other, kept):
    """Where each landmark of a merged map is among those of both."""
    is_ours = kept.ids < one.next_id
    ours = np.searchsorted(one.ids, kept.ids[is_ours])
    return np.append(ours, len(one.ids) + kept.ids[~is_ours] - one.next_id)


def test_it_is_where_it_truly_is_and_every_landmark_is_there_once(maps):
    one, other = maps
    _, result = merged(one, other)
    x, y, yaw = result.pose - worlds.START[1]
    assert np.hypot(x, y) < 0.15
    assert abs(wrap(yaw)) < 0.05
    kept = result.kept
    assert result.joined == len(one.ids) + len(other.ids) - len(kept.ids) > 15
    alike = kept.descriptors @ kept.descriptors.T
    assert (np.triu(alike, 1) < 0.95).all()
    assert kept.observations.sum() == one.observations.sum() + other.observations.sum()
    assert (kept.robots == 3).sum() == result.joined
    assert np.isin(one.ids, kept.ids).all()
    assert (np.diff(kept.ids) > 0).all()
    assert kept.next_id == one.next_id + len(other.ids) > kept.ids.max()
    assert kept.found.sum() == one.found.sum() + other.found.sum()
    assert kept.places.sum() == one.places.sum() + other.places.sum()
    assert (kept.horizon < kept.next_id).all()
    assert (kept.together == kept.together.T).all()
    assert kept.together.sum() >= max(one.together.sum(), other.together.sum())
    assert np.linalg.eigvalsh(kept.joint).min() > 0


def test_both_know_more_than_each(maps):
    one, other = maps
    _, result = merged(one, other)
    rows = np.searchsorted(result.kept.ids, one.ids)
    after, before = result.kept.covariances[rows], one.covariances
    assert (after[:, [0, 3, 5]] < 1.001 * before[:, [0, 3, 5]]).all()
    assert after[:, 0].sum() < 0.8 * before[:, 0].sum()


def test_it_is_smoothing_all_of_it_at_once(maps):
    """What one team with a start that was believed vaguely would know of the same frames."""
    one, other = maps
    found, result = merged(one, other)
    vague = Start(worlds.START[1], VAGUER * found.covariance)
    steps = []
    for t, (first, second) in enumerate(zip(drive(0), drive(1), strict=True)):
        steps.append([*first, replace(second[0], robot=1, start=None if t else vague)])
    both = map_of(steps, worlds.START[:2], settings(particles=300))
    alike = result.kept.descriptors @ both.descriptors.T
    rows = alike.argmax(axis=1)
    is_there = alike.max(axis=1) > 0.95
    assert is_there.mean() > 0.95
    apart = (result.kept.positions - both.positions[rows])[is_there]
    sigmas = np.sqrt(both.covariances[rows][:, [0, 3, 5]][is_there])
    assert np.sqrt(np.mean((apart / sigmas) ** 2)) < 0.3
    ratio = result.kept.covariances[:, [0, 3, 5]] / both.covariances[rows][:, [0, 3, 5]]
    np.testing.assert_allclose(np.median(ratio[is_there], axis=0), 1, atol=0.1)
    assert (np.abs(np.log(ratio[is_there])) < 0.5).mean() > 0.95


def test_which_is_first_changes_the_frame_alone(maps):
    """Landmarks are as far apart, and how far is as well known."""
    one, other = maps
    (_, ours), (_, theirs) = merged(one, other), merged(other, one)
    assert ours.joined == theirs.joined
    alike = ours.kept.descriptors @ theirs.kept.descriptors.T
    rows = alike.argmax(axis=1)
    assert (np.sort(rows) == np.arange(len(rows))).all()
    rng = np.random.default_rng(0)
    for a, b in rng.choice(len(rows), (50, 2)):
        if a != b:
            found, expected = (
                distance(kept, *pair)
                for kept, pair in ((ours.kept, (a, b)), (theirs.kept, (rows[a], rows[b])))
            )
            assert found[0] == pytest.approx(expected[0], abs=0.02 * np.sqrt(expected[1]))
            assert found[1] == pytest.approx(expected[1], rel=0.02)
    back = composed(ours.pose, theirs.pose)
    np.testing.assert_allclose([*back[:2], wrap(back[2])], 0, atol=0.01)


def distance(kept, a, b):
    """Between two landmarks in the plane, with its variance."""
    apart = kept.positions[b, :2] - kept.positions[a, :2]
    along = apart / np.hypot(*apart)
    rows = np.array([3 * a, 3 * a + 1, 3 * b, 3 * b + 1])
    covariance = whole_covariance(kept)[np.ix_(rows, rows)]
    jacobian = np.append(-along, along)
    return np.hypot(*apart), jacobian @ covariance @ jacobian


def composed(pose, seen):
    moved = pose[:, None].copy()
    move(moved, seen[:, None])
    return moved[:, 0]


def test_of_nothing_in_common_nothing_is_believed(maps):
    elsewhere = map_of(drive(1, seed=4), NOWHERE[None])
    pairs = vote.pairs_alike(maps[0].descriptors, elsewhere.descriptors, 0.7)
    assert len(pairs) > 50
    found = merging.voted(maps[0], elsewhere, pairs)
    assert found is None or not found.is_believed
    assert merging.voted(maps[0], elsewhere, pairs[:1]) is None


def test_what_both_have_from_a_map_before_is_told(maps):
    one, other = maps
    assert merging.is_same(one, one)
    assert not merging.is_same(one, other)
    assert merging.count_shared(one, other) == 0
    later = map_of(drive(0, 10, seed=3), worlds.START[:1])
    assert not merging.is_same(one, later)
    moved = replace(one, positions=one.positions + 1e-9)
    assert not merging.is_same(one, moved)
    assert merging.count_shared(one, replace(moved, ids=one.ids + 5)) == len(one.ids)
    tags = replace(one, descriptors=-np.abs(one.descriptors))
    assert merging.count_shared(tags, tags) == 0


def test_what_one_team_missed_and_the_other_saw_later_is_there(maps):
    """Looks that failed before it was seen again do not count; and later ids are later."""
    one, other = maps
    failing = replace(one, in_a_row=one.in_a_row + 30, failed=one.failed + 30)
    _, result = merged(failing, other)
    rows = np.searchsorted(result.kept.ids, one.ids)
    both = result.kept.robots[rows] == 3
    assert (result.kept.in_a_row[rows][both] < 30).all()
    assert (result.kept.in_a_row[rows][~both] >= 30).all()
    alone = result.kept.ids >= one.next_id
    theirs = result.kept.ids[alone] - one.next_id
    later = np.searchsorted(other.ids, other.horizon[theirs], side="right")
    assert (result.kept.horizon[alone] == one.next_id + later - 1).all()
