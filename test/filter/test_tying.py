"""Pieces of a map: apart they know nothing of each other, tied they are one from the beginning."""

from dataclasses import replace

import numpy as np
import pytest
import worlds

from multi_robot_slam.filter import rejuvenation, snapshot, tying
from multi_robot_slam.filter.pieces import Pieces
from multi_robot_slam.filter.running import ParticleFilter
from multi_robot_slam.filter.settings import NO_REJUVENATION, RejuvenationSettings
from multi_robot_slam.filter.vote import Vote
from multi_robot_slam.models.frames import BodySightings, Start
from multi_robot_slam.models.motion import increment, wrap
from multi_robot_slam.smoothing.prior import SMALLEST_SIGMA

SECOND = 10**9
ORIGIN = Start(np.zeros(3), np.zeros((3, 3)))


def settings(particles=60, delay_s=0.0, unknowns=1800, **changes):
    rest = RejuvenationSettings(ancestors_below=0.5, delay_s=delay_s, unknowns=unknowns)
    return worlds.settings(
        particles=particles,
        **{"proposal": "informed", "resample_below": 0.5, "exclusive": True, "rejuvenation": rest}
        | changes,
    )


def drive(steps, seed=3, robots=2, seen=8, unknown=(1,)):
    """Steps one second apart; the `unknown` robots start at the origin of their own frame."""
    made = []
    for t, frames in enumerate(worlds.drive(seed, steps, robots, seen)):
        frames = [replace(frame, stamp_ns=t * SECOND) for frame in frames]
        if t == 0:
            frames = [replace(f, start=ORIGIN if f.robot in unknown else None) for f in frames]
        made.append(frames)
    return made


def begun(own, robots=2, unknown=(1,), seed=1):
    are_known = np.isin(np.arange(robots), unknown, invert=True)
    starts = np.where(are_known[:, None], worlds.START[:robots], 0.0)
    return ParticleFilter(starts, own, np.random.default_rng(seed), are_known=are_known)


def run(steps, own, robots=2, unknown=(1,), seed=1):
    """The filter after the steps, and what was tied."""
    particles = begun(own, robots, unknown, seed)
    ties = [info.tied for info in map(particles.step, steps) if info.tied is not None]
    return particles, ties


def truly_turned(robot=1):
    """The vote that says how a robot's own frame lies in `map`."""
    none = np.empty((0, 2), int)
    covariance = np.diag([0.02, 0.02, 0.01]) ** 2
    return Vote(worlds.START[robot], covariance, none, 9, 2, np.zeros(2), 1e-12)


def never_tied(monkeypatch):
    monkeypatch.setattr(tying, "tie", lambda *arguments: None)


def content(state):
    found = [state.poses, state.log_weights, state.log_weight_sum, *state.prior]
    for m in range(state.poses.shape[2]):
        found += state.landmarks.of_particle(m)
        found += [record.poses[:, row] for record, row in state.history.lineage(m)]
    return b"".join(np.ascontiguousarray(part).tobytes() for part in found)


@pytest.mark.parametrize("proposal", ["motion", "informed"])
@pytest.mark.parametrize("unknowns", [150, 1800])
@pytest.mark.parametrize("alone", [0, 1])
def test_apart_pieces_share_no_landmark(proposal, unknowns, alone, monkeypatch):
    """Through resampling, rejuvenation and settling, although all see the same landmarks.

    The frame of robot 0 happens to be `map`, so that they are in the same places, too.
    """
    never_tied(monkeypatch)
    own = settings(unknowns=unknowns, proposal=proposal)
    steps = drive(30, robots=3, unknown=(alone,))
    particles, _ = run(steps, own, 3, (alone,))
    state = particles.state
    others = [robot for robot in range(3) if robot != alone]
    assert state.pieces.of_robots.tolist() == [alone + 1 if r == alone else 0 for r in range(3)]
    assert (len(state.history.settled) > 0) is (unknowns == 150)
    landmarks = state.landmarks
    alive = landmarks.alive()
    piece_of = dict(
        zip(landmarks.ids[alive].tolist(), landmarks.pieces[alive].tolist(), strict=True)
    )
    for record in state.history.records:
        named = {piece_of[n] for n in np.unique(record.matches).tolist() if n in piece_of}
        assert named <= {state.pieces.of_robots[record.robot]}
    shared = np.intersect1d(
        *(
            np.concatenate([r.matches.ravel() for r in state.history.records if r.robot == robot])
            for robot in others
        )
    )
    assert len(shared) > 5
    of_prior = np.array([piece_of[n] for n in state.prior.ids.tolist() if n in piece_of])
    rows = [3 * robot + np.arange(3) for robot in (alone, *others)]
    assert not state.prior.covariance[np.ix_(rows[0], np.concatenate(rows[1:]))].any()
    if unknowns == 150:
        assert set(of_prior.tolist()) == {0, alone + 1}


def test_a_piece_is_certain_where_it_begins(monkeypatch):
    never_tied(monkeypatch)
    particles, _ = run(drive(12), settings())
    own = [record for record in particles.state.history.records if record.robot == 1]
    assert np.abs(own[0].poses).max() < 10 * SMALLEST_SIGMA


def test_who_is_of_another_piece_is_not_seen(monkeypatch):
    never_tied(monkeypatch)
    steps = drive(10)
    sightings = BodySightings(np.array([1]), np.ones((1, 2)), np.array([[0.01, 0, 0.01]]))
    seeing = [[replace(frames[0], sightings=sightings), *frames[1:]] for frames in steps]
    without, _ = run(steps, settings())
    seen, _ = run(seeing, settings())
    assert content(seen.state) == content(without.state)
    known, _ = run(seeing, settings(), unknown=())
    assert content(known.state) != content(without.state)


def test_of_one_piece_nothing_is_drawn_or_looked_for(monkeypatch):
    def fail(*arguments):
        raise AssertionError

    monkeypatch.setattr(tying, "_voted", fail)
    run(drive(10, unknown=()), settings(), unknown=())


@pytest.fixture(scope="module", params=[150, 1800])
def apart(request):
    """Filter settings and a state of two pieces, with settled frames in one case."""
    own = settings(particles=80, unknowns=request.param)
    with pytest.MonkeyPatch.context() as monkeypatch:
        never_tied(monkeypatch)
        particles, _ = run(drive(30), own)
    return own, particles.state, request.param


def test_turning_a_piece_leaves_what_is_in_it(apart):
    """Distances and covariances seen from its robot; and all of the other piece."""
    _, state, _ = apart
    old = snapshot_of(state)
    vote = truly_turned()._replace(covariance=np.zeros((3, 3)))
    tying.turn(state, 2, vote, np.random.default_rng(0))
    try:
        check_turned(old, snapshot_of(state), vote.pose)
    finally:
        back = increment(vote.pose, np.zeros(3))
        tying.turn(state, 2, vote._replace(pose=back), np.random.default_rng(0))
    check_turned(old, snapshot_of(state), np.zeros(3))


def snapshot_of(state):
    """What the particles hold, in float64."""
    landmarks = state.landmarks
    columns = landmarks.alive()
    columns = columns[np.argsort(landmarks.ids[columns])]
    everyone = np.arange(state.poses.shape[2])
    return {
        "poses": state.poses.copy(),
        "pieces": landmarks.pieces[columns].copy(),
        "planes": landmarks.planes_of(columns, everyone).astype(float),
        "records": [(r.robot, r.poses.copy()) for r in state.history.records],
        "settled": [state.history.settled.path(robot)[1] for robot in range(2)],
        "prior": state.prior,
        "optimum": state.optimum.poses.copy(),
        "anchors": state.existence.anchors.copy(),
    }


def moved(pose, seen):
    """Poses (3, n) seen from `pose`, in map."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, y, yaw = seen
    return np.stack([pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y, yaw + pose[2]])


def check_turned(old, new, pose):
    """Robot 1 and its landmarks were moved by `pose`, nothing else was."""

    def same_pose(found, expected):
        np.testing.assert_allclose(found[:2], expected[:2], atol=1e-9)
        np.testing.assert_allclose(wrap(found[2] - expected[2]), 0, atol=1e-9)

    np.testing.assert_array_equal(new["poses"][0], old["poses"][0])
    same_pose(new["poses"][1], moved(pose, old["poses"][1]))
    own = old["pieces"] == 2
    np.testing.assert_array_equal(new["planes"][~own], old["planes"][~own])
    held = old["planes"][own][:, 0] < 1e8
    np.testing.assert_array_equal(held, new["planes"][own][:, 0] < 1e8)
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    for before, after, has in zip(old["planes"][own], new["planes"][own], held, strict=True):
        expected = turn @ before[:3, has] + np.array([[pose[0]], [pose[1]], [0]])
        np.testing.assert_allclose(after[:3, has], expected, atol=1e-5)
        full = before[[3, 4, 5, 4, 6, 7, 5, 7, 8]][:, has].T.reshape(-1, 3, 3)
        found = after[[3, 4, 5, 4, 6, 7, 5, 7, 8]][:, has].T.reshape(-1, 3, 3)
        np.testing.assert_allclose(found, turn @ full @ turn.T, rtol=1e-4, atol=1e-7)
    for (robot, before), (_, after) in zip(old["records"], new["records"], strict=True):
        same_pose(after, moved(pose, before) if robot == 1 else before)
    np.testing.assert_array_equal(new["settled"][0], old["settled"][0])
    if len(old["settled"][1]):
        same_pose(new["settled"][1].T, moved(pose, old["settled"][1].T))
    before, after = old["prior"], new["prior"]
    same_pose(after.poses[1], moved(pose, before.poses[1]))
    np.testing.assert_array_equal(after.poses[0], before.poses[0])
    robots = [robot for robot, _ in old["records"]][: len(old["optimum"])]
    for robot, one, other in zip(robots, old["optimum"], new["optimum"], strict=True):
        same_pose(other, moved(pose, one) if robot == 1 else one)
    same_pose(
        new["anchors"][1],
        moved(pose, old["anchors"][1]) if old["anchors"][1, 0] < 1e8 else old["anchors"][1],
    )


@pytest.mark.parametrize("apart", [150], indirect=True)
def test_a_turned_prior_knows_inside_what_it_knew_and_nothing_of_where(apart):
    _, state, _ = apart
    before = state.prior
    vote = truly_turned()
    after = tying._turned_prior(state, 2, vote)
    landmarks = state.landmarks
    piece_of = dict(zip(landmarks.ids.tolist(), landmarks.pieces.tolist(), strict=True))
    own = [row for row, n in enumerate(before.ids.tolist()) if piece_of[n] == 2]
    rows = before.rows(np.array([1]), np.array(own))

    def seen(prior):
        """Mean and covariance of the centres in the frame of the robot's anchor."""
        x, y, yaw = prior.poses[1]
        cos, sin = np.cos(yaw), np.sin(yaw)
        back = np.array([[cos, sin], [-sin, cos]])
        offset = prior.centres[own, :2] - [x, y]
        jacobian = np.zeros((2 * len(own), len(rows)))
        for k, (dx, dy) in enumerate(offset):
            jacobian[2 * k : 2 * k + 2, :2] = -back
            jacobian[2 * k : 2 * k + 2, 2] = back @ [dy, -dx]
            jacobian[2 * k : 2 * k + 2, 3 + 2 * k : 5 + 2 * k] = back
        covariance = jacobian @ prior.covariance[np.ix_(rows, rows)] @ jacobian.T
        return offset @ back.T, covariance

    for found, expected in zip(seen(after), seen(before), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-8)
    gained = after.covariance[3:6, 3:6] - before.covariance[3:6, 3:6]
    assert np.trace(gained) > 100 * np.trace(vote.covariance)
    other = np.setdiff1d(np.arange(len(before.covariance)), rows)
    np.testing.assert_array_equal(
        after.covariance[np.ix_(other, other)], before.covariance[np.ix_(other, other)]
    )


@pytest.mark.parametrize("unknowns", [150, 1800])
@pytest.mark.parametrize("late", [12, 28])
def test_tied_pieces_are_one_from_the_beginning(unknowns, late, monkeypatch):
    """Rejuvenated after the tie, paths and map are those of a start that was believed vaguely."""
    never_tied(monkeypatch)
    own = settings(particles=800, unknowns=unknowns, learn_noise=False)
    steps = drive(late)
    particles, _ = run(steps, own)
    vote = truly_turned()
    state = particles.state
    pairs = pairs_of(state, vote)
    tying.turn(state, 2, vote, np.random.default_rng(5))
    state.pieces = Pieces(np.zeros(2, int), np.arange(2), pairs=pairs)
    state.landmarks.pieces[:] = 0
    state, done = renewed(state, own)
    assert done.groups
    assert not len(state.pieces.pairs)

    vague = Start(worlds.START[1], tying.VAGUER * vote.covariance)
    told = [[*steps[0][:1], replace(steps[0][1], start=vague)], *steps[1:]]
    one = begun(own, unknown=())
    for frames in told:
        one.step(frames)
    other, _ = renewed(one.state, own)
    for robot in range(2):
        mean, expected = state.poses[robot].mean(axis=1), other.poses[robot].mean(axis=1)
        spread = np.sqrt(np.diag(np.cov(other.poses[robot])))
        assert (np.abs(mean - expected) < 0.25 * spread).all()
        found = np.sqrt(np.diag(np.cov(state.poses[robot])))
        np.testing.assert_allclose(found, spread, rtol=0.15)
    first = [first_pose(s, 1) for s in (state, other)]
    np.testing.assert_allclose(first[0][:2], first[1][:2], atol=0.1)


def test_the_pairs_that_voted_are_one_to_begin_with(monkeypatch):
    """Although nothing looks alike enough for smoothing to join it."""
    never_tied(monkeypatch)
    own = settings()
    particles, _ = run(drive(12), own)
    state, vote = particles.state, truly_turned()
    pairs = pairs_of(state, vote)
    assert len(pairs) > 10
    tying.turn(state, 2, vote, np.random.default_rng(5))
    state.pieces = Pieces(np.zeros(2, int), np.arange(2), pairs=pairs)
    state.landmarks.pieces[:] = 0
    made, _ = renewed(state, replace(own, descriptor_gate=1e-9))
    columns, _ = made.landmarks.of_particle(int(np.argmax(made.log_weight_sum)))
    held = made.landmarks.ids[columns]
    assert np.isin(pairs[:, 0], held).all()
    assert not np.isin(pairs[:, 1], held).any()


def test_three_votes_in_a_row_must_say_the_same():
    vote = truly_turned()
    elsewhere = vote._replace(pose=vote.pose + np.array([2.0, 0, 0]))
    turned = vote._replace(pose=vote.pose + np.array([0, 0, np.pi]))
    doubted = vote._replace(chance=1e-3)

    def agreed(*votes):
        pieces = Pieces(np.arange(3), np.arange(3))
        for found in votes:
            pieces, is_enough = tying._noted(pieces, 0, 1, found)
            pieces, other = tying._noted(pieces, 0, 2, None)
            assert not other
        return is_enough

    assert agreed(vote, vote, vote)
    assert agreed(elsewhere, vote, vote, vote)
    for votes in ((vote, vote), (vote, elsewhere, vote), (vote, turned, vote)):
        assert not agreed(*votes)
    for odd in (elsewhere, turned, doubted, None):
        assert not agreed(vote, vote, odd)
        assert not agreed(vote, odd, vote)


def first_pose(state, robot):
    _, settled = state.history.settled.path(robot)
    records = [r.poses.mean(axis=1) for r in state.history.records if r.robot == robot]
    return [*settled, *records][0]


def pairs_of(state, vote):
    """Ids of landmarks of both pieces that are one."""
    landmarks = state.landmarks
    columns, _ = landmarks.of_particle(int(np.argmax(state.log_weight_sum)))
    ours, theirs = (columns[landmarks.pieces[columns] == piece] for piece in (0, 2))
    alike = landmarks.descriptors[ours] @ landmarks.descriptors[theirs].T
    pairs = np.argwhere(alike > 0.95)
    ids = np.column_stack([landmarks.ids[ours[pairs[:, 0]]], landmarks.ids[theirs[pairs[:, 1]]]])
    once = [np.unique(column, return_counts=True) for column in ids.T]
    single = [np.isin(column, u[c == 1]) for column, (u, c) in zip(ids.T, once, strict=True)]
    return np.sort(ids[single[0] & single[1]], axis=1).astype(np.int64)


def renewed(state, own):
    rng = np.random.default_rng(8)
    alone = replace(own, threads=1)
    made, done = rejuvenation.rejuvenate(snapshot.taken(state, alone, rng), alone, rng)
    return made or state, done


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("unknown", [(1,), (0,), (1, 2)])
def test_robots_of_unknown_starts_are_tied_in(seed, unknown):
    """Where they truly are, whoever fixes `map`; and the map has each landmark once."""
    robots = 3
    particles, ties = run(
        drive(60, seed, robots, unknown=unknown), settings(200, delay_s=1.0), robots, unknown
    )
    assert len(ties) == len(unknown)
    assert not particles.state.pieces.are_many
    known, _ = run(drive(60, seed, robots, unknown=()), settings(200, delay_s=1.0), robots, ())
    for robot in range(robots):
        mean, expected = (p.state.poses[robot].mean(axis=1) for p in (particles, known))
        error = mean - expected
        assert np.hypot(*error[:2]) < 0.3
        assert np.abs(wrap(error[2])) < 0.1
    count, expected = (len(p.state.landmarks.of_particle(0)[0]) for p in (particles, known))
    assert count < 1.3 * expected


@pytest.mark.parametrize("proposal", ["motion", "informed"])
def test_without_rejuvenation_robots_are_tied_in_as_well(proposal):
    """Each particle then keeps the pose that it drew, and the weights choose."""
    own = settings(400, rejuvenation=NO_REJUVENATION, proposal=proposal)
    particles, ties = run(drive(60, 0, 3, unknown=(1, 2)), own, 3, (1, 2))
    assert [tie.is_in_map for tie in ties] == [False, True]
    known, _ = run(drive(60, 0, 3, unknown=()), own, 3, ())
    error = particles.state.poses.mean(axis=2) - known.state.poses.mean(axis=2)
    assert np.abs(error[:, :2]).max() < 0.3
    assert np.abs(wrap(error[:, 2])).max() < 0.1


@pytest.mark.parametrize("delay_s", [0.0, 2.0])
def test_same_bytes_whether_there_is_a_worker_or_not(delay_s):
    results = []
    for threads in (1, 2):
        particles, ties = run(drive(40), settings(delay_s=delay_s, threads=threads))
        assert len(ties) == 1
        results.append(content(particles.state))
    assert results[0] == results[1]
