"""A robot that was lost: it and what it has seen since are a piece as if it had come new."""

from dataclasses import replace

import numpy as np
import pytest
import worlds

from multi_robot_slam.filter import losing, rejuvenation, snapshot
from multi_robot_slam.filter.losing import Misled, lose
from multi_robot_slam.filter.running import ParticleFilter
from multi_robot_slam.filter.settings import RejuvenationSettings
from multi_robot_slam.models.frames import BodySightings, Start
from multi_robot_slam.models.motion import increment, wrap

TICK = 4 * 10**8
AT = 12
"""The step in which odometry misleads robot 1."""
JUMP = np.array([1.0, -0.6, 0.9])
LATER = np.random.default_rng(5)


def settings(particles=200, unknowns=1800, delay_s=0.0):
    rest = RejuvenationSettings(ancestors_below=0.5, delay_s=delay_s, unknowns=unknowns)
    return worlds.settings(
        particles=particles,
        proposal="informed",
        resample_below=0.5,
        exclusive=True,
        rejuvenation=rest,
        learn_noise=False,
    )


def drive(steps=20, misled=(AT,), seed=3, jump=JUMP):
    """Two robots; in steps `misled` robot 1 goes elsewhere than its odometry tells."""
    made = []
    for t, frames in enumerate(worlds.drive(seed, steps, 2, 8)):
        one, other = (replace(frame, stamp_ns=t * TICK) for frame in frames)
        made.append([one, replace(other, motion=other.motion + jump * (t in misled))])
    return made


def run(steps, own, are_known=(True, True)):
    are_known = np.array(are_known)
    starts = np.where(are_known[:, None], worlds.START[: len(are_known)], 0.0)
    particles = ParticleFilter(starts, own, np.random.default_rng(1), are_known=are_known)
    for frames in steps:
        particles.step(frames)
    return particles.state


@pytest.fixture
def apart(monkeypatch):
    """Nothing is tied."""
    monkeypatch.setattr("multi_robot_slam.filter.tying.tie", lambda *_: None)
    monkeypatch.setattr(losing, "_slipped", lambda *_: None)


def lost(state, own, first=AT, since=AT, robot=1):
    return lose(state, robot, Misled(first * TICK, since * TICK), own, LATER)


def renewed(state, own):
    old = snapshot.taken(state, own, np.random.default_rng(2))
    made, done = rejuvenation.rejuvenate(old, own, np.random.default_rng(3))
    assert not done.failures
    return made


def from_its_start(state, robot):
    """Means and deviations of the path's end, seen from the mean start of the robot."""
    first = next(r for r in state.history.records if r.robot == robot)
    poses = np.array([increment(first.poses.mean(axis=1), pose) for pose in state.poses[robot].T])
    return poses.mean(axis=0), poses.std(axis=0)


@pytest.mark.usefixtures("apart")
def test_it_is_as_if_it_had_come_new():
    """The same as a third robot that starts nobody knows where, with the frames since then.

    It is so far away that nothing is matched by chance meanwhile.
    """
    own = settings(800)
    steps = drive(jump=np.array([40.0, 0.0, 2.0]))
    state = run(steps, own)
    found = lost(state, own)
    assert (found.robot, found.another, found.tie) == (1, 2, None)
    state = renewed(state, own)

    new = Start(np.zeros(3), np.zeros((3, 3)))
    others = [
        [one, replace(other, robot=2, motion=np.zeros(3) if t == AT else other.motion,
                      start=new if t == AT else None)] if t >= AT else [one, other]
        for t, (one, other) in enumerate(steps)
    ]  # fmt: skip
    came = renewed(run(others, own, (True, True, False)), own)
    for found, expected in zip(from_its_start(state, 2), from_its_start(came, 2), strict=True):
        np.testing.assert_allclose(found, expected, atol=0.012)
    mean, expected = state.poses[0].mean(axis=1), came.poses[0].mean(axis=1)
    spread = came.poses[0].std(axis=1)
    assert (np.abs(mean - expected) < 0.25 * spread).all()
    np.testing.assert_allclose(state.poses[0].std(axis=1), spread, rtol=0.15)
    assert held_by(state) == held_by(came)


def held_by(state):
    """How many landmarks the best particle has in each piece."""
    columns, _ = state.landmarks.of_particle(int(np.argmax(state.log_weight_sum)))
    return np.unique(state.landmarks.pieces[columns], return_counts=True)[1].tolist()


@pytest.mark.usefixtures("apart")
@pytest.mark.parametrize("unknowns", [150, 1800])
def test_pieces_share_nothing(unknowns):
    own = settings(60, unknowns)
    state = run(drive(26), own)
    assert (len(state.history.settled) > 0) is (unknowns == 150)
    lost(state, own)
    piece = state.pieces.of_robots[2]
    assert state.pieces.of_robots.tolist() == [0, 0, piece]
    assert state.pieces.team.tolist() == [0, 1, 1]
    check_apart(state, piece)
    for _ in range(3):
        state = renewed(state, own)
        check_apart(state, piece)


def check_apart(state, piece, robot=2):
    landmarks = state.landmarks
    alive = landmarks.alive()
    piece_of = dict(np.column_stack([landmarks.ids[alive], landmarks.pieces[alive]]).tolist())
    for record in state.history.records:
        named = {piece_of[n] for n in np.unique(record.matches).tolist() if n in piece_of}
        assert named <= {state.pieces.of_robots[record.robot]}
    prior = state.prior
    centres = np.flatnonzero([piece_of.get(n) == piece for n in prior.ids.tolist()])
    rows = prior.rows(np.array([robot]), centres)
    others = np.setdiff1d(np.arange(len(prior.covariance)), rows)
    assert not prior.covariance[np.ix_(rows, others)].any()
    assert np.linalg.eigvalsh(prior.covariance)[0] > 0


@pytest.mark.usefixtures("apart")
def test_all_else_stays():
    own = settings(60)
    state, before = run(drive(), own), run(drive(), own)
    lost(state, own)
    np.testing.assert_array_equal(state.poses[:2], before.poses)
    np.testing.assert_array_equal(state.prior.poses[:2], before.prior.poses)
    for name in ("scales", "bias", "noise"):
        for found, expected in zip(getattr(state, name), getattr(before, name), strict=True):
            np.testing.assert_array_equal(found[tuple(slice(n) for n in expected.shape)], expected)
    for record, old in zip(state.history.records, before.history.records, strict=True):
        if old.robot == 0 or old.stamp_ns < AT * TICK:
            assert record.robot == old.robot
            np.testing.assert_array_equal(record.matches, old.matches)
            np.testing.assert_array_equal(record.motion, old.motion)
        else:
            assert record.robot == 2
            assert len(record.positions) == len(record.matches) == len(record.new_ids)


@pytest.mark.usefixtures("apart")
def test_in_every_particle_the_piece_begins_alike_and_is_what_it_was():
    own = settings(60)
    state, before = run(drive(), own), run(drive(), own)
    lost(state, own)
    first = next(record for record in state.history.records if record.robot == 2)
    old = next(r for r in before.history.records if (r.robot, r.stamp_ns) == (1, first.stamp_ns))
    apart = first.poses - first.start.mean[:, None]
    np.testing.assert_allclose(apart, 0, atol=1e-9)
    for m in range(0, 60, 7):
        row = next(row for record, row in state.history.lineage(m) if record is first)
        np.testing.assert_allclose(
            increment(first.poses[:, row], state.poses[2, :, m]),
            increment(old.poses[:, row], before.poses[1, :, m]),
            atol=1e-9,
        )
        columns, values = state.landmarks.of_particle(m)
        mine = columns[state.landmarks.pieces[columns] == state.pieces.of_robots[2]]
        ids = state.landmarks.ids[mine]
        places, olds = (
            dict(zip(s.landmarks.ids[c].tolist(), v[:, :2].astype(float), strict=True))
            for s, (c, v) in ((state, (columns, values)), (before, before.landmarks.of_particle(m)))
        )
        assert len(ids) > 3
        for n in ids.tolist():
            seen, was = (
                np.hypot(*(place[n] - pose[:2]))
                for place, pose in ((places, state.poses[2, :, m]), (olds, before.poses[1, :, m]))
            )
            assert abs(seen - was) < 1e-4


@pytest.mark.usefixtures("apart")
def test_what_was_seen_meanwhile_is_forgotten():
    own = settings(60)
    steps = drive(misled=(AT, AT + 1, AT + 2))
    state = run(steps, own)
    between = [
        r for r in state.history.records if r.robot == 1 and 0 <= r.stamp_ns // TICK - AT < 2
    ]
    made = np.concatenate([np.unique(r.matches) for r in between])
    others = [
        np.unique(r.matches) for r in state.history.records if not any(r is b for b in between)
    ]
    made = np.setdiff1d(made, np.concatenate(others))
    assert len(made) > 5
    lost(state, own, AT, AT + 2)
    assert [len(record.positions) for record in between] == [0, 0]
    assert {record.robot for record in between} == {1}
    assert not np.isin(made, state.landmarks.ids).any()
    first = next(record for record in state.history.records if record.robot == 2)
    assert first.stamp_ns == (AT + 2) * TICK
    assert first.start is not None
    assert not first.motion.any()
    renewed(state, own)


def test_wheels_that_slipped_are_found_at_once():
    """By what was seen the moment before, where the robot truly is."""
    own = settings()
    state, honest = run(drive(), own), run(drive(misled=()), own)
    found = lost(state, own)
    assert found.tie.is_in_map
    assert state.pieces.of_robots.tolist() == [0, 0, 0]
    state, honest = renewed(state, own), renewed(honest, own)
    off = state.poses[2].mean(axis=1) - honest.poses[1].mean(axis=1)
    off[2] = wrap(off[2])
    assert (np.abs(off) < [0.08, 0.08, 0.04]).all()


def test_who_slipped_twice_is_tied_to_what_it_saw_before_the_first_time():
    own = settings()
    state = run(drive(misled=(AT, AT + 2)), own)
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(losing, "_slipped", lambda *_: None)
        assert lost(state, own, AT, AT).tie is None
    found = lost(state, own, AT + 2, AT + 2, robot=2)
    assert found.tie.is_in_map
    assert state.pieces.of_robots[3] == 0
    assert state.pieces.team.tolist() == [0, 1, 1, 1]


def test_of_long_ago_nothing_is_the_same_by_its_looks_alone(monkeypatch):
    own = settings(60)
    monkeypatch.setattr(losing, "SOON_S", 0.5)
    state = run(drive(), own)
    assert lost(state, own).tie is None


@pytest.mark.usefixtures("apart")
@pytest.mark.parametrize("unknowns", [150, 1800])
def test_who_never_was_where_it_was_told_is_a_piece_with_all_it_did(unknowns):
    own = settings(60, unknowns)
    state = run(drive(26, misled=()), own)
    first = next(record for record in state.history.records if record.robot == 1)
    first.start = Start(first.poses.mean(axis=1), np.eye(3)) if first.stamp_ns == 0 else None
    assert lose(state, 1, None, own, LATER) == (1, 1, 0, None)
    piece = state.pieces.of_robots[1]
    assert piece > 0
    assert len(state.poses) == 2
    if first.start is not None:
        assert not first.start.covariance.any()
        assert np.abs(state.prior.covariance[3:6, 3:6]).max() < 1e-9
    check_apart(state, piece, 1)
    check_apart(renewed(state, own), piece, 1)


@pytest.mark.usefixtures("apart")
def test_who_saw_the_robot_saw_the_one_that_it_is_now():
    own = settings(60)
    sees = BodySightings(np.array([1]), np.ones((1, 2)), np.array([[0.01, 0, 0.01]]))
    back = sees._replace(others=np.array([0]))
    steps = [[replace(a, sightings=sees), replace(b, sightings=back)] for a, b in drive()]
    state = run(steps, own)
    lost(state, own, AT, AT + 2)
    for record in state.history.records:
        step = record.stamp_ns // TICK
        seen = [1 if step < AT else 2] if record.robot == 0 else [0]
        assert record.sightings.others.tolist() == ([] if AT <= step < AT + 2 else seen)
    renewed(state, own)


def test_there_is_an_end_to_robots(monkeypatch):
    monkeypatch.setattr(losing, "MOST_ROBOTS", 2)
    own = settings(60)
    state = run(drive(), own)
    assert lost(state, own) is None
    assert state.pieces.of_robots.tolist() == [0, 0]


@pytest.mark.parametrize("delay_s", [0.0, 1.4])
def test_the_filter_goes_on_with_it(delay_s):
    """As soon as no rejuvenation is under way, whatever its thread does."""

    def content(threads):
        own = replace(settings(100, delay_s=delay_s), threads=threads)
        starts = worlds.START[:2]
        particles = ParticleFilter(starts, own, np.random.default_rng(1))
        indices, told = [0, 1], []
        for t, frames in enumerate(drive(24)):
            info = particles.step([frame.called(indices) for frame in frames])
            for each in info.lost:
                indices[1] = each.another
                told.append((t, each.another))
            if t == AT + 2:
                particles.lose(1, Misled(AT * TICK, AT * TICK))
        particles.close()
        return told, particles.state.poses.tobytes()

    told, poses = content(1)
    assert told
    assert AT + 2 < told[0][0] <= AT + 8
    assert (told, poses) == content(2)
