"""Which landmarks of a particle are in the published map."""

from collections.abc import Sequence

import numpy as np

from multi_robot_slam.filter.existence import Placed, published
from multi_robot_slam.filter.looks import frames_of
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.filter.state import State
from multi_robot_slam.models.frames import Record


def are_there(
    state: State,
    lineage: Sequence[tuple[Record, int]],
    columns: np.ndarray,
    values: np.ndarray,
    settings: FilterSettings,
) -> np.ndarray:
    """(N,) bool: which landmarks are likely to exist where the particle has them (`existence`).

    Parameters
    ----------
    lineage : the particle's past, oldest first, as far as it has not settled.
    columns, values : (N,), (N, 9) of its landmarks, as of `Landmarks.of_particle`.

    """
    landmarks, known = state.landmarks, state.existence
    frames = frames_of(
        [record for record, _ in lineage],
        np.array([record.poses[:, row] for record, row in lineage]),
        [record.matches[:, row] for record, row in lineage],
    )
    ids = landmarks.ids[columns].astype(np.int64)
    placed = Placed.of(ids, values)
    evidence = known.also(frames, placed, known.seen(frames), settings.existence).evidence.of(ids)
    descriptors = landmarks.descriptors[columns]
    return published(evidence, descriptors, settings.descriptor_gate, settings.existence)
