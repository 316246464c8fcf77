"""Landmarks that are not worth their cost: which ones, and what of them stays."""

from dataclasses import replace

import numpy as np
import pytest
import worlds
from drives import filtered, remembered

from multi_robot_slam.filter import forgetting, running
from multi_robot_slam.filter.forgetting import NOTHING, PATIENCE, forgotten, without_chance_finds
from multi_robot_slam.filter.running import ParticleFilter
from multi_robot_slam.filter.settings import LEAST_UNKNOWNS, RejuvenationSettings
from multi_robot_slam.smoothing import absorption, solve
from multi_robot_slam.smoothing.prior import Prior
from multi_robot_slam.smoothing.problem import problem_of


def scattered(count, seed=0):
    rng = np.random.default_rng(seed)
    ids = np.sort(rng.choice(10 * count, count, replace=False))
    return ids, rng.uniform(0, 10, (count, 3)), rng.integers(1, 9, count)


def test_what_was_hardly_seen_goes():
    ids, places, counts = scattered(50)
    gone = forgotten(ids, places, counts, RejuvenationSettings(least_seen=4))
    assert gone.tolist() == ids[counts < 4].tolist()
    assert len(forgotten(ids, places, counts, RejuvenationSettings())) == 0


@pytest.mark.parametrize("most", [1, 20, 49])
def test_of_too_many_the_best_of_each_place_stay(most):
    ids, places, counts = scattered(50)
    gone = np.isin(ids, forgotten(ids, places, counts, RejuvenationSettings(landmarks=most)))
    assert (~gone).sum() == most
    cells = [tuple(c) for c in (places[:, :2] // forgetting.NEIGHBOURHOOD_M).astype(int)]

    def rank(n):
        better = [
            m
            for m in range(50)
            if cells[m] == cells[n] and (counts[m], ids[m]) > (counts[n], ids[n])
        ]
        return len(better)

    assert max(rank(n) for n in np.flatnonzero(~gone)) <= min(rank(n) for n in np.flatnonzero(gone))


def test_the_places_of_two_pieces_have_nothing_to_do_with_each_other():
    ids, places = np.arange(4), np.ones((4, 3))
    counts, pieces = np.array([9, 8, 3, 2]), np.array([0, 0, 1, 1])
    settings = RejuvenationSettings(landmarks=2)
    assert forgotten(ids, places, counts, settings).tolist() == [2, 3]
    assert forgotten(ids, places, counts, settings, pieces).tolist() == [1, 3]


def test_chance_finds_are_old_and_were_seen_once():
    records = [replace_robot(robot) for _ in range(PATIENCE + 2) for robot in (0, 1)]
    identities = [np.array([p, 1000, 500]) for p in range(len(records))]
    identities[0][1], identities[1][2] = 77, 78
    found = without_chance_finds(records, identities, known=np.array([77]))
    for p, own in enumerate(found):
        is_old = p < 4
        assert own[0] == (NOTHING if is_old else p)
    assert found[0].tolist() == [NOTHING, 77, 500]
    assert found[1].tolist() == [NOTHING, 1000, NOTHING]


def replace_robot(robot):
    frame = worlds.drive(seed=0, steps=1, robots=1)[0][0]
    return replace(frame, robot=robot)


def test_one_observation_says_nothing_of_the_paths():
    state, settings = filtered(steps=PATIENCE + 10)
    records, identities, poses = remembered(state)
    identities = [ids.astype(np.int64) for ids in identities]
    rng = np.random.default_rng(0)
    for p, own in enumerate(identities):
        own[rng.integers(len(own))] = 10_000 + p
    fewer = without_chance_finds(records, identities, np.empty(0, int))
    assert sum((own == NOTHING).sum() for own in fewer) > 5
    known = Prior.exact(worlds.START)
    whole, less = (
        solve.smooth(problem_of(records, ids, known, settings.motion), poses, smallest_step=1e-6)
        for ids in (identities, fewer)
    )
    np.testing.assert_allclose(less.poses, whole.poses, atol=1e-8)


def test_what_forgotten_landmarks_said_of_the_rest_stays():
    """To absorb without some landmarks is to absorb all, and to marginalise those out."""
    state, settings = filtered(steps=18)
    records, identities, poses = remembered(state)
    known = Prior.exact(worlds.START)
    whole = problem_of(records, identities, known, settings.motion)
    smoothed = solve.smooth(whole, poses)
    lost = np.sort(np.random.default_rng(0).choice(whole.ids, len(whole.ids) // 2, replace=False))
    everything = absorption.absorb(whole, smoothed, 30, known)
    without = absorption.absorb(whole, smoothed, 30, known, lost)
    expected = everything.forget(lost)
    assert len(without.ids) < len(everything.ids)
    for name in Prior._fields:
        found = getattr(without, name)
        np.testing.assert_allclose(found, getattr(expected, name), rtol=1e-9, atol=1e-12)


def test_a_filter_that_forgets_goes_on_within_its_bound():
    bounded = RejuvenationSettings(
        ancestors_below=1.0, delay_s=0.0, unknowns=LEAST_UNKNOWNS, landmarks=15, least_seen=2
    )
    own = worlds.settings(proposal="informed", particles=60, rejuvenation=bounded, threads=1)
    particles = ParticleFilter(worlds.START, own, np.random.default_rng(1))
    running.warm_up(own)
    for frames in worlds.drive(seed=4, steps=60):
        info = particles.step(frames)
        assert not (info.rejuvenated and info.rejuvenated.failures)
        prior = particles.state.prior
        assert len(prior.ids) <= 15
        assert np.isin(prior.ids, particles.state.landmarks.ids).all()
    assert len(particles.state.history.settled) > 90
    assert len(prior.ids) > 5
    seen = particles.state.history.settled.seen.ids
    assert (
        np.isin(seen, particles.state.landmarks.ids[particles.state.landmarks.alive()]).mean() > 0.5
    )
