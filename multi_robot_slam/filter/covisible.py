"""Which landmarks were seen together: what a robot will see next is next to what it sees now."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from multi_robot_slam.models.frames import Record
from multi_robot_slam.smoothing.aliases import Aliases


@dataclass(frozen=True, eq=False)
class Covisible:
    """Landmarks of settled frames, and which of them some frame had both."""

    ids: np.ndarray
    """(n,) int64, ascending."""
    together: np.ndarray
    """(n, n) bool, symmetric."""

    last: dict[int, np.ndarray]
    """Ids (B,) of the landmarks that each robot saw when it last saw any."""

    @classmethod
    def nothing(cls) -> "Covisible":
        return cls(np.empty(0, np.int64), np.empty((0, 0), bool), {})

    def also(
        self, records: Sequence[Record], identities: Sequence[np.ndarray], aliases: Aliases
    ) -> "Covisible":
        """With `records` that saw landmarks `identities` (B,) each; others are renamed."""
        if not len(aliases) and not records:
            return self
        old = aliases.of(self.ids)
        ids = np.unique(np.concatenate([old, *identities])).astype(np.int64)
        together = np.zeros((len(ids), len(ids)), bool)
        places = np.searchsorted(ids, old)
        np.logical_or.at(together, np.ix_(places, places), self.together)
        last = {robot: aliases.of(own) for robot, own in self.last.items()}
        for record, own in zip(records, identities, strict=True):
            places = np.searchsorted(ids, own)
            together[np.ix_(places, places)] = True
            if len(own):
                last[record.robot] = own
        return Covisible(ids, together, last)

    def only(self, ids: np.ndarray) -> "Covisible":
        """Of the landmarks `ids` alone."""
        kept = np.isin(self.ids, ids)
        if kept.all():
            return self
        return Covisible(self.ids[kept], self.together[np.ix_(kept, kept)], self.last)

    def near(self, ids: np.ndarray) -> np.ndarray:
        """Ids of landmarks that were seen together with any of `ids`."""
        rows = np.searchsorted(self.ids, np.intersect1d(self.ids, ids))
        return self.ids[self.together[rows].any(axis=0)]
