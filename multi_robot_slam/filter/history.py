"""What every living particle's past was, kept as a tree that coalesces.

All particles descend from few ancestors, so old steps need few rows. A step's record keeps one row
per particle of that step that still has a descendant (Jacob, Murray, Rubenthaler: Path storage in
the particle filter, 2015).
"""

import hashlib
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import NamedTuple, overload

import numpy as np

from multi_robot_slam.models.compiled import kernel
from multi_robot_slam.models.frames import Record, RobotFrame
from multi_robot_slam.smoothing.aliases import Aliases

PRUNE_EVERY = 32
"""Steps between two prunings: rare enough to cost little, often enough to keep memory small."""


class Past(NamedTuple):
    """A new past for the n particles `members`, with the same landmark for every observation.

    It replaces the last P records; before those only the names of landmarks change.
    """

    members: np.ndarray
    """(n,) int: index of each particle."""
    paths: np.ndarray
    """(P, 3, n) float64: x, y [m], yaw [rad] in each of the P records."""
    identities: list[np.ndarray]
    """For each of the P records (B,) int32: id of the landmark of each observation."""
    aliases: Aliases
    """What landmarks of the older records go by now."""
    signature: np.uint64
    """Of this past, as `signature_of` gives it."""

    def place(self, record: int, records: int) -> int:
        """Where the history's `record`, of `records`, is in this past; below 0: before it."""
        return record - records + len(self.identities)


def signature_of(identities: Sequence[np.ndarray]) -> np.uint64:
    """A number that is equal where the identities, (B,) int32 each, are."""
    digest = hashlib.blake2b(np.concatenate(identities).tobytes(), digest_size=8).digest()
    return np.uint64(np.frombuffer(digest, np.uint64)[0])


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

    def rewrite(self, pasts: Sequence[Past]) -> None:
        """Give the members of each of `pasts`, at least one, a new past; others keep theirs."""
        count = len(self.records)
        first = count - max(len(past.identities) for past in pasts)
        lineage = list(islice(self.lineage(slice(None)), count - first))[::-1]
        before = self.records[first].parents[lineage[0][1]]
        for i, (record, rows) in enumerate(lineage, first):
            record.poses = record.poses[:, rows]
            for past in pasts:
                if past.place(i, count) >= 0:
                    record.poses[:, past.members] = past.paths[past.place(i, count)]
            record.matches = _rewritten(record.matches, rows, pasts, i, count)
            record.parents = np.arange(len(rows), dtype=np.int32) if i > first else before
        for past in pasts:
            self.signatures[past.members] = past.signature
        self._leaves = np.arange(len(self._leaves), dtype=np.int32)
        self._rename([past for past in pasts if len(past.aliases)], first)
        self._pruned = count

    def _rename(self, pasts: Sequence[Past], first: int) -> None:
        """Apply the aliases of each past to the records before `first`, in its members' rows.

        A row that particles of several pasts descend from becomes one row for each.
        """
        if not pasts or not first:
            return
        names = [Aliases(), *(past.aliases for past in pasts)]
        labels = np.zeros(len(self._leaves), np.int64)
        for label, past in enumerate(pasts, 1):
            labels[past.members] = label
        later = self.records[first]
        for record in reversed(self.records[:first]):
            keys = later.parents * np.int64(len(names)) + labels
            keys, parents = np.unique(keys, return_inverse=True)
            later.parents = parents.astype(np.int32)
            rows, labels = np.divmod(keys, len(names))
            record.poses = record.poses[:, rows]
            record.matches = record.matches[:, rows]
            for label in np.unique(labels):
                own = labels == label
                record.matches[:, own] = names[label].of(record.matches[:, own])
            record.parents = record.parents[rows]
            later = record

    @overload
    def lineage(self, particle: int) -> Iterator[tuple[Record, int]]: ...
    @overload
    def lineage(self, particle: slice | np.ndarray) -> Iterator[tuple[Record, np.ndarray]]: ...
    def lineage(
        self, particle: int | slice | np.ndarray
    ) -> Iterator[tuple[Record, int]] | Iterator[tuple[Record, np.ndarray]]:
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
    matches: np.ndarray, rows: np.ndarray, pasts: Sequence[Past], record: int, records: int
) -> np.ndarray:
    """(B, M) int32, one column in memory where all are equal."""
    if len(pasts) == 1 and len(pasts[0].members) == len(rows):
        own = pasts[0].identities[pasts[0].place(record, records)]
        return np.broadcast_to(own[:, None], (len(matches), len(rows)))
    matches = matches[:, rows]
    for past in pasts:
        place = past.place(record, records)
        if place >= 0:
            matches[:, past.members] = past.identities[place][:, None]
        else:
            matches[:, past.members] = past.aliases.of(matches[:, past.members])
    return matches


@kernel
def sign(signatures: np.ndarray, matches: np.ndarray) -> None:
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
