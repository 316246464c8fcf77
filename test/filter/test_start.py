"""Robots start where they are believed to: certain starts change nothing, others are drawn."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import worlds

from multi_robot_slam.filter import rbpf
from multi_robot_slam.filter.proposals import NotFiniteError
from multi_robot_slam.filter.running import ParticleFilter
from multi_robot_slam.filter.settings import RejuvenationSettings
from multi_robot_slam.models.frames import Start
from multi_robot_slam.smoothing.prior import SMALLEST_SIGMA, Prior

SOMEWHERE = Start(
    np.array([1.0, 2.0, 0.3]),
    np.array([[0.09, 0.02, 0.01], [0.02, 0.04, -0.005], [0.01, -0.005, 0.02]]),
)
SECOND = 10**9


def started(steps, starts):
    """The steps; each robot's first frame has its start."""
    first = [replace(frame, start=start) for frame, start in zip(steps[0], starts, strict=True)]
    return [first, *steps[1:]]


def content(state):
    found = [state.poses, state.log_weights, state.log_weight_sum, *state.prior]
    for m in range(state.poses.shape[2]):
        found += state.landmarks.of_particle(m)
    return b"".join(np.ascontiguousarray(part).tobytes() for part in found)


@pytest.mark.parametrize("proposal", ["motion", "informed"])
def test_certain_starts_change_no_byte(proposal):
    """Whatever the state said before of the robots' poses."""
    rest = RejuvenationSettings(ancestors_below=0.5, delay_s=1.0)
    settings = worlds.settings(
        particles=40, proposal=proposal, resample_below=0.5, rejuvenation=rest
    )
    steps = [
        [replace(frame, stamp_ns=t * SECOND) for frame in frames]
        for t, frames in enumerate(worlds.drive(3, steps=20))
    ]
    plain = ParticleFilter(worlds.START, settings, np.random.default_rng(1))
    told = ParticleFilter(worlds.START + 7, settings, np.random.default_rng(1))
    starts = [Start(pose, np.zeros((3, 3))) for pose in worlds.START]
    done = 0
    for frames, others in zip(steps, started(steps, starts), strict=True):
        done += plain.step(frames).rejuvenated is not None
        told.step(others)
        assert content(plain.state) == content(told.state)
    assert done > 1


@pytest.mark.parametrize("proposal", ["motion", "informed"])
def test_a_robot_that_sees_nothing_it_knows_is_where_it_is_believed(proposal):
    settings = worlds.settings(particles=20_000, proposal=proposal)
    state = rbpf.init(np.zeros((1, 3)), settings)
    frames = worlds.drive(0, steps=1, robots=1)[0]
    step = [replace(frames[0], start=SOMEWHERE)]
    info = rbpf.step(state, step, settings, np.random.default_rng(0))
    mean, covariance = info.moments[0]
    np.testing.assert_allclose(mean, SOMEWHERE.mean, atol=0.01)
    np.testing.assert_allclose(covariance, SOMEWHERE.covariance, atol=0.002)
    np.testing.assert_array_equal(state.prior.poses[0], SOMEWHERE.mean)
    expected = SOMEWHERE.covariance + SMALLEST_SIGMA**2 * np.eye(3)
    np.testing.assert_array_equal(state.prior.covariance, expected)


def test_a_start_that_fails_leaves_the_state_as_it_was():
    settings = worlds.settings(particles=10)
    state = rbpf.init(worlds.START, settings)
    before = deepcopy(state)
    frames = worlds.drive(0, steps=1)[0]
    bad = replace(frames[1], positions=np.full_like(frames[1].positions, np.nan), start=SOMEWHERE)
    with pytest.raises(NotFiniteError):
        rbpf.step(state, [frames[0], bad], settings, np.random.default_rng(0))
    assert content(state) == content(before)


@pytest.mark.parametrize("delay_s", [0.0, 3.0])
def test_a_robot_that_comes_later_starts_where_it_is_believed(delay_s):
    """Also where the step in which it comes is repeated after a rejuvenation."""
    rest = RejuvenationSettings(ancestors_below=1.0, delay_s=delay_s)
    settings = worlds.settings(
        particles=300, proposal="informed", resample_below=0.5, rejuvenation=rest
    )
    first = Start(worlds.START[0], np.zeros((3, 3)))
    late = Start(worlds.START[1], np.diag([0.04, 0.04, 0.01]))
    particles = ParticleFilter(worlds.START[:2], settings, np.random.default_rng(0))
    steps = worlds.drive(0, steps=16, robots=2)
    blind = [frame for frames in steps for frame in frames if frame.robot == 1]
    rejuvenated = 0
    for t, frames in enumerate(steps):
        own = [replace(frames[0], stamp_ns=t * SECOND, start=first if t == 0 else None)]
        if t >= 8:
            nothing = slice(0, 0)
            own.append(
                replace(
                    blind[t],
                    stamp_ns=t * SECOND,
                    motion=np.zeros(3) if t == 8 else blind[t].motion,
                    positions=blind[t].positions[nothing],
                    covariances=blind[t].covariances[nothing],
                    descriptors=blind[t].descriptors[nothing],
                    ranging=None,
                    start=late if t == 8 else None,
                )
            )
        rejuvenated += particles.step(own).rejuvenated is not None
        if t == 8:
            there = particles.state.poses[1]
            error = there.mean(axis=1) - late.mean
            assert (np.abs(error) < 5 * np.sqrt(np.diag(late.covariance) / 300)).all()
            np.testing.assert_allclose(np.cov(there), late.covariance, atol=0.015)
    assert rejuvenated > 2
    spread = np.cov(particles.state.poses[1])
    assert np.trace(spread) > 0.7 * np.trace(late.covariance)
    path = [record for record in particles.state.history.records if record.robot == 1]
    np.testing.assert_allclose(np.cov(path[0].poses), late.covariance, atol=0.02)


def test_a_start_has_nothing_to_do_with_what_was_known_before():
    prior = Prior.exact(worlds.START)
    root = np.random.default_rng(0).normal(size=(9, 9))
    prior = prior._replace(covariance=root @ root.T)
    found = prior.starting(1, SOMEWHERE)
    np.testing.assert_array_equal(found.poses[[0, 2]], prior.poses[[0, 2]])
    others = [0, 1, 2, 6, 7, 8]
    np.testing.assert_array_equal(
        found.covariance[np.ix_(others, others)], prior.covariance[np.ix_(others, others)]
    )
    assert not found.covariance[np.ix_([3, 4, 5], others)].any()
    assert not found.covariance[np.ix_(others, [3, 4, 5])].any()
    found.active(np.arange(3), np.empty(0, int))
    assert prior.covariance[3, 0] != 0
