"""What no longer moves in a path: the frames that have left the window of rejuvenation.

Their measurements live on in the prior; here is what a user still asks of them. A frame takes some
forty bytes, and no step of the filter ever walks through them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from multi_robot_slam.models.frames import Record
from multi_robot_slam.smoothing.aliases import Aliases

Parts = tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...]

MOST_PARTS = 64

MOST_ROBOTS = 63
"""Bits of a number, without that of the sign."""


@dataclass(frozen=True, eq=False)
class SeenLandmarks:
    """How often n landmarks were seen, and by whom."""

    ids: np.ndarray
    """(n,) int64, ascending."""
    counts: np.ndarray
    """(n,) int64."""
    robots: np.ndarray
    """(n,) int64: bit i is set when robot i saw it."""

    @classmethod
    def of(cls, ids: np.ndarray, counts: np.ndarray, robots: np.ndarray) -> "SeenLandmarks":
        """The sums over rows that have the same of `ids`, in any order."""
        unique, places = np.unique(ids, return_inverse=True)
        total, bits = np.zeros(len(unique), np.int64), np.zeros(len(unique), np.int64)
        np.add.at(total, places, counts)
        np.bitwise_or.at(bits, places, robots)
        return cls(unique, total, bits)

    @classmethod
    def nothing(cls) -> "SeenLandmarks":
        return cls(*(np.empty(0, np.int64) for _ in range(3)))

    def also(self, records: Sequence[Record], identities: Sequence[np.ndarray]) -> "SeenLandmarks":
        """These, and what `records` saw, whose observations are of `identities` (B,) each."""
        seen = np.concatenate([np.empty(0, np.int64), *identities])
        bits = np.repeat([1 << r.robot for r in records], [len(own) for own in identities])
        return SeenLandmarks.of(
            np.concatenate([self.ids, seen]),
            np.concatenate([self.counts, np.ones(len(seen), np.int64)]),
            np.concatenate([self.robots, bits.astype(np.int64)]),
        )

    def renamed(self, aliases: Aliases) -> "SeenLandmarks":
        """With joined landmarks under the ids that they go by."""
        if not len(aliases):
            return self
        return SeenLandmarks.of(aliases.of(self.ids), self.counts, self.robots)

    def forget(self, ids: np.ndarray) -> "SeenLandmarks":
        """Without the landmarks `ids`, ascending."""
        kept = np.isin(self.ids, ids, invert=True)
        return SeenLandmarks(self.ids[kept], self.counts[kept], self.robots[kept])

    def of_ids(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Counts and robots (N,) of the landmarks `ids` (N,), zero where they were not seen."""
        places = np.searchsorted(self.ids, ids).clip(max=max(len(self.ids) - 1, 0))
        known = np.zeros(len(ids), bool)
        if len(self.ids):
            known = self.ids[places] == ids
        counts, robots = np.zeros(len(ids), np.int64), np.zeros(len(ids), np.int64)
        counts[known], robots[known] = self.counts[places[known]], self.robots[places[known]]
        return counts, robots


@dataclass(frozen=True, eq=False)
class Settled:
    """The frames that have left the window; a new one for each time that some do."""

    keeps_frames: bool = True
    """Whether `frames` is kept, to smooth a whole run at its end: some 3 kB a frame."""
    parts: Parts = ()
    """Robots (n,), stamps (n,) [ns] and poses (n, 3) of the frames that left together."""
    seen: SeenLandmarks = field(default_factory=SeenLandmarks.nothing)
    frames: tuple[Record, ...] = ()
    """One row each."""

    def __len__(self) -> int:
        """Number of frames."""
        return sum(len(robots) for robots, _, _ in self.parts)

    def also(
        self,
        records: Sequence[Record],
        poses: np.ndarray,
        identities: Sequence[np.ndarray],
        aliases: Aliases,
    ) -> "Settled":
        """These, and `records` with their `poses` (n, 3) and `identities` (B,) each.

        `aliases`: what landmarks of the frames before go by now.
        """
        frames = self.frames
        if self.keeps_frames:
            frames = tuple(_renamed(frame, aliases) for frame in frames)
            frames += tuple(
                _one_row(record, pose, own)
                for record, pose, own in zip(records, poses, identities, strict=True)
            )
        parts = self.parts
        if records:
            robots = np.array([record.robot for record in records], np.int32)
            stamps = np.array([record.stamp_ns for record in records], np.int64)
            parts = _joined((*parts, (robots, stamps, poses)))
        seen = self.seen.renamed(aliases).also(records, identities)
        return Settled(self.keeps_frames, parts, seen, frames)

    def forget(self, ids: np.ndarray) -> "Settled":
        """Without how often the landmarks `ids` were seen; frames stay as they are."""
        return replace(self, seen=self.seen.forget(ids)) if len(ids) else self

    def path(self, robot: int) -> tuple[np.ndarray, np.ndarray]:
        """Stamps (n,) [ns] and poses (n, 3) of one robot, oldest first."""
        stamps = [np.empty(0, np.int64)]
        poses = [np.empty((0, 3))]
        for robots, of_all, path in self.parts:
            own = robots == robot
            stamps.append(of_all[own])
            poses.append(path[own])
        return np.concatenate(stamps), np.concatenate(poses)


def _joined(parts: Parts) -> Parts:
    """The same in few parts: a path is asked for once a second."""
    if len(parts) < MOST_PARTS:
        return parts
    robots, stamps, poses = zip(*parts, strict=True)
    return ((np.concatenate(robots), np.concatenate(stamps), np.concatenate(poses)),)


def _one_row(record: Record, pose: np.ndarray, identities: np.ndarray) -> Record:
    return record.with_rows(pose[:, None], identities[:, None], np.zeros(1, np.int32))


def _renamed(frame: Record, aliases: Aliases) -> Record:
    if not len(aliases):
        return frame
    return frame.with_rows(frame.poses, aliases.of(frame.matches), frame.parents)
