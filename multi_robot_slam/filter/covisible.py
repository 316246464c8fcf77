"""Which landmarks were seen together: what a robot will see next is next to what it sees now."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from multi_robot_slam.smoothing.aliases import Aliases


@dataclass(frozen=True, eq=False)
class Covisible:
    """Landmarks of settled frames, and which of them some frame had both."""

    ids: np.ndarray
    """(n,) int64, ascending."""
    together: np.ndarray
    """(n, n) bool, symmetric."""

    @classmethod
    def nothing(cls) -> "Covisible":
        return cls(np.empty(0, np.int64), np.empty((0, 0), bool))

    def also(self, identities: Sequence[np.ndarray], aliases: Aliases) -> "Covisible":
        """With frames that saw landmarks `identities` (B,) each; others are renamed."""
        old = aliases.of(self.ids)
        ids = np.unique(np.concatenate([old, *identities])).astype(np.int64)
        together = np.zeros((len(ids), len(ids)), bool)
        places = np.searchsorted(ids, old)
        np.logical_or.at(together, np.ix_(places, places), self.together)
        for own in identities:
            places = np.searchsorted(ids, own)
            together[np.ix_(places, places)] = True
        return Covisible(ids, together)

    def near(self, ids: np.ndarray) -> np.ndarray:
        """Ids of landmarks that were seen together with any of `ids`."""
        rows = np.searchsorted(self.ids, np.intersect1d(self.ids, ids))
        return self.ids[self.together[rows].any(axis=0)]
