"""What every living particle's past was, kept as a tree that coalesces.

All particles descend from few ancestors, so old steps need few rows. A step's record keeps one row
per particle of that step that still has a descendant (Jacob, Murray, Rubenthaler: Path storage in
the particle filter, 2015). After a rejuvenation every particle has a past of its own again; those
records keep a row for each until the next one.
"""

import hashlib
from collections.abc import Iterator, Sequence
from copy import copy
from typing import Any, NamedTuple, overload

import numpy as np

from multi_robot_slam.filter.settled import Settled
from multi_robot_slam.models.compiled import kernel
from multi_robot_slam.models.frames import Record, RobotFrame
from multi_robot_slam.smoothing.aliases import Aliases

PRUNE_EVERY = 32
"""Steps between two prunings: rare enough to cost little, often enough to keep memory small."""


class Past(NamedTuple):
    """A new past for the n particles `members`, with the same landmark for every observation."""

    members: np.ndarray
    """(n,) int: index of each particle."""
    paths: np.ndarray
    """(P, 3, n) float64: x, y [m], yaw [rad] in each record."""
    identities: list[np.ndarray]
    """For each record (B,) int32: id of the landmark of each observation."""
    aliases: Aliases
    """What landmarks of settled frames go by now."""
    signature: np.uint64
    """Of this past, as `signature_of` gives it."""


def signature_of(identities: Sequence[np.ndarray]) -> np.uint64:
    """A number that is equal where the identities, (B,) int32 each, are."""
    joined = np.concatenate([np.empty(0, np.int32), *identities])
    digest = hashlib.blake2b(joined.tobytes(), digest_size=8).digest()
    return np.uint64(np.frombuffer(digest, np.uint64)[0])


class History:
    """The frames of all steps so far, in order: those that settled, then one record for each.

    Parameters
    ----------
    particles : M.
    keeps_frames : whether settled frames are kept whole (`Settled`).

    """

    def __init__(self, particles: int, keeps_frames: bool = True):
        self.settled = Settled(keeps_frames)
        self.records: list[Record] = []
        self.signatures = np.zeros(particles, np.uint64)
        """(M,): equal where particles have the same landmark for every observation so far."""
        self._leaves = np.arange(particles, dtype=np.int32)
        self._pruned = 0
        self._rejuvenated = 0

    def __getstate__(self) -> dict[str, Any]:
        """With records of its own: those that are here lose rows from time to time."""
        return {**self.__dict__, "records": [copy(record) for record in self.records]}

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
            ranging=frame.ranging,
            extra=frame.extra,
            start=frame.start,
        )
        self.records.append(record)
        self._leaves = np.arange(len(self._leaves), dtype=np.int32)
        sign(self.signatures, matches)

    def resample(self, ancestors: np.ndarray) -> None:
        """Particle m continues as particle ancestors[m]."""
        self._leaves = self._leaves[ancestors]
        self.signatures = self.signatures[ancestors]

    def copy(self) -> "History":
        """The same, on which later steps of this one have no effect."""
        result = copy(self)
        result.signatures = self.signatures.copy()
        return result

    def renewed(self, pasts: Sequence[Past], settle: int) -> "History":
        """The history in which the members of each of `pasts`, at least one, have a new past.

        Other particles keep theirs. The first `settle` records leave, with the optimum of the first
        of the pasts, that of its first member.
        """
        particles = len(self._leaves)
        lineage = list(self.lineage(slice(None)))[::-1]
        paths = self._paths(pasts, lineage)
        result = History(particles)
        result.settled = self.settled.also(
            self.records[:settle],
            pasts[0].paths[:settle, :, 0].copy(),
            pasts[0].identities[:settle],
            pasts[0].aliases,
        )
        everyone = np.arange(particles, dtype=np.int32)
        result.records = [
            record.with_rows(paths[p], _matches(record.matches, rows, pasts, p), everyone)
            for p, (record, rows) in enumerate(lineage)
            if p >= settle
        ]
        result.signatures = self.signatures.copy()
        for past in pasts:
            result.signatures[past.members] = past.signature
        result._rejuvenated = result._pruned = len(result.records)
        return result

    def _paths(
        self, pasts: Sequence[Past], lineage: Sequence[tuple[Record, np.ndarray]]
    ) -> np.ndarray:
        """(P, 3, M) of all particles."""
        particles = len(self._leaves)
        if len(pasts[0].members) == particles:
            return pasts[0].paths
        paths = np.empty((len(lineage), 3, particles))
        members = np.concatenate([past.members for past in pasts])
        others = np.setdiff1d(np.arange(particles), members)
        for past in pasts:
            paths[:, :, past.members] = past.paths
        if len(others):
            for p, (record, rows) in enumerate(lineage):
                paths[p][:, others] = record.poses[:, rows[others]]
        return paths

    @overload
    def lineage(self, particle: int) -> Iterator[tuple[Record, int]]: ...
    @overload
    def lineage(self, particle: slice | np.ndarray) -> Iterator[tuple[Record, np.ndarray]]: ...
    def lineage(
        self, particle: int | slice | np.ndarray
    ) -> Iterator[tuple[Record, int]] | Iterator[tuple[Record, np.ndarray]]:
        """The past of `particle`, newest first: pairs of record and row; of several, their rows.

        As far as it has not settled.
        """
        row = self._leaves[particle]
        for record in reversed(self.records):
            yield record, row
            row = record.parents[row]

    def whole_lineage(self, particle: int) -> list[tuple[Record, int]]:
        """The past of `particle`, oldest first, with the settled frames if they are kept."""
        settled = [(frame, 0) for frame in self.settled.frames]
        return settled + list(self.lineage(particle))[::-1]

    def distinct_ancestors(self) -> np.ndarray:
        """For each frame that has not settled, oldest first: how many rows have descendants."""
        counts = np.zeros(len(self.records), int)
        rows = np.unique(self._leaves)
        for i in range(len(self.records) - 1, -1, -1):
            counts[i] = len(rows)
            rows = np.unique(self.records[i].parents[rows])
        return counts

    def _prune(self) -> None:
        """Drop rows without descendants, from the newest record back to where nothing changes.

        And not further back than the last rejuvenation, where every particle has its row.
        """
        rows, self._leaves = _renumbered(self._leaves)
        for i in range(len(self.records) - 1, self._rejuvenated - 1, -1):
            record = self.records[i]
            if len(rows) == len(record.parents) and i < self._pruned:
                break
            record.poses = record.poses[:, rows]
            record.matches = record.matches[:, rows]
            parents = record.parents[rows]
            if i == self._rejuvenated:
                record.parents = parents
            else:
                rows, record.parents = _renumbered(parents)
        self._pruned = len(self.records)


def _matches(
    matches: np.ndarray, rows: np.ndarray, pasts: Sequence[Past], place: int
) -> np.ndarray:
    """(B, M) int32 of the record at `place`, one column in memory where all are equal."""
    if len(pasts[0].members) == len(rows):
        own = pasts[0].identities[place]
        return np.broadcast_to(own[:, None], (len(matches), len(rows)))
    matches = matches[:, rows]
    for past in pasts:
        matches[:, past.members] = past.identities[place][:, None]
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
