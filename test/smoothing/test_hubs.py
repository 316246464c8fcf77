"""Which landmarks stay unknowns, and what that is worth."""

from dataclasses import replace

import numpy as np
import pytest
import worlds
from drives import filtered, posed, remembered, straight, with_hubs

from multi_robot_slam.smoothing import absorption, hubs, marginals, solve
from multi_robot_slam.smoothing.envelope import envelope_of
from multi_robot_slam.smoothing.prior import Prior
from multi_robot_slam.smoothing.problem import problem_of


def counted(envelope):
    """Multiplications of the factorisation, tile by tile, as its loops go."""
    edges, begins, total = envelope.edges, envelope.begins, 0
    for i in range(len(begins)):
        for k in range(len(begins)):
            inside = edges[k] - max(begins[i], begins[k])
            if k <= i and inside > 0:
                total += (edges[i + 1] - edges[i]) * (edges[k + 1] - edges[k]) * inside
    return total


@pytest.fixture(scope="module")
def drive():
    return posed(*filtered(steps=60))


def test_multiplications_are_counted(drive):
    problem, _ = drive
    for chosen in ([], [3], [0, 5, 20, 33]):
        envelope = envelope_of(problem, np.array(chosen, int))
        assert envelope.multiplications == counted(envelope)


def test_cheapest_choice_is_made(drive, monkeypatch):
    """Whatever is offered, and whatever it costs."""
    problem, _ = drive
    offered = [np.arange(count) for count in (0, 3, 12, 30)]
    monkeypatch.setattr(hubs, "_candidates", lambda problem: iter(offered))
    for cheapest in range(4):
        prices = {len(choice): 1.0 for choice in offered} | {len(offered[cheapest]): 0.5}
        monkeypatch.setattr(hubs, "_cost", lambda problem, e, prices=prices: prices[len(e.hubs)])
        found = hubs.cheapest_envelope(problem)
        np.testing.assert_array_equal(found.hubs, offered[cheapest])


def test_room_whose_landmarks_are_always_in_view_is_a_band():
    """Each landmark seen from every pose: all are hubs, and the poses a chain."""
    room = straight(poses=600, landmarks=5)
    found, dense = hubs.cheapest_envelope(room), envelope_of(room, np.empty(0, int))
    np.testing.assert_array_equal(found.hubs, np.arange(5))
    assert found.multiplications < 0.05 * dense.multiplications


def test_corridor_has_no_hubs():
    """Each landmark seen from two neighbours."""
    poses = 400
    corridor = replace(
        straight(poses=2, landmarks=poses - 1),
        robots=np.zeros(1 + poses, int),
        previous=np.arange(poses),
        seen_from=1 + np.stack([np.arange(poses - 1), np.arange(1, poses)], axis=1).ravel(),
    )
    assert len(hubs.cheapest_envelope(corridor).hubs) == 0


@pytest.mark.parametrize("share", [0.5, 1])
def test_hubs_may_have_centres(monkeypatch, share):
    state, settings = filtered(steps=8)
    records, identities, poses = remembered(state)
    known = Prior.exact(worlds.START)
    whole = problem_of(records, identities, known, settings.motion)
    known = absorption.absorb(whole, solve.smooth(whole, poses), 12, known)
    problem = problem_of(records[12:], identities[12:], known, settings.motion, also=known.ids)
    assert (np.diff(problem.starts) == 1).any()
    expected = solve.smooth(problem, poses[12:], smallest_step=1e-6)
    with_hubs(monkeypatch, share)
    found = solve.smooth(problem, poses[12:], smallest_step=1e-6)
    np.testing.assert_allclose(found.views, expected.views, atol=1e-8)
    deviations = [marginals.landmark_deviations(problem, s) for s in (found, expected)]
    shared = [Y @ Y.transpose(0, 2, 1) for Y in deviations]
    np.testing.assert_allclose(*shared, atol=1e-10)
