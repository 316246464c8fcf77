"""Poses published between the steps: a run of hours has a million, and keeps them in arrays."""

from array import array
from collections import defaultdict

import numpy as np

from msg_defs.types import Estimate
from msg_defs.wire import Estimates

NONE = Estimates(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))
"""Of a robot whose pose was published at its steps alone."""


class Predictions:
    """Collects the predictions of each robot in the order in which they were published."""

    def __init__(self) -> None:
        self._stamps: defaultdict[str, array[int]] = defaultdict(lambda: array("q"))
        self._numbers: defaultdict[str, array[float]] = defaultdict(lambda: array("d"))

    def add(self, estimate: Estimate) -> None:
        """One more of its robot."""
        self._stamps[estimate.robot].append(estimate.stamp_ns)
        self._numbers[estimate.robot].extend(estimate.pose)
        self._numbers[estimate.robot].extend(estimate.covariance.ravel())

    def by_robot(self) -> dict[str, Estimates]:
        """Of each robot that has some."""
        found = {}
        for robot, stamps in self._stamps.items():
            rows = np.array(self._numbers[robot]).reshape(-1, 12)
            covariances = rows[:, 3:].reshape(-1, 3, 3)
            found[robot] = Estimates(np.array(stamps, np.int64), rows[:, :3], covariances)
        return found
