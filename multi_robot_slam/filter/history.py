"""What every living particle's past was, kept as a tree that coalesces.

All particles descend from few ancestors, so old steps need few rows. A step's record keeps one row
per particle of that step that still has a descendant (Jacob, Murray, Rubenthaler: Path storage in
the particle filter, 2015).
"""

import hashlib
from collections.abc import Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np
from numba import njit

from multi_robot_slam.models.frames import Record, RobotFrame

PRUNE_EVERY = 32
"""Steps between two prunings: rare enough to cost little, often enough to keep memory small."""


class Past(NamedTuple):
    """A new past for the n particles `members`, with the same landmark for every observation."""

    members: np.ndarray
    """(n,) int: index of each particle."""
    paths: np.ndarray
    """(P, 3, n) float64: x, y [m], yaw [rad] in each of the P records."""
    identities: list[np.ndarray]
    """For each record (B,) int32: id of the landmark of each observation."""

    def signature(self) -> np.uint64:
        """A number that is equal where the identities are."""
        digest = hashlib.blake2b(np.concatenate(self.identities).tobytes(), digest_size=8).digest()
        return np.frombuffer(digest, np.uint64)[0]


class History:
    """The frames of all steps so far, in order."""

    def __init__(self, particles: int):
        self.records: list[Record] = []
        self.signatures = np.zeros(particles, np.uint64)
        """(M,): equal where particles have the same landmark for every observation so far."""
        self._leaves = np.arange(particles, dtype=np.int32)
        self._pruned = 0

    def append(
        self,
        frame: RobotFrame,
        step: int,
        poses: np.ndarray,
        matches: np.ndarray,
        new_ids: np.ndarray,
    ) -> None:
        """Add a robot's frame: its `poses` (3, M), and the rest as in `Record`."""
        if len(self.records) - self._pruned >= PRUNE_EVERY:
            self._prune()
        record = Record(
            robot=frame.robot,
            stamp_ns=frame.stamp_ns,
            step=step,
            motion=frame.motion,
            seconds=frame.seconds,
            positions=frame.positions,
            covariances=frame.covariances,
            poses=poses.copy(),
            matches=matches,
            new_ids=new_ids,
            parents=self._leaves,
            sightings=frame.sightings,
        )
        self.records.append(record)
        self._leaves = np.arange(len(self._leaves), dtype=np.int32)
        sign(self.signatures, matches)

    def resample(self, ancestors: np.ndarray) -> None:
        """Particle m continues as particle ancestors[m]."""
        self._leaves = self._leaves[ancestors]
        self.signatures = self.signatures[ancestors]

    def rewrite(self, pasts: Sequence[Past], first: int = 0) -> None:
        """Give the members of each group new pasts from record `first` on; others keep theirs."""
        count = len(self.records) - first
        rows = [rows for _, rows in islice(self.lineage(slice(None)), count)][::-1]
        alone = np.ones(len(self._leaves), bool)
        for group in pasts:
            alone[group.members] = False
            self.signatures[group.members] = group.signature()
        before = self.records[first].parents[rows[0]] if count else self._leaves
        for p, record in enumerate(self.records[first:]):
            record.poses = record.poses[:, rows[p]]
            for group in pasts:
                record.poses[:, group.members] = group.paths[p]
            record.matches = _rewritten(record.matches, rows[p], pasts, p, alone.any())
            record.parents = np.arange(len(self._leaves), dtype=np.int32) if p else before
        self._leaves = np.arange(len(self._leaves), dtype=np.int32) if count else before
        self._pruned = len(self.records)

    def lineage(self, particle: int | slice):
        """The past of `particle`, newest first: pairs of record and row; of several, their rows."""
        row = self._leaves[particle]
        for record in reversed(self.records):
            yield record, row
            row = record.parents[row]

    def distinct_ancestors(self) -> np.ndarray:
        """For each record, oldest first, from how many of its rows today's particles descend."""
        counts = np.zeros(len(self.records), int)
        rows = np.unique(self._leaves)
        for i in range(len(self.records) - 1, -1, -1):
            counts[i] = len(rows)
            rows = np.unique(self.records[i].parents[rows])
        return counts

    def _prune(self) -> None:
        """Drop rows without descendants, from the newest record back to where nothing changes."""
        rows, self._leaves = _renumbered(self._leaves)
        for i in range(len(self.records) - 1, -1, -1):
            record = self.records[i]
            if len(rows) == len(record.parents) and i < self._pruned:
                break
            record.poses = record.poses[:, rows]
            record.matches = record.matches[:, rows]
            rows, record.parents = _renumbered(record.parents[rows])
        self._pruned = len(self.records)


def _rewritten(
    matches: np.ndarray, rows: np.ndarray, pasts: Sequence[Past], p: int, some_stay: bool
) -> np.ndarray:
    """(B, M) int32, one column in memory where all are equal."""
    if len(pasts) == 1 and not some_stay:
        return np.broadcast_to(pasts[0].identities[p][:, None], (len(matches), len(rows)))
    matches = matches[:, rows]
    for group in pasts:
        matches[:, group.members] = group.identities[p][:, None]
    return matches


@njit(cache=True, nogil=True)
def sign(signatures, matches):
    """Add the `matches` (B, M) of a frame to the signatures (M,), in place."""
    factor = np.uint64(0x9E3779B97F4A7C15)  # odd, so that no earlier match is ever lost
    for b in range(len(matches)):
        for m in range(signatures.size):
            signatures[m] = (signatures[m] ^ np.uint64(matches[b, m])) * factor


def _renumbered(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct `rows`, ascending, and each row's place among them (int32)."""
    is_used = np.zeros(rows.max() + 1, bool)
    is_used[rows] = True
    places = np.cumsum(is_used, dtype=np.int32) - 1
    return np.flatnonzero(is_used), places[rows]
