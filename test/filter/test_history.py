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


@pytest.mark.parametrize("steps", [1, 31, 33, 100])
def test_every_particle_has_its_past(steps):
    found, pasts = grown(steps)
    for m, past in enumerate(pasts):
        assert remembered(found, m) == past


def test_rows_without_descendants_are_dropped():
    found, _ = grown(200)
    # Six particles have one ancestor some ten steps ago.
    assert sum(len(record.parents) for record in found.records) < 200 + 6 * history.PRUNE_EVERY * 2


def whole(members, seed, records, aliases=Aliases()):  # noqa: B008
    rng = np.random.default_rng(seed)
    identities = rng.integers(0, 20, (records, 2)).tolist()
    return past_of(members, rng.normal(size=(records, 3, len(members))), identities, aliases)


@pytest.mark.parametrize("members", [[1, 4], [0, 1, 2, 3, 4, 5]])
def test_new_pasts_replace_those_of_their_members(members):
    found, pasts = grown(40)
    past = whole(members, 1, 40)
    renewed = found.renewed([past], settle=0)
    for m, kept in enumerate(pasts):
        assert remembered(found, m) == kept
        if m in members:
            own = past.paths[:, :, members.index(m)]
            ids = [identities.tolist() for identities in past.identities]
            kept = list(zip(own.tolist(), ids, strict=True))
        assert remembered(renewed, m) == kept
        assert (renewed.signatures[m] == found.signatures[m]) == (m not in members)


def test_what_settles_is_the_optimum_of_the_first_past():
    found, pasts = grown(40)
    first, second = whole([2, 3], 1, 40), whole([0], 2, 40)
    renewed = found.renewed([first, second], settle=30)
    stamps, poses = renewed.settled.path(0)
    np.testing.assert_array_equal(stamps, np.arange(30))
    np.testing.assert_array_equal(poses, first.paths[:30, :, 0])
    assert [frame.matches[:, 0].tolist() for frame in renewed.settled.frames] == [
        own.tolist() for own in first.identities[:30]
    ]
    assert remembered(renewed, 5) == pasts[5][30:]
    assert [stamp for stamp, _ in stamps_of(renewed.whole_lineage(5))] == list(range(40))
    assert len(renewed.distinct_ancestors()) == 10


def stamps_of(lineage):
    return [(record.stamp_ns, row) for record, row in lineage]


def test_later_steps_have_no_effect_on_a_copy():
    found, pasts = grown(40)
    copied = found.copy()
    for _ in range(2 * history.PRUNE_EVERY):
        found.append(FRAME, 50, np.zeros((3, 6)), np.zeros((2, 6), np.int32), np.zeros(2, np.int32))
        found.resample(np.zeros(6, np.int32))
    for m, past in enumerate(pasts):
        assert remembered(copied, m) == past


def test_the_tree_goes_on_after_a_new_past():
    found, _ = grown(40)
    found = found.renewed([whole(list(range(6)), 1, 40)], settle=0)
    before = [remembered(found, m) for m in range(6)]
    ancestors = np.array([0, 0, 2, 2, 2, 5], np.int32)
    for _ in range(2 * history.PRUNE_EVERY):
        found.resample(ancestors)
        found.append(FRAME, 50, np.zeros((3, 6)), np.zeros((2, 6), np.int32), np.zeros(2, np.int32))
        before = [before[a] for a in ancestors]
    for m in range(6):
        assert remembered(found, m)[:40] == before[m]
