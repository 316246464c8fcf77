"""A map without robots: closed, opened for others, and not changed by those who only look."""

from dataclasses import fields, replace

import numpy as np
import pytest
import worlds

from multi_robot_slam.filter import rbpf
from multi_robot_slam.filter.kept import KeptMap, independent, opened
from multi_robot_slam.filter.running import ParticleFilter
from multi_robot_slam.filter.settings import ExistenceSettings, RejuvenationSettings
from multi_robot_slam.models.frames import Start
from multi_robot_slam.models.symmetric import unpack

SECOND = 10**9
ALL = [field.name for field in fields(KeptMap)]


def settings(**changes):
    rest = RejuvenationSettings(ancestors_below=0.5, delay_s=0.0, unknowns=150)
    changes = {"particles": 60, "resample_below": 0.5, "rejuvenation": rest} | changes
    changes = {"existence": ExistenceSettings()} | changes
    return worlds.settings(proposal="informed", **changes)


def drive(steps=25, robots=3, seed=3, start=None):
    """Steps one second apart; with `start`, the robots' first frames say how uncertain they are."""
    result = []
    for t, frames in enumerate(worlds.drive(seed, steps, robots)):
        own = [replace(frame, stamp_ns=t * SECOND) for frame in frames]
        if t == 0 and start is not None:
            sigma = np.diag(np.square(start))
            own = [replace(f, start=Start(worlds.START[f.robot], sigma)) for f in own]
        result.append(own)
    return result


def filtered(own, steps, kept=None, seed=1):
    particles = ParticleFilter(worlds.START, own, np.random.default_rng(seed), kept=kept)
    for frames in steps:
        particles.step(frames)
    return particles


@pytest.fixture(scope="module")
def first_day():
    return filtered(settings(), drive(40))


def content(kept):
    return {name: getattr(kept, name).tobytes() for name in ALL}


def test_closing_changes_nothing_and_has_what_the_particles_know(first_day):
    before = first_day.state.poses.tobytes(), repr(first_day._rng.bit_generator.state)
    kept, again = first_day.closing()(), first_day.closing()()
    assert content(kept) == content(again)
    assert (first_day.state.poses.tobytes(), repr(first_day._rng.bit_generator.state)) == before
    state = first_day.state
    assert state.history.settled.seen.ids.size  # some frames had settled before
    columns, _ = state.landmarks.of_particle(rbpf.best_particle(state))
    ids = state.landmarks.ids[columns]
    means = state.landmarks.mixture(columns, np.full(60, 1 / 60))
    common, own, others = np.intersect1d(kept.ids, ids, return_indices=True)
    assert len(common) > 0.9 * len(ids)
    apart = kept.positions[own] - means[others, :3]
    assert np.abs(apart).max() < 3 * np.sqrt(kept.covariances[own][:, [0, 3, 5]].max())
    ratio = kept.covariances[own][:, [0, 3, 5]] / means[others][:, [3, 6, 8]]
    assert 0.3 < np.median(ratio) < 3


def test_the_covariance_of_each_alone_is_that_of_all_together(first_day):
    kept = first_day.closing()()
    given = np.linalg.inv(unpack(kept.information))
    for row, alone in enumerate(unpack(kept.covariances)):
        together = kept.joint[2 * row : 2 * row + 2, 2 * row : 2 * row + 2]
        np.testing.assert_allclose(alone[:2, :2], given[row][:2, :2] + together, rtol=1e-9)
        np.testing.assert_allclose(alone[2], given[row][2], rtol=1e-9)
    correlated = kept.joint[::2, ::2] - np.diag(np.diag(kept.joint[::2, ::2]))
    assert (correlated > 0).mean() > 0.5  # they were seen along the same paths


def test_opened_and_closed_without_a_frame_it_is_the_same_map(first_day):
    kept = first_day.closing()()
    assert content(filtered(settings(), [], kept).closing()()) == content(kept)


def test_all_particles_hold_the_map_and_the_robots_start_anywhere(first_day):
    kept = first_day.closing()()
    state = rbpf.init(worlds.START[:2] + 1, settings())
    opened(state, kept, settings())
    assert (state.poses == (worlds.START[:2] + 1)[:, :, None]).all()
    for particle in (0, 59):
        columns, values = state.landmarks.of_particle(particle)
        assert (state.landmarks.ids[columns] == kept.ids).all()
        both = np.append(kept.positions, kept.covariances, axis=1).astype(np.float32)
        assert (values == both).all()
        assert (state.landmarks.descriptors[columns] == kept.descriptors).all()
    assert (state.prior.covariance[6:, 6:] == kept.joint).all()
    assert not state.prior.covariance[:6, 6:].any()
    assert state.landmarks.next_id == kept.next_id


def positions_of(particles, robot):
    weights = np.exp(particles.state.log_weights)
    return particles.state.poses[robot] @ (weights / weights.sum())


def test_the_next_day_robots_are_found_in_the_map_though_their_starts_are_vague(first_day):
    kept = first_day.closing()()
    steps = drive(12, seed=3, start=(0.3, 0.3, 0.1))
    known, new = filtered(settings(), steps, kept), filtered(settings(), steps)
    truth = filtered(settings(particles=200), drive(12, seed=3))
    for robot in range(3):
        exact = positions_of(truth, robot)
        apart = np.hypot(*(positions_of(known, robot) - exact)[:2])
        apart_without = np.hypot(*(positions_of(new, robot) - exact)[:2])
        assert apart < 0.1
        assert apart < apart_without or apart_without < 0.05
    again = known.closing()()
    assert np.isin(kept.ids[kept.observations > 5], again.ids).all()
    assert again.observations.sum() == kept.observations.sum() + 12 * 3 * 5


def test_what_is_known_of_the_map_grows_from_day_to_day(first_day):
    kept = first_day.closing()()
    again = filtered(settings(), drive(40, seed=3, start=(0.05, 0.05, 0.02)), kept).closing()()
    common, before, after = np.intersect1d(kept.ids, again.ids, return_indices=True)
    assert len(common) > 30
    variance = kept.covariances[before][:, [0, 3]].sum(axis=1)
    assert (again.covariances[after][:, [0, 3]].sum(axis=1) < variance).mean() > 0.9


@pytest.mark.parametrize("proposal", ["informed", "motion"])
def test_who_only_looks_changes_nothing(first_day, proposal):
    kept = first_day.closing()()
    own = replace(settings(mapping=False), proposal=proposal)
    particles = ParticleFilter(worlds.START, own, np.random.default_rng(2), kept=kept)
    landmarks = particles.state.landmarks

    def held():
        alive = landmarks.alive()
        planes = landmarks.planes_of(alive, np.arange(60))
        parts = landmarks.ids[alive], planes, landmarks.descriptors[alive], landmarks.boxes[alive]
        return [part.tobytes() for part in parts]

    before = held()
    noted = 0
    for frames in drive(25, seed=3, start=(0.02, 0.02, 0.01)):
        info = particles.step(frames)
        noted += sum(np.isin(one.matches[:, 0], kept.ids).sum() for one in info.frames)
        assert info.rejuvenated is None
        assert held() == before
    assert noted > 0.7 * 25 * 3 * 5  # they were found again all the same
    assert particles.state.landmarks is landmarks


def test_a_filter_that_is_never_rejuvenated_keeps_what_its_best_particle_has():
    never = RejuvenationSettings(ancestors_below=0.0)
    particles = filtered(settings(rejuvenation=never), drive(20))
    state = particles.state
    kept = particles.closing()()
    columns, values = state.landmarks.of_particle(rbpf.best_particle(state))
    assert (kept.ids == state.landmarks.ids[columns]).all()
    np.testing.assert_allclose(kept.positions, values[:, :3])
    np.testing.assert_allclose(kept.covariances, values[:, 3:], rtol=1e-5, atol=1e-9)
    assert kept.observations.sum() == 20 * 3 * 5
    few = replace(never, landmarks=10)
    assert len(independent(state, settings(rejuvenation=few)).ids) == 10


def test_nobody_has_seen_anything():
    for never in (0.0, 0.5):
        own = settings(rejuvenation=RejuvenationSettings(ancestors_below=never))
        kept = filtered(own, []).closing()()
        assert len(kept.ids) == 0
        assert filtered(own, drive(3), kept).state.steps == 3
