"""Landmarks that are one are found, whatever they were called."""

from dataclasses import replace

import numpy as np
import pytest
import worlds
from drives import GATE, filtered, remembered
from scipy.stats import chi2

from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.smoothing import joining, solve
from multi_robot_slam.smoothing.prior import Prior
from multi_robot_slam.smoothing.problem import problem_of

SPLIT = 1000
"""Ids that a landmark goes by later are its own plus multiples of this."""


@pytest.fixture(scope="module")
def split():
    """Records, path and identities: each third of a drive has names of its own for landmarks."""
    state, _ = filtered(steps=30, proposal="informed", gate=1e3)
    records, identities, poses = remembered(state)
    third = len(records) // 3 + 1
    return records, poses, [ids + SPLIT * (p // third) for p, ids in enumerate(identities)]


def joined(split, alike, exclusive=False, gate=GATE):
    records, poses, identities = split
    calls = []

    def smoothed_with(aliases, poses):
        calls.append(len(aliases))
        named = [aliases.of(ids) for ids in identities]
        problem = problem_of(records, named, Prior.exact(worlds.START), worlds.settings().motion)
        return problem, solve.smooth(problem, poses)

    return *joining.smooth_and_join(smoothed_with, poses, alike, gate, exclusive), calls


def pairs_of(identities):
    """All pairs of ids of one landmark, newer ones first now and then."""
    ids = np.unique(np.concatenate(identities))
    pairs = [[a, b] for a in ids for b in ids if a != b and (a - b) % SPLIT == 0]
    return np.array(pairs)


def test_every_landmark_goes_by_its_oldest_id(split):
    pairs = pairs_of(split[2])
    problem, _, aliases, calls = joined(split, pairs)
    _, whole = np.unique(problem.ids % SPLIT, return_index=True)
    assert problem.ids.tolist() == problem.ids[np.sort(whole)].tolist()
    assert (aliases.of(pairs) == aliases.of(pairs)[:, ::-1]).all()
    oldest = [pairs[(pairs % SPLIT == n % SPLIT)].min() for n in problem.ids if n in pairs]
    assert [n for n in problem.ids if n in pairs] == oldest
    assert len(problem.positions) == sum(map(len, split[2]))
    # Three names need two joins of each.
    assert len(calls) == 3
    assert calls == sorted(set(calls))


def test_only_what_looks_alike_is_joined(split):
    problem, _, aliases, calls = joined(split, np.empty((0, 2), int))
    assert len(aliases) == 0
    assert calls == [0]
    assert len(problem.ids) == len(np.unique(np.concatenate(split[2])))


def test_only_what_lies_together_is_joined(split):
    names = np.unique(np.concatenate(split[2]))
    others = np.array([[a, b] for a in names for b in names if a < b and (a - b) % SPLIT])
    assert len(joined(split, others)[2]) == 0


def test_what_one_frame_saw_stays_apart(split):
    names = np.unique(np.concatenate(split[2]))
    everything = np.array([[a, b] for a in names for b in names if a < b])
    assert len(joined(split, everything, exclusive=False, gate=1e9)[0].ids) == 1
    problem = joined(split, everything, exclusive=True, gate=1e9)[0]
    for p in range(problem.poses):
        seen = problem.landmarks[problem.seen_from == p]
        assert len(np.unique(seen)) == len(seen)


def test_widened_gate_lets_a_run_pass_as_one_observation_does():
    for count in (1, 100, 7000):
        together = chi2.cdf(joining.widened_gate(11.345, count), 3) ** count
        assert together == pytest.approx(0.99, abs=1e-4)


@pytest.mark.parametrize("exclusive", [False, True])
def test_looking_at_likely_pairs_alone_finds_the_same(split, exclusive, monkeypatch):
    records, poses, identities = split
    problem = problem_of(records, identities, Prior.exact(worlds.START), worlds.settings().motion)
    smoothed = solve.smooth(problem, poses)
    names = np.arange(len(problem.ids))
    pairs = np.array([[a, b] for a in names for b in names if a < b])
    looked_at = []
    real = joining._mahalanobis_sq

    def noted(problem, smoothed, pairs, correlated):
        looked_at.append(len(pairs))
        return real(problem, smoothed, pairs, correlated)

    monkeypatch.setattr(joining, "_mahalanobis_sq", noted)
    found = joining.closest_pairs(problem, smoothed, pairs, GATE, exclusive)
    few, looked_at[:] = sum(looked_at), []
    monkeypatch.setattr(
        joining, "_may_be_within", lambda p, s, pairs, limit: np.ones(len(pairs), bool)
    )
    expected = joining.closest_pairs(problem, smoothed, pairs, GATE, exclusive)
    assert found.tolist() == expected.tolist()
    assert len(found) > 5
    assert few < 0.7 * sum(looked_at)


def test_what_covariances_have_beyond_independent_errors_does_not_join(split):
    """D of a pair is that of landmarks whose own covariances are so many times smaller."""
    records, poses, identities = split
    problem = problem_of(records, identities, Prior.exact(worlds.START), worlds.settings().motion)
    smoothed = solve.smooth(problem, poses)
    smaller = replace(smoothed, landmarks=smoothed.landmarks.copy())
    smaller.landmarks[:, 3:] /= 3
    pairs = np.array([[0, 1], [2, 7], [3, 12]])
    found = joining._mahalanobis_sq(problem, smoothed, pairs, 3.0)
    shared = joining.landmark_deviations(problem, smoothed, np.arange(len(problem.ids)))
    for row, (a, b) in enumerate(pairs):
        apart = smaller.landmarks[a, :3] - smaller.landmarks[b, :3]
        both = unpack(smaller.landmarks[[a, b], 3:]).sum(axis=0)
        both = both + (shared[a] - shared[b]) @ (shared[a] - shared[b]).T
        assert found[row] == pytest.approx(apart @ np.linalg.solve(both, apart), rel=1e-6)
