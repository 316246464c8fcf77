"""Factors of the odometry: one Newton step against finite differences, and recovered from runs."""

from dataclasses import replace

import numpy as np
import worlds

from multi_robot_slam.filter import rbpf
from multi_robot_slam.filter.running import ParticleFilter
from multi_robot_slam.filter.settings import RejuvenationSettings
from multi_robot_slam.smoothing import odometry_scale, solve
from multi_robot_slam.smoothing.odometry_scale import Scales
from multi_robot_slam.smoothing.prior import Prior
from multi_robot_slam.smoothing.problem import problem_of

NOISE = worlds.settings().motion
TRUE = np.array([0.9, 0.95])
"""What the robots really do of what their odometry tells: distances, turns."""


def told_too_much(steps):
    """The frames of `drive` with odometry that is too large by the inverse of TRUE."""
    return [[replace(f, motion=f.motion / TRUE[[0, 0, 1]]) for f in frames] for frames in steps]


def history(seed=0, steps=25):
    settings = worlds.settings(particles=5, proposal="informed", gate=1e3)
    state = rbpf.init(worlds.START, settings, np.float64)
    rng = np.random.default_rng(seed)
    for frames in told_too_much(worlds.drive(seed, steps)):
        rbpf.step(state, frames, settings, rng)
    lineage = list(state.history.lineage(0))[::-1]
    records = [record for record, _ in lineage]
    poses = np.array([record.poses[:, row] for record, row in lineage])
    return records, [record.matches[:, row] for record, row in lineage], poses


def smoothed_with(records, identities, poses, factors):
    problem = problem_of(records, identities, Prior.exact(worlds.START), NOISE, factors)
    return problem, solve.smooth(problem, poses, smallest_step=1e-8)


def test_the_step_is_newton_s_on_the_cost_with_the_paths_at_their_best():
    records, identities, poses = history()
    motions = np.array([record.motion for record in records])
    scales, h = Scales.unknown(3, 0.1), 1e-3
    problem, best = smoothed_with(records, identities, poses, scales.factors)
    gradient, curvature = odometry_scale._profile(problem, best, motions, 6)
    for k in range(6):
        cost = []
        for sign in (-1, 1):
            factors = np.ones(6)
            factors[k] += sign * h
            cost.append(smoothed_with(records, identities, poses, factors.reshape(3, 2))[1].cost)
        np.testing.assert_allclose(gradient[k], (cost[1] - cost[0]) / (2 * h), rtol=1e-3, atol=1e-2)
        second = (cost[1] + cost[0] - 2 * best.cost) / h**2
        np.testing.assert_allclose(curvature[k, k], second, rtol=0.05)
    learnt = odometry_scale.learn(scales, problem, best, motions, fixed=0.0)
    expected = np.linalg.solve(curvature + 100 * np.eye(6), gradient)
    np.testing.assert_allclose(learnt.factors.ravel(), 1 - expected)
    assert (learnt.information == scales.information).all()


def test_fixed_poses_leave_what_they_say():
    records, identities, poses = history()
    motions = np.array([record.motion for record in records])
    scales = Scales.unknown(3, 0.1)
    problem, best = smoothed_with(records, identities, poses, scales.factors)
    learnt = odometry_scale.learn(scales, problem, best, motions, fixed=1.0)
    _, curvature = odometry_scale._profile(problem, best, motions, 6)
    np.testing.assert_allclose(learnt.information, scales.information + curvature)
    np.testing.assert_allclose(learnt.mean, learnt.factors.ravel())


def test_where_the_curvature_is_negative_the_paths_say_nothing():
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    curvature = turn @ np.diag([-5.0, 3.0]) @ turn.T
    gradient, known = odometry_scale._of_what_is_known(turn @ [7.0, 2.0], curvature)
    np.testing.assert_allclose(turn.T @ gradient, [0, 2], atol=1e-12)
    np.testing.assert_allclose(turn.T @ known @ turn, np.diag([0, 3]), atol=1e-12)


def test_without_doubt_the_factors_stay_one():
    records, identities, poses = history(steps=5)
    problem, best = smoothed_with(records, identities, poses, np.ones((3, 2)))
    learnt = odometry_scale.learn(Scales.unknown(3, 0.0), problem, best, None, 0.5)
    assert (learnt.factors == 1).all()


def test_a_run_finds_the_factors():
    noise = replace(NOISE, scale_sigma=0.1)
    settings = worlds.settings(particles=50, proposal="informed", motion=noise, resample_below=0.5)
    settings = replace(
        settings, rejuvenation=RejuvenationSettings(ancestors_below=0.5, delay_s=0, unknowns=180)
    )
    found = []
    for seed in range(3):
        particles = ParticleFilter(worlds.START, settings, np.random.default_rng(seed))
        for frames in told_too_much(worlds.drive(seed, steps=60)):
            particles.step(frames)
        found.append(particles.state.scales.factors)
    np.testing.assert_allclose(np.mean(found, axis=(0, 1)), TRUE, atol=0.02)


def test_what_gaps_hide_counts_in_smoothing():
    """A record's extra widens its motion alone, and the filter's record has that of the frame."""
    settings = worlds.settings(particles=5, proposal="informed", gate=1e3)
    state = rbpf.init(worlds.START, settings, np.float64)
    extra = np.array([0.3, 0.2, 0.1])
    for step, frames in enumerate(worlds.drive(0, 4)):
        told = [replace(f, extra=extra) if (step, f.robot) == (2, 1) else f for f in frames]
        rbpf.step(state, told, settings, np.random.default_rng(0))
    records = [record for record, _ in list(state.history.lineage(0))[::-1]]
    identities = [record.matches[:, 0] for record in records]
    prior = Prior.exact(worlds.START)
    wide = problem_of(records, identities, prior, NOISE).sigmas
    without = [replace(record, extra=np.zeros(3)) for record in records]
    narrow = problem_of(without, identities, prior, NOISE).sigmas
    is_it = np.array([(record.step, record.robot) == (2, 1) for record in records])
    assert is_it.sum() == 1
    np.testing.assert_allclose(wide[is_it] ** 2, narrow[is_it] ** 2 + extra**2)
    np.testing.assert_array_equal(wide[~is_it], narrow[~is_it])
