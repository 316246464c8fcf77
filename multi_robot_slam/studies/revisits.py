"""How well landmarks are found again that nobody has seen for a while."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from multi_robot_slam.runs.associations import associations, origins
from multi_robot_slam.runs.run import Run

LONG_S = 20.0
"""So long not seen by anybody, a landmark is found again, and not followed."""


class Revisits(NamedTuple):
    """The observations of landmarks that the team saw last more than `LONG_S` before."""

    seen: int
    recall: float | None
    """Share of them that were matched with a landmark of the true one."""
    precision: float | None
    """Of all matches with a landmark that the run matched last so long before: the right share."""


def revisits(run: Run, places: Mapping[int, np.ndarray]) -> Revisits:
    """Judge the best particle's matches in the order of the steps.

    A match is right where the landmark came from the true one observed, or, since one corner makes
    several keypoints, from one within `SAME_M` of it.

    Parameters
    ----------
    places : (3,) [m] of each true landmark.

    """
    observed = associations(run)
    source = origins(observed).landmarks
    stamps = np.array([step.stamp_ns for step in run.steps])[observed.steps] / 1e9
    true_last: dict[int, float] = {}
    own_last: dict[int, float] = {}
    recalled, right = [], []
    rows = zip(
        stamps.tolist(),
        observed.ids.tolist(),
        observed.is_new.tolist(),
        observed.truth.tolist(),
        strict=True,
    )
    for stamp, landmark, is_new, truth in rows:
        is_right = not is_new and _is_one(places, source[landmark], truth)
        if stamp - true_last.get(truth, stamp) > LONG_S:
            recalled.append(is_right)
        if not is_new and stamp - own_last.get(landmark, stamp) > LONG_S:
            right.append(is_right)
        true_last[truth] = own_last[landmark] = stamp
    return Revisits(len(recalled), _mean(recalled), _mean(right))


SAME_M = 0.05
"""Two landmarks nearer to each other are one place: keypoints of several sizes sit round a corner,
and a point 3 m off is measured to 4 cm."""


def _is_one(places: Mapping[int, np.ndarray], one: int, other: int) -> bool:
    return one == other or bool(np.linalg.norm(places[one] - places[other]) < SAME_M)


def _mean(values: list[bool]) -> float | None:
    return float(np.mean(values)) if values else None
