"""Which settled landmarks are worth their cost: all of them are known jointly.

Time and memory of the prior grow with the square of its landmarks, and images have thousands. What
a robot needs where it comes back is some landmarks in view, each of which it finds again. So those
that were hardly ever seen again are forgotten, and where there are too many, those that have the
most better ones around them. What they said of the paths stays; they leave the map.
"""

from collections.abc import Sequence

import numpy as np

from multi_robot_slam.filter.settings import RejuvenationSettings
from multi_robot_slam.models.frames import Record
from multi_robot_slam.models.ranks import in_groups

NEIGHBOURHOOD_M = 2.0
"""Side of the cells in each of which as many landmarks are kept; a view has a dozen."""

PATIENCE = 30
"""Frames of its robot after which a landmark that was seen once is taken for a chance find."""

NOTHING = -1
"""Identity of an observation of nothing that will be seen again."""


def without_chance_finds(
    records: Sequence[Record], identities: Sequence[np.ndarray], known: np.ndarray
) -> list[np.ndarray]:
    """`identities` (B,) of each record, `NOTHING` for landmarks that were seen once, and long ago.

    One observation says nothing of the pose that it was made from. Landmarks among the ids `known`
    were seen in earlier frames, too.
    """
    ids, counts = np.unique(np.concatenate([*identities, known]), return_counts=True)
    robots = np.array([record.robot for record in records])
    is_old = np.zeros(len(records), bool)
    for robot in np.unique(robots):
        is_old[np.flatnonzero(robots == robot)[:-PATIENCE]] = True
    return [
        np.where(old & (counts[np.searchsorted(ids, own)] == 1), NOTHING, own)
        for old, own in zip(is_old, identities, strict=True)
    ]


def forgotten(
    ids: np.ndarray,
    places: np.ndarray,
    counts: np.ndarray,
    settings: RejuvenationSettings,
    pieces: np.ndarray | int = 0,
) -> np.ndarray:
    """Those of the landmarks `ids` (n,) that are not worth their cost, ascending.

    Parameters
    ----------
    places : (n, 3) in the frame of its piece [m].
    counts : (n,) how often each was observed.
    pieces : (n,) of the map, or that of all.

    """
    is_seen = counts >= settings.least_seen
    most = settings.landmarks
    if np.count_nonzero(is_seen) > most:
        kept = np.flatnonzero(is_seen)
        cells = np.floor(places[kept, :2] / NEIGHBOURHOOD_M)
        cells = np.column_stack([cells, np.broadcast_to(pieces, len(ids))[kept]])
        best = np.argsort(_rank_in_cell(cells, counts[kept], ids[kept]), kind="stable")
        is_seen[kept[best[most:]]] = False
    return np.sort(ids[~is_seen])


def _rank_in_cell(cells: np.ndarray, counts: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """(n,): how many of its cell were observed more often; the newer of equals first."""
    _, numbers = np.unique(cells, axis=0, return_inverse=True)
    return in_groups(numbers, np.lexsort([-ids, -counts]))
