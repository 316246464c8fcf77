"""How far the map is from the truth: the one definition, for every table, page and study.

**The map's error** is that of one estimated landmark for each true one: of those that came from it
(`associations.origins`) the one observed most often, of equals the one that claims the smallest
variance. What a true landmark has besides are *duplicates*. They are counted, and not part of the
error: most are made by a single wrong observation, are as wrong as that, and are never seen again,
so a handful of them would say nothing about where the landmarks are that the team steers by.
Landmarks that come from no true one cannot be held to any; they are counted as unattributed.
"""

from typing import NamedTuple

import numpy as np

from msg_defs.types import LandmarkMap
from multi_robot_slam.runs.associations import Origins
from multi_robot_slam.runs.trajectory_errors import alignment, rotation


class Attributed(NamedTuple):
    """The landmarks of a map that come from a true one; A of them, in the order of the map."""

    rows: np.ndarray
    """(A,) int64: row in the map."""
    sources: np.ndarray
    """(A,) int64: row in the true map."""
    is_first: np.ndarray
    """(A,) bool: it stands for its source in the map's error; the others are duplicates."""


def attributed(landmarks: LandmarkMap, origin: Origins) -> Attributed:
    """Which landmarks come from which true one, and which of them stand for it."""
    ids = landmarks.ids.tolist()
    rows = np.array([row for row, i in enumerate(ids) if i in origin.landmarks], np.int64)
    sources = np.array([origin.landmarks[ids[row]] for row in rows], np.int64)
    variances = landmarks.covariances[rows][:, [0, 3, 5]].sum(axis=1)
    observations = landmarks.observations[rows].astype(np.int64)
    order = np.lexsort((landmarks.ids[rows], variances, -observations, sources))
    _, first = np.unique(sources[order], return_index=True)
    is_first = np.zeros(len(rows), bool)
    is_first[order[first]] = True
    return Attributed(rows, sources, is_first)


def place_errors(
    landmarks: LandmarkMap, true_landmarks: LandmarkMap, found: Attributed
) -> np.ndarray:
    """(A, 3) how far each attributed landmark is from its true place [m]."""
    places = landmarks.positions[found.rows].astype(float)
    return places - true_landmarks.positions[found.sources]


def aligned_place_errors(
    landmarks: LandmarkMap, true_landmarks: LandmarkMap, found: Attributed
) -> np.ndarray:
    """(F, 3) the same of the F first ones [m], turned and shifted in the plane closest to truth."""
    places = landmarks.positions[found.rows[found.is_first]].astype(float)
    truth = true_landmarks.positions[found.sources[found.is_first]].astype(float)
    angle, shift = alignment(places[:, :2], truth[:, :2])
    moved = np.column_stack([places[:, :2] @ rotation(angle).T + shift, places[:, 2]])
    return moved - truth
