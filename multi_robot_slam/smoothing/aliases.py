"""Landmarks that turned out to be one: which id each of them goes by."""

import numpy as np


class Aliases:
    """A mapping of landmark ids to the ids that they go by now; ids without an alias stay."""

    def __init__(self, old: np.ndarray | None = None, new: np.ndarray | None = None):
        self._old = np.empty(0, np.int64) if old is None else old
        """(A,): ids that were given up, ascending."""
        self._new = np.empty(0, np.int64) if new is None else new
        """(A,): what each goes by; none of these was given up itself."""

    def __len__(self) -> int:
        """Number of ids that were given up."""
        return len(self._old)

    def of(self, ids: np.ndarray) -> np.ndarray:
        """What `ids`, of any shape, go by; of the same dtype."""
        if not len(self):
            return ids
        places = np.searchsorted(self._old, ids).clip(max=len(self) - 1)
        return np.where(self._old[places] == ids, self._new[places], ids).astype(ids.dtype)

    def among(self, ids: np.ndarray) -> "Aliases":
        """Those of `ids` (N,) alone."""
        of_these = np.isin(self._old, ids)
        return Aliases(self._old[of_these], self._new[of_these])

    def joined(self, pairs: np.ndarray) -> "Aliases":
        """These, and from now on pairs[:, 1] go by pairs[:, 0]: (A, 2) ids, each once at most."""
        order = np.argsort(pairs[:, 1])
        later = Aliases(pairs[order, 1], pairs[order, 0])
        old = np.append(self._old, pairs[:, 1])
        new = np.append(later.of(self._new), pairs[:, 0])
        order = np.argsort(old)
        return Aliases(old[order], new[order])
