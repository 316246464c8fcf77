"""The map of rejuvenated particles, made as a whole."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from multi_robot_slam.filter import kernels
from multi_robot_slam.filter.landmarks import Landmarks
from multi_robot_slam.filter.reserved import reserved


@dataclass(frozen=True, eq=False)
class Held:
    """All N landmarks of a map, and what some of its M particles hold."""

    ids: np.ndarray
    """(N,) int32, ascending."""
    descriptors: np.ndarray
    """(N, 128) float32."""
    places: np.ndarray
    """(N, 3) float64: where one particle of the largest group has each [m]; FAR: it has not."""
    particles: int
    """M."""
    dtype: np.dtype
    """Of planes."""
    next_id: int
    """Of the landmark that is created next."""
    pieces: np.ndarray
    """(N,) int32: piece of the map that each belongs to."""
    others: np.ndarray
    """(n,): particles."""
    planes: np.ndarray
    """(N, 9, n): their means and covariances, as in `Landmarks`."""


def held(landmarks: Landmarks, others: np.ndarray, ancestors: np.ndarray, particle: int) -> Held:
    """A copy of what the particles `ancestors` (n,) hold; they will be the particles `others`.

    `particle`: the one whose landmarks' places are told.
    """
    columns = landmarks.alive()
    columns = columns[np.argsort(landmarks.ids[columns])]
    return Held(
        landmarks.ids[columns],
        landmarks.descriptors[columns],
        landmarks.planes_of(columns, np.array([particle]))[:, :3, 0].astype(float),
        landmarks.planes.shape[2],
        landmarks.planes.dtype,
        landmarks.next_id,
        landmarks.pieces[columns],
        others,
        landmarks.planes_of(columns, ancestors),
    )


def of_groups(old: Held, groups: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Landmarks:
    """The map in which each group holds its new landmarks, and who is in none the old ones.

    Parameters
    ----------
    groups : of each its particles (n,), ids (N',) of landmarks, ascending, and planes (N', 9, n).

    """
    ids = np.unique(np.concatenate([own for _, own, _ in groups])).astype(np.int32)
    members = np.concatenate([members for members, _, _ in groups])
    keeps = ~np.isin(old.others, members)
    kept = old.planes[:, :, keeps]
    is_held = (kept[:, 0] < kernels.FAR / 2).any(axis=1)
    ids = np.union1d(ids, old.ids[is_held])
    planes = reserved((len(ids), kernels.PLANES, old.particles), old.dtype)
    planes[:] = kernels.NO_LANDMARK[:, None]
    for particles, own, values in groups:
        rows = np.searchsorted(ids, own)
        planes[np.ix_(rows, np.arange(kernels.PLANES), particles)] = values
    rows = np.searchsorted(ids, old.ids[is_held])
    planes[np.ix_(rows, np.arange(kernels.PLANES), old.others[keeps])] = kept[is_held]
    rows = np.searchsorted(old.ids, ids)
    return Landmarks.holding(ids, planes, old.descriptors[rows], old.next_id, old.pieces[rows])
