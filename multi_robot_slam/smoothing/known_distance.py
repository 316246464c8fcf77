"""Covariances of a history's observations, at the landmarks that they are of (N1)."""

from collections.abc import Sequence

import numpy as np

from multi_robot_slam.models.compiled import kernel
from multi_robot_slam.models.frames import Record
from multi_robot_slam.models.ranging import Ranging, at_landmarks


def covariances_of(
    records: Sequence[Record],
    identities: Sequence[np.ndarray],
    poses: np.ndarray,
    ids: np.ndarray,
    places: np.ndarray,
) -> np.ndarray:
    """(O, 6): of all observations in the records' order, in `base_link` [m^2].

    Parameters
    ----------
    identities : for each record (B,), which landmark each observation is of.
    poses : (P, 3) from which the records saw them.
    ids, places : landmarks (N,) that are known, ascending, and (N, 3) where [m].

    """
    named = np.concatenate([np.empty(0, np.int64), *identities]).astype(np.int64)
    covariances = np.concatenate([np.empty((0, 6)), *(record.covariances for record in records)])
    if not len(ids) or not len(named):
        return covariances
    rows = np.searchsorted(ids, named).clip(max=len(ids) - 1)
    known = np.where((ids[rows] == named)[:, None], places[rows], np.nan)
    counts = [len(record.positions) for record in records]
    positions = np.concatenate([record.positions for record in records])
    offsets = _offsets(np.repeat(poses, counts, axis=0), known, positions)
    ranging = [_ranging(record) for record in records]
    rays, along = (np.concatenate(parts) for parts in zip(*ranging, strict=True))
    return at_landmarks(covariances, rays, along, offsets)


def _ranging(record: Record) -> Ranging:
    """What is NaN leaves the covariances as they are."""
    unknown = np.full((len(record.positions), 3), np.nan)
    return record.ranging or Ranging(unknown, unknown)


@kernel
def _offsets(poses: np.ndarray, places: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """(O, 3): `places` less `positions`, in `base_link`, of a robot at `poses` [m]."""
    offsets = np.empty_like(positions)
    for o in range(len(positions)):
        cos, sin = np.cos(poses[o, 2]), np.sin(poses[o, 2])
        dx, dy = places[o, 0] - poses[o, 0], places[o, 1] - poses[o, 1]
        offsets[o, 0] = cos * dx + sin * dy - positions[o, 0]
        offsets[o, 1] = cos * dy - sin * dx - positions[o, 1]
        offsets[o, 2] = places[o, 2] - positions[o, 2]
    return offsets
