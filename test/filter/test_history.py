"""Histories: a tree that coalesces, and pasts that are rewritten."""

from dataclasses import replace

import numpy as np
import pytest

from multi_robot_slam.filter import history
from multi_robot_slam.filter.history import History, Past, signature_of
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.smoothing.aliases import Aliases

FRAME = RobotFrame(
    0, 0, np.zeros(3), np.zeros((2, 3)), np.zeros((2, 6)), np.zeros((2, 128), np.float32)
)


def grown(steps, particles=6, seed=0):
    """A history, and what a list of whole pasts for each particle would be."""
    rng = np.random.default_rng(seed)
    grown, pasts = History(particles), [[] for _ in range(particles)]
    for step in range(steps):
        poses = rng.normal(size=(3, particles))
        matches = rng.integers(0, 20, (2, particles)).astype(np.int32)
        grown.append(replace(FRAME, stamp_ns=step), step, poses, matches, np.zeros(2, np.int32))
        for m, past in enumerate(pasts):
            past.append((poses[:, m].tolist(), matches[:, m].tolist()))
        ancestors = np.sort(rng.integers(0, particles, particles)).astype(np.int32)
        grown.resample(ancestors)
        pasts = [list(pasts[a]) for a in ancestors]
    return grown, pasts


def remembered(grown, particle):
    lineage = list(grown.lineage(particle))[::-1]
    return [(r.poses[:, row].tolist(), r.matches[:, row].tolist()) for r, row in lineage]


def past_of(members, poses, identities, aliases=Aliases()):  # noqa: B008
    identities = [np.array(own, np.int32) for own in identities]
    return Past(np.array(members), poses, identities, aliases, signature_of(identities))


def aliases(**pairs):
    return Aliases().joined(np.array([[new, int(old[1:])] for old, new in pairs.items()]))


@pytest.mark.parametrize("steps", [1, 31, 33, 100])
def test_every_particle_has_its_past(steps):
    found, pasts = grown(steps)
    for m, past in enumerate(pasts):
        assert remembered(found, m) == past


def test_rows_without_descendants_are_dropped():
    found, _ = grown(200)
    # Six particles have one ancestor some ten steps ago.
    assert sum(len(record.parents) for record in found.records) < 200 + 6 * history.PRUNE_EVERY * 2


def test_new_pasts_replace_the_last_records_of_their_members():
    found, pasts = grown(40)
    path = np.random.default_rng(1).normal(size=(3, 3, 2))
    before = found.signatures.copy()
    past = past_of([1, 4], path, [[1, 2], [3, 4], [5, 6]])
    found.rewrite([past])
    for m, kept in enumerate(pasts):
        if m in (1, 4):
            own = [1, 4].index(m)
            kept[-3:] = [(path[p, :, own].tolist(), past.identities[p].tolist()) for p in range(3)]
        assert remembered(found, m) == kept
        assert (found.signatures[m] == before[m]) == (m not in (1, 4))
    assert found.signatures[1] == found.signatures[4]


def test_older_records_go_by_the_aliases_of_each_past():
    """Particles that share old rows, with aliases of their own, with others and with none."""
    found, pasts = grown(40)
    path, own = np.zeros((2, 3, 2)), [[1, 2], [3, 4]]
    first, second = aliases(_7=3, _9=1), aliases(_7=5)
    found.rewrite([past_of([0, 1], path, own, first), past_of([3, 5], path, own, second)])
    for m, kept in enumerate(pasts):
        names = {0: {7: 3, 9: 1}, 1: {7: 3, 9: 1}, 3: {7: 5}, 5: {7: 5}}.get(m, {})
        expected = [(pose, [names.get(n, n) for n in ids]) for pose, ids in kept]
        if names:
            expected[-2:] = [([0, 0, 0], ids) for ids in own]
        assert remembered(found, m) == expected
    # One row of the oldest record for each set of aliases.
    assert len(found.records[0].parents) == 3


def test_a_shorter_past_keeps_what_is_before_it_under_its_aliases():
    found, pasts = grown(10)
    long = past_of([0], np.zeros((6, 3, 1)), [[1, 2]] * 6)
    short = past_of([2], np.ones((1, 3, 1)), [[8, 8]], aliases(_4=0))
    found.rewrite([long, short])
    expected = [(pose, [0 if n == 4 else n for n in ids]) for pose, ids in pasts[2][:-1]]
    assert remembered(found, 2) == [*expected, ([1, 1, 1], [8, 8])]
    assert remembered(found, 0) == [*pasts[0][:4], *[([0, 0, 0], [1, 2])] * 6]


def test_the_tree_goes_on_after_a_new_past():
    found, _ = grown(40)
    found.rewrite([past_of(range(6), np.zeros((5, 3, 6)), [[1, 2]] * 5, aliases(_3=2))])
    before = [remembered(found, m) for m in range(6)]
    ancestors = np.array([0, 0, 2, 2, 2, 5], np.int32)
    for _ in range(2 * history.PRUNE_EVERY):
        found.resample(ancestors)
        found.append(FRAME, 50, np.zeros((3, 6)), np.zeros((2, 6), np.int32), np.zeros(2, np.int32))
        before = [before[a] for a in ancestors]
    for m in range(6):
        assert remembered(found, m)[:40] == before[m]
