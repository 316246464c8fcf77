"""Robots that start anywhere in a map that was there before."""

from dataclasses import replace

import numpy as np
import pytest
import worlds

from multi_robot_slam.filter import tying
from multi_robot_slam.filter.pieces import MAP, Pieces
from multi_robot_slam.filter.running import ParticleFilter
from multi_robot_slam.filter.settings import ExistenceSettings, RejuvenationSettings
from multi_robot_slam.models.frames import Start
from multi_robot_slam.models.motion import move, wrap

SECOND = 10**9
ORIGIN = Start(np.zeros(3), np.zeros((3, 3)))
REST = RejuvenationSettings(ancestors_below=0.5, delay_s=0.0)


def settings(**changes):
    changes = {"particles": 100, "proposal": "informed", "rejuvenation": REST} | changes
    changes = {"existence": ExistenceSettings(), "exclusive": True} | changes
    return worlds.settings(resample_below=0.5, **changes)


def drive(steps, unknown=(), seed=3, robots=3, seen=8):
    """Steps one second apart; the `unknown` robots start at the origin of their own frame."""
    made = []
    for t, frames in enumerate(worlds.drive(seed, steps, robots, seen)):
        starts = [ORIGIN if t == 0 and frame.robot in unknown else None for frame in frames]
        made.append(
            [
                replace(frame, stamp_ns=t * SECOND, start=start)
                for frame, start in zip(frames, starts, strict=True)
            ]
        )
    return made


def begun(own, unknown=(), kept=None, robots=3, seed=1):
    are_known = np.isin(np.arange(robots), unknown, invert=True)
    starts = np.where(are_known[:, None], worlds.START[:robots], 0.0)
    rng = np.random.default_rng(seed)
    return ParticleFilter(starts, own, rng, are_known=are_known, kept=kept)


def closed(steps):
    particles = begun(settings())
    for frames in steps:
        particles.step(frames)
    return particles.closing()()


@pytest.fixture(scope="module")
def yesterday():
    return closed(drive(40))


@pytest.fixture(scope="module")
def elsewhere():
    """A map of other landmarks."""
    return closed(drive(40, seed=4))


def true_poses(steps):
    """(3, 3) of all robots at the end of `worlds.drive`."""
    poses = worlds.START.T.copy()
    for _ in range(1, steps):
        move(poses, np.tile([[0.2], [0.0], [0.15]], 3))
    return poses.T


def errors(particles, steps):
    weights = np.exp(particles.state.log_weights)
    found = particles.state.poses @ (weights / weights.sum()) - true_poses(steps)
    return np.hypot(found[:, 0], found[:, 1]), np.abs(wrap(found[:, 2]))


def of_map(particles):
    """The landmarks of the map as all particles hold them, in bytes."""
    landmarks = particles.state.landmarks
    own = landmarks.alive()
    own = own[landmarks.pieces[own] == MAP]
    planes = landmarks.planes_of(own, np.arange(len(particles.state.log_weights)))
    parts = landmarks.ids[own], planes, landmarks.descriptors[own], landmarks.boxes[own]
    return [part.tobytes() for part in parts]


@pytest.mark.parametrize("unknown", [(0, 1, 2), (0,), (1, 2)])
@pytest.mark.parametrize("mapping", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_robots_that_start_anywhere_are_found_where_they_are(yesterday, unknown, mapping, seed):
    particles = begun(settings(mapping=mapping), unknown, yesterday, seed=seed)
    ties = [info.tied for info in map(particles.step, drive(25, unknown)) if info.tied]
    assert len(ties) == len(unknown)
    assert ties[-1].is_in_map
    assert particles.state.pieces.robots_in_map.all()
    places, headings = errors(particles, 25)
    assert places.max() < 0.15
    assert headings.max() < 0.06


@pytest.mark.parametrize(("proposal", "particles"), [("motion", 400), ("informed", 100)])
def test_who_only_looks_maps_by_itself_until_it_is_found_and_nothing_after(
    yesterday, proposal, particles
):
    """What it mapped was there to vote; the map is unchanged from the first step to the last."""
    unknown = (0, 1, 2)
    own = settings(mapping=False, proposal=proposal, particles=particles)
    particles = begun(own, unknown, yesterday)
    before, own_landmarks = of_map(particles), []
    for frames in drive(25, unknown):
        info = particles.step(frames)
        assert info.rejuvenated is None
        assert of_map(particles) == before
        landmarks = particles.state.landmarks
        own_landmarks.append(len(landmarks.alive()) - len(yesterday.ids))
    assert max(own_landmarks) > 10
    assert own_landmarks[-1] == 0
    assert not particles.state.pieces.are_many
    assert not len(particles.state.pieces.pairs)


@pytest.mark.parametrize("mapping", [True, False])
def test_robots_in_another_place_stay_unknown(elsewhere, mapping):
    """They find each other, but not the map, which stays as it was."""
    unknown = (0, 1, 2)
    particles = begun(settings(mapping=mapping), unknown, elsewhere)
    ties = [info.tied for info in map(particles.step, drive(30, unknown)) if info.tied]
    assert not any(tie.is_in_map for tie in ties)
    assert len(ties) == 2
    assert not particles.state.pieces.robots_in_map.any()
    assert particles.state.pieces.are_many
    again = particles.closing()()
    for name in ("ids", "positions", "covariances", "joint"):
        np.testing.assert_allclose(getattr(again, name), getattr(elsewhere, name), rtol=1e-9)


def test_the_map_is_a_piece_though_no_robot_is_in_it():
    assert Pieces(np.array([2, 2]), np.arange(2)).numbers == [MAP, 2]
    assert Pieces(np.array([1, 0]), np.arange(2)).numbers == [MAP, 1]
    assert not Pieces(np.array([0, 0]), np.arange(2)).are_many


def test_with_all_starts_known_nobody_votes(yesterday, monkeypatch):
    def fail(*arguments):
        raise AssertionError

    monkeypatch.setattr(tying, "_voted", fail)
    particles = begun(settings(), (), yesterday)
    for frames in drive(5):
        particles.step(frames)
