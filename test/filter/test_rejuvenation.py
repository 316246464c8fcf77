"""Rejuvenation: against the exact smoother, filtering along the drawn paths, and its laws."""

from copy import deepcopy
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import linear_world as linear
import literal_algorithm1 as literal
import numpy as np
import pytest
import worlds

from msg_defs.types import ObservationSet
from multi_robot_slam.filter import landmarks, new_past, rbpf, rejuvenation, resampling, snapshot
from multi_robot_slam.filter.covisible import Covisible
from multi_robot_slam.filter.landmarks import Landmarks
from multi_robot_slam.filter.new_past import tempered
from multi_robot_slam.filter.running import ParticleFilter
from multi_robot_slam.filter.settings import NO_REJUVENATION, FilterSettings, RejuvenationSettings
from multi_robot_slam.models import stereo
from multi_robot_slam.models.frames import Start
from multi_robot_slam.models.motion import MotionSettings
from multi_robot_slam.models.symmetric import pack, unpack
from multi_robot_slam.smoothing import draws, solve
from multi_robot_slam.smoothing.solve import SmoothingError

ALWAYS = RejuvenationSettings(ancestors_below=1.0, delay_s=0)


def run(steps, settings, seed=0, dtype=np.float64):
    rng = np.random.default_rng(seed)
    particles = ParticleFilter(worlds.START, settings, rng)
    particles.state = rbpf.init(worlds.START, settings, dtype)
    infos = [particles.step(frames) for frames in steps]
    return particles.state, infos


def often(particles, gate, exclusive=True, **changes):
    """Settings of a filter that has many association histories and rejuvenates all the time."""
    return worlds.settings(
        particles=particles,
        proposal="informed",
        gate=gate,
        exclusive=exclusive,
        resample_below=0.5,
        rejuvenation=RejuvenationSettings(ancestors_below=0.5, share=0.1, delay_s=0, **changes),
    )


def in_two_groups(small, large):
    """A state whose first particles, `small` of them, are one group, and the others another."""
    settings = worlds.settings(
        particles=small + large, proposal="informed", gate=1e3, resample_below=0.01
    )
    state, _ = run(worlds.drive(2, steps=6), settings)
    state.log_weights[:] = 0
    state.history.signatures[:small] = 7
    state.history.signatures[small:] = 3
    return state, settings


def assert_maps_are_the_lineages(state, but=None):
    """Each particle holds just the landmarks that its past names, `but` that."""
    for m in range(len(state.log_weights)):
        held = state.landmarks.ids[state.landmarks.of_particle(m)[0]]
        named = [record.matches[:, row] for record, row in state.history.lineage(m)]
        named = np.concatenate([state.prior.ids, *named])
        np.testing.assert_array_equal(np.sort(held), np.unique(named[named != but]))


def rejuvenated(state, settings, seed=1):
    """The state rejuvenated now, whether due or not, and what was done."""
    rng = np.random.default_rng(seed)
    settings = replace(settings, threads=1)
    return rejuvenation.rejuvenate(snapshot.taken(state, settings, rng), settings, rng)


def exact_smoother(moves, seen, start):
    """Least squares over all positions (T, 2) and landmarks (N, 3): mean and covariance.

    The first position is known where `start`, the belief about it, is None.
    """
    steps, count = len(moves), linear.LANDMARKS
    size = 2 * steps + 3 * count
    rows, values, sigmas = [], [], []
    for t in range(1, steps):
        for axis in range(2):
            row = np.zeros(size)
            row[2 * t + axis], row[2 * (t - 1) + axis] = 1, -1
            rows.append(row)
            values.append(moves[t, axis])
            sigmas.append(linear.SIGMA_MOVE)
    for t in range(steps):
        for n in range(count):
            for axis in range(3):
                row = np.zeros(size)
                row[2 * steps + 3 * n + axis] = 1
                if axis < 2:
                    row[2 * t + axis] = -1
                rows.append(row)
                values.append(seen[t, n, axis])
                sigmas.append(linear.SIGMA_SEE)
    if start is not None:
        whitener = np.linalg.inv(np.linalg.cholesky(start.covariance[:2, :2]))
        rows += list(np.pad(whitener, ((0, 0), (0, size - 2))))
        values += list(whitener @ start.mean[:2])
        sigmas += [1.0, 1.0]
    free = np.arange(2 if start is None else 0, size)
    A = np.array(rows)[:, free] / np.array(sigmas)[:, None]
    covariance = np.linalg.inv(A.T @ A)
    return covariance @ A.T @ (np.array(values) / sigmas), covariance


BELIEVED = Start(
    np.array([0.5, -1.0, 0.0]), np.array([[0.25, 0.1, 0.0], [0.1, 0.16, 0.0], [0.0, 0.0, 0.0]])
)


@pytest.mark.parametrize("proposal", ["motion", "informed"])
@pytest.mark.parametrize("start", [None, BELIEVED], ids=["known", "believed"])
def test_in_a_linear_world_the_particles_are_the_exact_smoother_s(proposal, start):
    """Whole paths and landmarks, from a filter that had lost all but a few of its ancestors."""
    count = 20_000
    noise = MotionSettings(linear.SIGMA_MOVE, linear.SIGMA_MOVE, 0.0, 0.0)
    settings = FilterSettings(
        particles=count,
        gate=1e6,
        robust_above=1e6,
        proposal=proposal,
        resample_below=1.0,
        motion=noise,
        rejuvenation=NO_REJUVENATION,
    )
    moves, seen = linear.world(3)
    state = rbpf.init(np.zeros((1, 3)), settings, np.float64)
    rng = np.random.default_rng(0)
    descriptors = np.eye(linear.LANDMARKS, 128, dtype=np.float32)
    R = pack(np.tile(linear.SIGMA_SEE**2 * np.eye(3), (linear.LANDMARKS, 1, 1)))
    for t in range(linear.STEPS):
        camera = np.stack([-seen[t, :, 1], seen[t, :, 2], seen[t, :, 0]], axis=1)
        z = ObservationSet("", t, camera, R, descriptors)
        frame = replace(linear.frame(t, moves[t], z), start=None if t else start)
        rbpf.step(state, [frame], settings, rng)
    state, info = rejuvenation.rejuvenate(snapshot.taken(state, settings, rng), settings, rng)
    assert info.alone == 0
    assert info.effective_particles > 0.95 * count

    weights = resampling.normalise(state.log_weights)
    paths = np.concatenate([record.poses[:2] for record in state.history.records])
    paths = paths if start else paths[2:]
    landmarks = state.landmarks
    landmarks.bring_up_to_date(landmarks.alive())
    planes = landmarks.planes[landmarks.columns_of(np.arange(linear.LANDMARKS))]
    places = np.concatenate([paths, planes[:, :3].reshape(-1, count)])
    mean = places @ weights
    covariance = (places - mean[:, None]) * weights @ (places - mean[:, None]).T
    offset = len(paths)
    for n in range(linear.LANDMARKS):
        block = slice(offset + 3 * n, offset + 3 * n + 3)
        covariance[block, block] += unpack(planes[n, 3:] @ weights)
    expected, spread = exact_smoother(moves, seen, start)
    # A heading of sigma 1e-5 stays free.
    np.testing.assert_allclose(mean, expected, atol=5 * np.sqrt(np.diag(spread).max() / count))
    np.testing.assert_allclose(covariance, spread, atol=0.05 * np.diag(spread).max())


def test_landmark_filters_are_those_of_filtering_along_the_drawn_path():
    settings = worlds.settings(particles=5, proposal="informed", gate=1e3, robust_above=1e6)
    state, _ = run(worlds.drive(4, steps=12), settings)
    state, _ = rejuvenated(state, settings)
    # The literal filter looks from a camera: here from one that sits in `base_link`.
    axes = stereo.CAMERA_TO_BODY
    model = literal.Model(settings.gate, settings.descriptor_gate, (0, 0, 0), (0, 0, 0, 0))
    for m in range(5):
        known = {}
        for record, row in list(state.history.lineage(m))[::-1]:
            pose, R = record.poses[:, row], axes.T @ unpack(record.covariances) @ axes
            for b, n in enumerate(record.matches[:, row]):
                G, v = literal.G(pose), record.positions[b] @ axes
                if n not in known:
                    sigma = np.linalg.inv(G.T @ np.linalg.inv(R[b]) @ G)
                    known[n] = literal.g_inverse(pose, v, model), sigma
                    continue
                mu, sigma = known[n]
                K = sigma @ G.T @ np.linalg.inv(G @ sigma @ G.T + R[b])
                known[n] = (
                    mu + K @ (v - literal.g(pose, mu, model)),
                    (np.eye(3) - K @ G) @ sigma,
                )
        columns, values = state.landmarks.of_particle(m)
        assert state.landmarks.ids[columns].tolist() == sorted(known)
        for n, plane in zip(sorted(known), values, strict=True):
            np.testing.assert_allclose(plane[:3], known[n][0], atol=1e-9)
            np.testing.assert_allclose(unpack(plane[3:]), known[n][1], atol=1e-9)


def test_same_seed_same_bytes():
    settings = worlds.settings(
        particles=30, proposal="informed", resample_below=0.5, rejuvenation=ALWAYS
    )
    steps = worlds.drive(7, steps=15, alike=0.2)
    one, infos = run(steps, settings, seed=3)
    other, _ = run(steps, replace(settings, threads=2), seed=3)
    assert sum(info.rejuvenated is not None for info in infos) > 5
    assert one.poses.tobytes() == other.poses.tobytes()
    assert one.log_weights.tobytes() == other.log_weights.tobytes()
    for m in (0, 29):
        assert (
            one.landmarks.of_particle(m)[1].tobytes() == other.landmarks.of_particle(m)[1].tobytes()
        )


def test_without_loops_published_poses_move_less_than_their_standard_deviation():
    """Robots that never see anything again after a few frames: smoothing has little to add."""
    settings = worlds.settings(particles=2000, proposal="informed", resample_below=0.5)
    differences = []
    for seed in range(3):
        steps = straight_ahead(seed, steps=25)
        plain = run(steps, settings, seed=seed)[1]
        fresh = run(
            steps, replace(settings, rejuvenation=replace(ALWAYS, ancestors_below=0.5)), seed=seed
        )[1]
        assert any(info.rejuvenated for info in fresh)
        for a, b in zip(plain, fresh, strict=True):
            for (mean, _), (other, covariance) in zip(a.moments, b.moments, strict=True):
                sigma = np.sqrt(np.diag(covariance)) + 1e-9
                differences.append((mean - other) / sigma)
    assert np.sqrt(np.mean(np.square(differences))) < 1


def straight_ahead(seed, steps):
    """One robot that drives past new landmarks, each seen in three frames."""
    rng = np.random.default_rng(seed)
    descriptors = rng.random((steps + 3, 4, 128))
    descriptors /= np.linalg.norm(descriptors, axis=2, keepdims=True)
    landmarks = rng.uniform([1, -2, 0], [2, 2, 2], (steps + 3, 4, 3))
    landmarks[:, :, 0] += 0.2 * np.arange(steps + 3)[:, None]
    frames = []
    for t in range(steps):
        u = np.array([0.2, 0, 0]) * (t > 0)
        seen = slice(t, t + 3)
        z = worlds.observe(
            np.array([0.2 * t, 0, 0]),
            landmarks[seen].reshape(-1, 3),
            descriptors[seen].reshape(-1, 128),
            rng,
            t,
        )
        frames.append([worlds.frame(0, u + rng.normal(0, 0.01, 3) * (t > 0), z)])
    return frames


def test_particles_with_another_history_keep_it():
    """Two thirds share one history; the others are too few and stay exactly as they were."""
    settings = worlds.settings(particles=30, proposal="informed", gate=1e3, resample_below=0.01)
    state, _ = run(worlds.drive(2, steps=6), settings)
    state.log_weights[:] = 0
    state.history.signatures[20:] = np.arange(10)
    before = state.poses.copy()
    settings = replace(settings, rejuvenation=replace(ALWAYS, share=0.5))
    state, info = rejuvenated(state, settings)
    assert (info.groups, info.alone) == (1, 10)
    assert (state.poses[:, :, 20:] == before[:, :, 20:]).all()
    assert (state.poses[:, :, :20] != before[:, :, :20]).any(axis=(0, 1)).all()


def split(state, records):
    """Give one observation in the first of `records` that fits a landmark of its own, as new."""
    record = next(r for r in records if (r.matches[:, 0] != r.new_ids).all())
    spare = int(record.new_ids[0])
    columns = state.landmarks.reserve(1)
    state.landmarks.ids[columns] = spare
    old = state.landmarks.columns_of(record.matches[:1, 0])
    state.landmarks.bring_up_to_date(old)
    state.landmarks.planes[columns] = state.landmarks.planes[old]
    state.landmarks.commit(
        columns, np.array([len(state.log_weights)]), 0.99 * state.landmarks.descriptors[old]
    )
    record.matches = record.matches.copy()
    record.matches[0] = spare


def test_landmarks_a_particle_had_split_are_joined():
    settings = worlds.settings(particles=10, proposal="informed", gate=1e3, exclusive=True)
    state, _ = run(worlds.drive(5, steps=10), settings)
    whole = len(state.landmarks.of_particle(0)[0])
    split(state, reversed(state.history.records))
    assert len(state.landmarks.of_particle(0)[0]) == whole + 1
    state, _ = rejuvenated(state, settings)
    assert len(state.landmarks.of_particle(0)[0]) == whole
    assert_maps_are_the_lineages(state)


def test_settled_landmarks_that_were_split_are_joined():
    """The first rejuvenation cannot join, since nothing looks alike, and settles what was split."""
    settings = worlds.settings(particles=10, proposal="informed", gate=1e3)
    state, _ = run(worlds.drive(5, steps=40), settings)
    settings = replace(settings, rejuvenation=replace(ALWAYS, unknowns=100))
    whole = len(state.landmarks.of_particle(0)[0])
    split(state, state.history.records)
    state, _ = rejuvenated(state, replace(settings, descriptor_gate=1e-6))
    assert len(state.landmarks.of_particle(0)[0]) == whole + 1
    assert len(state.history.settled) == 60
    assert_maps_are_the_lineages(state)
    state, _ = rejuvenated(state, settings)
    assert len(state.landmarks.of_particle(0)[0]) == whole
    assert_maps_are_the_lineages(state)
    counts, _ = state.history.settled.seen.of_ids(state.landmarks.ids[state.landmarks.alive()])
    assert counts.sum() == 5 * len(state.history.settled)


def test_every_particle_has_a_past_of_its_own_and_the_filter_goes_on():
    steps = worlds.drive(6, steps=40)
    settings = worlds.settings(particles=50, proposal="informed", resample_below=0.5)
    plain, _ = run(steps, settings)
    assert plain.history.distinct_ancestors()[4] < 10
    settings = replace(settings, rejuvenation=replace(ALWAYS, ancestors_below=0.5))
    state, infos = run(steps, settings)
    assert state.history.distinct_ancestors()[4] >= 25
    drawn = [i.rejuvenated for i in infos if i.rejuvenated and i.rejuvenated.groups]
    assert len(drawn) > 2
    for rejuvenated_then in drawn:
        assert 1 <= rejuvenated_then.effective_particles <= 50


def test_is_due_when_few_descend_from_the_last_time():
    settings = worlds.settings(particles=10)
    state = rbpf.init(worlds.START, settings)
    often = RejuvenationSettings(ancestors_below=0.5)
    state.origins = np.repeat(np.arange(4, dtype=np.int32), [3, 3, 3, 1])
    assert rejuvenation.is_due(state, often)
    assert not rejuvenation.is_due(state, RejuvenationSettings())
    state.origins = np.repeat(np.arange(5, dtype=np.int32), 2)
    assert not rejuvenation.is_due(state, often)


def test_with_a_short_window_the_poses_are_as_good_as_with_all():
    steps = worlds.drive(8, steps=60)
    settings = worlds.settings(particles=200, proposal="informed", resample_below=0.5)
    settings = replace(settings, rejuvenation=replace(ALWAYS, ancestors_below=0.5))
    narrow = replace(settings, rejuvenation=replace(settings.rejuvenation, unknowns=150))
    _, whole = run(steps, settings)
    state, few = run(steps, narrow)
    assert len(state.history.settled) > 100
    differences = []
    for a, b in zip(whole, few, strict=True):
        for (mean, _), (other, covariance) in zip(a.moments, b.moments, strict=True):
            differences.append((mean - other) / (np.sqrt(np.diag(covariance)) + 1e-3))
    assert np.sqrt(np.mean(np.square(differences))) < 1
    counts, _ = state.history.settled.seen.of_ids(state.prior.ids)
    assert counts.sum() == 5 * len(state.history.settled)


@pytest.mark.parametrize(("seed", "alike", "gate"), [(2, 0.0, 2.0), (3, 0.3, 4.0), (4, 0.3, 4.0)])
def test_every_particle_holds_just_the_landmarks_of_its_past(seed, alike, gate):
    settings = often(40, gate)
    particles = ParticleFilter(worlds.START, settings, np.random.default_rng(seed))
    alone = 0
    for frames in worlds.drive(seed, steps=30, alike=alike):
        info = particles.step(frames)
        assert_maps_are_the_lineages(particles.state)
        alone += info.rejuvenated.alone if info.rejuvenated else 0
    assert alone > 0


def test_the_prior_forgets_what_no_particle_holds():
    settings = worlds.settings(particles=20, proposal="informed", gate=1e3)
    state, _ = run(worlds.drive(5, steps=40), settings)
    settings = replace(settings, rejuvenation=replace(ALWAYS, unknowns=100))
    state, _ = rejuvenated(state, settings)
    gone = state.prior.ids[[0, 7]]
    alive = state.landmarks.alive()
    state.landmarks.ids[alive[np.isin(state.landmarks.ids[alive], gone)]] = landmarks.FREE
    for record in state.history.records:
        record.matches = np.where(np.isin(record.matches, gone), -1, record.matches)
    state, info = rejuvenated(state, settings)
    assert not info.failures
    assert not np.isin(gone, state.prior.ids).any()
    assert not np.isin(gone, state.covisible.ids).any()
    assert_maps_are_the_lineages(state, but=-1)


def test_settled_frames_say_what_is_near_a_robot_that_has_none_in_the_window():
    """Else the landmarks around a parked robot would not know of each other's errors."""
    together = np.eye(4, dtype=bool)
    together[0, 1] = together[1, 0] = True
    ids = np.array([3, 5, 8, 9])
    covisible = Covisible(ids, together, {0: np.array([3]), 1: np.array([9])})
    old = SimpleNamespace(covisible=covisible)
    records = [SimpleNamespace(robot=1), SimpleNamespace(robot=1)]
    nothing = np.empty((0, 2), int)
    near = new_past._nearby(old, records, [np.array([8]), np.empty(0, int)], nothing)
    np.testing.assert_array_equal(near, [3, 5, 8])


def test_best_particle_is_of_the_largest_group():
    state, settings = in_two_groups(10, 20)
    state, info = rejuvenated(state, replace(settings, rejuvenation=replace(ALWAYS, share=0.1)))
    assert info.groups == 2
    assert rbpf.best_particle(state) >= 10


def test_where_every_group_is_too_small_there_is_no_new_state():
    state, settings = in_two_groups(10, 20)
    new, info = rejuvenated(state, replace(settings, rejuvenation=replace(ALWAYS, share=1.0)))
    assert new is None
    assert info.groups == 0


def test_boxes_hold_what_was_drawn():
    state, settings = in_two_groups(10, 20)
    state, _ = rejuvenated(state, replace(settings, rejuvenation=replace(ALWAYS, share=0.1)))
    alive = state.landmarks.alive()
    boxes = state.landmarks.boxes[alive].copy()
    state.landmarks.bound(alive, settings.gate)
    np.testing.assert_array_equal(boxes, state.landmarks.boxes[alive])


@pytest.mark.parametrize("proposal", ["motion", "informed"])
def test_run_with_boxes_is_the_run_without(proposal, monkeypatch):
    settings = replace(often(30, 11.345), proposal=proposal)
    steps = worlds.drive(9, steps=20)
    state, infos = run(steps, settings)
    assert sum(info.rejuvenated is not None for info in infos) > 3
    monkeypatch.setattr(Landmarks, "near", lambda landmarks, box: landmarks.alive())
    other, _ = run(steps, settings)
    assert state.poses.tobytes() == other.poses.tobytes()
    for m in range(30):
        one, same = (s.landmarks.of_particle(m)[1] for s in (state, other))
        assert one.tobytes() == same.tobytes()


def test_landmarks_seen_in_one_frame_are_two():
    """All look alike and the gate lets everything pass."""
    settings = worlds.settings(particles=10, proposal="informed", gate=1e3)
    for exclusive in (True, False):
        state, _ = run(worlds.drive(5, steps=6), settings)
        deaf = replace(settings, gate=1e9, robust_above=1e9, descriptor_gate=1e9)
        state = rejuvenated(state, replace(deaf, exclusive=exclusive))[0] or state
        held = len(state.landmarks.of_particle(0)[0])
        assert held >= 5 if exclusive else held == 1


def spoiled(state, value):
    """The state after an observation that no filter should have let in."""
    state.history.records[4].positions = state.history.records[4].positions.copy()
    state.history.records[4].positions[0] = value
    return state


def fails_always(*arguments, error=SmoothingError, **named):
    raise error("on purpose")


@pytest.mark.parametrize("error", [SmoothingError, ValueError, np.linalg.LinAlgError])
@pytest.mark.parametrize(("module", "name"), [(solve, "smooth"), (draws, "draw")])
def test_failed_smoothing_makes_no_new_state_and_says_why(module, name, error, monkeypatch):
    state, settings = in_two_groups(10, 20)
    monkeypatch.setattr(module, name, partial(fails_always, error=error))
    new, info = rejuvenated(state, replace(settings, rejuvenation=replace(ALWAYS, share=0.1)))
    assert new is None
    assert info.failures == ("on purpose",)
    assert (info.groups, info.alone, info.effective_particles) == (0, 30, 0)


def test_failed_smoothing_is_tried_again_later(monkeypatch):
    settings = often(50, 11.345)
    monkeypatch.setattr(solve, "smooth", fails_always)
    _, infos = run(worlds.drive(6, steps=40), settings)
    tries = [step for step, info in enumerate(infos) if info.rejuvenated]
    assert all(infos[step].rejuvenated.failures for step in tries)
    assert 1 < len(tries) < 30


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
def test_a_past_that_is_not_finite_fails(value):
    state, settings = in_two_groups(10, 20)
    new, info = rejuvenated(spoiled(state, value), replace(settings, rejuvenation=ALWAYS))
    assert new is None
    assert len(info.failures) == 1
    assert "is not finite" in info.failures[0]


def test_history_that_cannot_be_smoothed_stays_and_the_others_go_on(monkeypatch):
    state, settings = in_two_groups(10, 20)
    before, smooth, calls = deepcopy(state), solve.smooth, []

    def fails_second(*arguments, **named):
        calls.append(arguments)
        return fails_always() if len(calls) == 2 else smooth(*arguments, **named)

    monkeypatch.setattr(solve, "smooth", fails_second)
    state, info = rejuvenated(state, replace(settings, rejuvenation=replace(ALWAYS, share=0.1)))
    assert (info.groups, info.alone, info.failures) == (1, 10, ("on purpose",))
    assert (state.poses[:, :, :10] == before.poses[:, :, :10]).all()
    assert (state.poses[:, :, 10:] != before.poses[:, :, 10:]).any(axis=(0, 1)).all()
    assert rbpf.best_particle(state) >= 10
    assert_maps_are_the_lineages(state)


@pytest.mark.parametrize("spread", [0.1, 2.0, 30.0])
def test_tempered_weights_leave_half_of_the_particles_effective_and_touch_nothing_better(spread):
    exact = np.random.default_rng(0).normal(0, spread, 200)
    weights = tempered(exact)
    effective = resampling.effective_sample_size(resampling.normalise(weights))
    assert effective > 99.9
    if spread == 0.1:
        assert (weights == exact).all()
    else:
        assert effective < 100.1
        np.testing.assert_allclose(weights / exact, (weights / exact)[0])
