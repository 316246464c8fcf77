"""The filter against Algorithm 1 itself, and against its own laws."""

import copy
from dataclasses import replace

import literal_algorithm1 as literal
import numpy as np
import pytest
import worlds

from multi_robot_slam.filter import informed_kernels, kernels, rbpf, resampling
from multi_robot_slam.filter.landmarks import Landmarks
from multi_robot_slam.filter.running import ParticleFilter
from multi_robot_slam.filter.settings import RejuvenationSettings
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.models.symmetric import pack


def run_filter(steps, settings, seed, dtype=np.float32):
    rng = np.random.default_rng(seed)
    particles = ParticleFilter(worlds.START, settings, rng)
    particles.state = rbpf.init(worlds.START, settings, dtype)
    infos = [particles.step(frames) for frames in steps]
    return particles.state, infos


def origins(steps, infos):
    """Landmark id -> (step, robot, b) of the observation that creates it."""
    return {
        int(landmark): (t, frame.robot, b)
        for t, (frames, info) in enumerate(zip(steps, infos, strict=True))
        for frame, seen in zip(frames, info.frames, strict=True)
        for b, landmark in enumerate(seen.new_ids)
    }


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_equals_algorithm_1_draw_for_draw(seed):
    steps = worlds.drive(seed, steps=25, alike=0.3)
    settings = worlds.settings(particles=10)
    state, infos = run_filter(steps, settings, seed, np.float64)
    rng = np.random.default_rng(seed)
    S, choices = literal.run(steps, worlds.START, settings, worlds.MOUNT, rng)

    origin = origins(steps, infos)
    frames = [frame for info in infos for frame in info.frames]
    for frame, choice in zip(frames, choices, strict=True):
        matched = [[origin[int(i)] for i in column] for column in frame.matches.T]
        assert matched == [[c for c, _, _ in row] for row in choice]
    for m, particle in enumerate(S):
        np.testing.assert_allclose(state.poses[:, :, m], particle.poses, rtol=0, atol=1e-9)
        columns, values = state.landmarks.of_particle(m)
        ids = state.landmarks.ids[columns]
        assert [origin[int(i)] for i in ids] == [n.origin for n in particle.landmarks]
        np.testing.assert_allclose(values[:, :3], [n.mu for n in particle.landmarks], atol=1e-8)
        sigmas = pack(np.array([n.sigma for n in particle.landmarks]))
        np.testing.assert_allclose(values[:, 3:], sigmas, rtol=1e-5, atol=1e-10)
    constant = -1.5 * np.log(2 * np.pi) * sum(len(f.matches) for f in frames)
    sums = np.array([p.log_weight_sum for p in S])
    np.testing.assert_allclose(state.log_weight_sum + constant, sums, rtol=0, atol=1e-7)
    assert rbpf.best_particle(state) == literal.best(S)


def test_single_precision_agrees_within_rounding():
    """Without resampling the particles stay comparable; only ties at the gate may differ."""
    steps = worlds.drive(4, steps=15, alike=0.3)
    settings = worlds.settings(particles=200, resample_below=0.0)
    double, exact = run_filter(steps, settings, 4, np.float64)
    single, rounded = run_filter(steps, settings, 4, np.float32)
    for a, b in zip(exact, rounded, strict=True):
        for f, g in zip(a.frames, b.frames, strict=True):
            same = f.matches == g.matches
            assert same.mean() > 0.999
            np.testing.assert_allclose(
                f.mahalanobis_sq[same], g.mahalanobis_sq[same], rtol=1e-2, atol=1e-2
            )
    np.testing.assert_array_equal(double.poses, single.poses)
    close = np.isclose(double.log_weight_sum, single.log_weight_sum, rtol=0, atol=0.05)
    assert close.mean() > 0.98


def test_same_seed_same_bytes():
    steps = worlds.drive(5, steps=10)
    settings = worlds.settings(particles=50)
    a, _ = run_filter(steps, settings, 5)
    b, _ = run_filter(steps, settings, 5)
    assert a.poses.tobytes() == b.poses.tobytes()
    for m in (0, 49):
        assert a.landmarks.of_particle(m)[1].tobytes() == b.landmarks.of_particle(m)[1].tobytes()


@pytest.mark.parametrize("proposal", ["motion", "informed"])
def test_threads_do_not_change_a_byte(proposal):
    steps = worlds.drive(8, steps=8, alike=0.3)
    one, two, three = (
        run_filter(steps, worlds.settings(600, proposal=proposal, threads=n), 8)[0]
        for n in (1, 2, 3)
    )
    for other in (two, three):
        assert one.poses.tobytes() == other.poses.tobytes()
        assert one.log_weight_sum.tobytes() == other.log_weight_sum.tobytes()
        for m in (0, 299, 599):
            mine, theirs = one.landmarks.of_particle(m), other.landmarks.of_particle(m)
            assert mine[1].tobytes() == theirs[1].tobytes()


@pytest.mark.parametrize("proposal", ["motion", "informed"])
def test_exclusive_observations_never_share_a_landmark(proposal):
    steps = worlds.drive(9, steps=12, robots=2, seen=12, alike=0.6)
    free, exclusive = (
        run_filter(steps, worlds.settings(300, proposal=proposal, exclusive=e), 9)[1]
        for e in (False, True)
    )

    def shared(infos):
        matches = [np.sort(f.matches, axis=0) for info in infos for f in info.frames]
        return sum((np.diff(m, axis=0) == 0).sum() for m in matches)

    assert shared(free) > 0
    assert shared(exclusive) == 0


def test_no_observations_leaves_the_motion_model_alone():
    steps = worlds.drive(6, steps=5, seen=0)
    state, infos = run_filter(steps, worlds.settings(particles=30), 6)
    assert len(state.landmarks.alive()) == 0
    assert all(info.effective_particles == pytest.approx(30) for info in infos)


def test_history_is_the_lineage_of_each_particle():
    """The tree of records gives back what an eager copy at every resampling would hold."""
    steps = worlds.drive(7, steps=80, robots=1)
    settings = worlds.settings(particles=20)
    rng = np.random.default_rng(7)
    state = rbpf.init(worlds.START[:1], settings)
    paths = np.empty((0, 3, 20))
    matches = np.empty((0, 5, 20), int)
    for frames in steps:
        before = state.poses[0]
        info = rbpf.step(state, frames, settings, rng)
        paths = np.concatenate([paths, before[None]])
        matches = np.concatenate([matches, info.frames[0].matches[None]])
        if info.ancestors is not None:
            paths, matches = paths[:, :, info.ancestors], matches[:, :, info.ancestors]
    for m in range(20):
        lineage = list(state.history.lineage(m))[::-1]
        np.testing.assert_array_equal([r.poses[:, row] for r, row in lineage], paths[:, :, m])
        np.testing.assert_array_equal([r.matches[:, row] for r, row in lineage], matches[:, :, m])
    assert len(state.history.records[0].parents) < 20


def test_moments_are_those_of_the_weighted_particles_before_resampling():
    steps = worlds.drive(11, steps=3)
    before, _ = run_filter(steps[:2], worlds.settings(resample_below=0.0), 11)
    infos = []
    for threshold in (0.0, 1.0):
        state, rng = copy.deepcopy(before), np.random.default_rng(12)
        settings = worlds.settings(resample_below=threshold)
        infos.append(rbpf.step(state, steps[2], settings, rng))
        if threshold == 0:
            weights = resampling.normalise(state.log_weights)
            expected = [(p @ weights, np.cov(p, aweights=weights, ddof=0)) for p in state.poses]
    assert infos[1].ancestors is not None
    for info in infos:
        for found, (mean, covariance) in zip(info.moments, expected, strict=True):
            np.testing.assert_allclose(found[0], mean)
            np.testing.assert_allclose(found[1], covariance, atol=1e-12)


@pytest.mark.parametrize("proposal", ["motion", "informed"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e308])
def test_a_step_that_leads_to_no_numbers_is_not_done(proposal, bad):
    settings = worlds.settings(particles=10, proposal=proposal)
    steps = worlds.drive(3, steps=6)
    state, _ = run_filter(steps[:5], settings, seed=0)
    before = copy.deepcopy(state)
    frames = list(steps[5])
    frames[1] = replace(frames[1], motion=np.array([bad, 0.0, 0.0]))
    with np.errstate(all="ignore"), pytest.raises(rbpf.NotFiniteError):
        rbpf.step(state, frames, settings, np.random.default_rng(1))
    np.testing.assert_array_equal(state.poses, before.poses)
    np.testing.assert_array_equal(state.log_weights, before.log_weights)
    assert len(state.history.records) == len(before.history.records)
    assert state.landmarks.alive().tolist() == before.landmarks.alive().tolist()
    again = [rbpf.step(s, steps[5], settings, np.random.default_rng(2)) for s in (state, before)]
    np.testing.assert_array_equal(state.poses, before.poses)
    np.testing.assert_array_equal(*(info.frames[0].mahalanobis_sq for info in again))


@pytest.mark.parametrize("proposal", ["motion", "informed"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, 3e20, 0.0, -1.0])
def test_a_bad_frame_leaves_no_trace_of_the_good_one_beside_it(proposal, bad):
    settings = worlds.settings(particles=10, proposal=proposal)
    steps = worlds.drive(3, steps=6)
    state, _ = run_filter(steps[:5], settings, seed=0)
    before = copy.deepcopy(state)
    frames = list(steps[5])
    frames[2] = replace(frames[2], covariances=frames[2].covariances * bad)
    with pytest.raises(rbpf.NotFiniteError, match="robot 2"):
        rbpf.step(state, frames, settings, np.random.default_rng(1))
    alive = before.landmarks.alive()
    assert state.landmarks.alive().tolist() == alive.tolist()
    np.testing.assert_array_equal(state.poses, before.poses)
    np.testing.assert_array_equal(state.landmarks.planes[alive], before.landmarks.planes[alive])
    np.testing.assert_array_equal(state.landmarks.boxes[alive], before.landmarks.boxes[alive])
    assert len(state.history.records) == len(before.history.records)


def test_a_flat_covariance_weighs_what_it_weighs_in_double():
    """A point 300 m off: 30 m uncertain in range, 1 cm across. Its |R| is lost in single."""
    noise, turn = np.diag([900.0, 1e-4, 1e-4]), 0.6
    c, s = np.cos(turn), np.sin(turn)
    R = stereo_turn(c, s) @ noise @ stereo_turn(c, s).T
    settings = worlds.settings(particles=4, proposal="motion")
    states = [rbpf.init(worlds.START[:1], settings, dtype) for dtype in (np.float32, np.float64)]
    v = np.array([[300 * c, 300 * s, 1.0]])
    frame = RobotFrame(0, 0, np.zeros(3), v, pack(R[None]), np.eye(1, 128, dtype=np.float32))
    for state in states:
        rbpf.step(state, [frame], settings, np.random.default_rng(0))
    single, double = (state.log_weight_sum for state in states)
    # R itself is rounded to single: by 2^-24 of its largest variance, 5 % of its |R|.
    np.testing.assert_allclose(single, double, atol=0.1)


def stereo_turn(c, s):
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def test_warm_up_compiles_all_that_coarse_and_fine_frames_use():
    used = [kernels.associate_and_update, informed_kernels.associate_and_believe]
    used += [informed_kernels.update_matched, informed_kernels.needs_double, kernels.are_usable]
    settings = worlds.settings(particles=4, proposal="informed")
    rbpf.warm_up(settings)
    before = [len(kernel.signatures) for kernel in used]
    state = rbpf.init(worlds.START, settings)
    for frames in worlds.drive(0, steps=3):
        for scale in (1.0, 1e-8):
            own = [replace(f, covariances=f.covariances * scale) for f in frames]
            rbpf.step(state, own, settings, np.random.default_rng(0))
    assert [len(kernel.signatures) for kernel in used] == before


@pytest.mark.parametrize("ancestors_below", [0.0, 0.5])
@pytest.mark.parametrize("proposal", ["motion", "informed"])
def test_boxes_leave_out_no_landmark_that_a_particle_can_reach(
    monkeypatch, proposal, ancestors_below
):
    """Whole runs with the boxes around landmarks, and with every landmark tried, are the same."""
    settings = worlds.settings(
        particles=30,
        proposal=proposal,
        resample_below=0.5,
        rejuvenation=RejuvenationSettings(ancestors_below=ancestors_below, delay_s=0),
    )
    for seed in range(6):
        steps = worlds.drive(seed, steps=15, alike=0.5)
        with_boxes, infos = run_filter(steps, settings, seed)
        with monkeypatch.context() as patch:
            patch.setattr(Landmarks, "near", lambda self, box: self.alive())
            without, expected = run_filter(steps, settings, seed)
        if ancestors_below:
            assert any(info.rejuvenated for info in infos)
        for info, other in zip(infos, expected, strict=True):
            for frame, its in zip(info.frames, other.frames, strict=True):
                np.testing.assert_array_equal(frame.matches, its.matches)
        np.testing.assert_array_equal(with_boxes.poses, without.poses)
