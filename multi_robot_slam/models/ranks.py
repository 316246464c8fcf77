"""Ranks within groups: the best of each group before the second of any."""

import numpy as np


def in_groups(groups: np.ndarray, order: np.ndarray) -> np.ndarray:
    """(n,) int: how many of its own group come before each in `order`.

    Parameters
    ----------
    groups : (n,) int, not negative.
    order : (n,) all rows, the best first.

    """
    by_group = order[np.argsort(groups[order], kind="stable")]
    starts = np.flatnonzero(np.diff(groups[by_group], prepend=-1))
    lengths = np.diff(starts, append=len(groups))
    ranks = np.empty(len(groups), int)
    ranks[by_group] = np.arange(len(groups)) - np.repeat(starts, lengths)
    return ranks
