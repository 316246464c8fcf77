"""Time in the report: seconds since the run began, and which samples of a long run are shown."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from multi_robot_slam.runs import Run

MOST_SAMPLES = 2000
"""Of one curve or path, and of the slider."""
MOST_TEAM_SAMPLES = 12_000
"""The same over all robots, so that the report of a large team stays small."""


class Timeline(NamedTuple):
    """The instants the slider stops at: the last of every `every` steps."""

    start_ns: int
    """Stamp of the first step, or of the first pose where there is no step."""
    steps: np.ndarray
    """(S,) int64: row in the run's steps."""
    stamps_ns: np.ndarray
    """(S,) int64."""
    every: int
    """How many steps each instant stands for."""
    most: int
    """Samples a curve may have."""

    def seconds(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Seconds since the start [s], float64, of `stamps_ns` [ns]."""
        return (np.asarray(stamps_ns, np.int64) - self.start_ns) / 1e9


def timeline(run: Run) -> Timeline:
    """The instants of a run, all steps or, in a long run, every n-th."""
    stamps = np.array([step.stamp_ns for step in run.steps], np.int64)
    most = min(MOST_SAMPLES, MOST_TEAM_SAMPLES // len(run.robots))
    starts = first_rows(len(stamps), most)
    every = int(starts[1]) if len(starts) > 1 else max(1, len(stamps))
    steps = np.minimum(starts + every, len(stamps)) - 1
    paths = [robot.path.stamps_ns[:1] for robot in run.robots.values()]
    start_ns = min([*stamps[:1].tolist(), *np.concatenate(paths).tolist()], default=0)
    return Timeline(start_ns, steps, stamps[steps], every, most)


def first_rows(count: int, most: int) -> np.ndarray:
    """First row of each group when `count` rows make at most `most` groups of equal size."""
    return np.arange(0, count, max(1, -(-count // most)))


def thinned(count: int, most: int) -> np.ndarray:
    """Every n-th of `count` rows and the last, `most` + 1 at most."""
    rows = first_rows(count, most)
    return rows if not count or rows[-1] == count - 1 else np.append(rows, count - 1)


def grouped(reduce: np.ufunc, values: Sequence | np.ndarray, most: int) -> np.ndarray:
    """`reduce` (np.minimum, np.add, ...) of each group of `first_rows`."""
    each = np.asarray(values)
    return reduce.reduceat(each, first_rows(len(each), most)) if len(each) else each


def newest_rows(stamps_ns: np.ndarray, instants_ns: np.ndarray) -> np.ndarray:
    """(S,) the newest row of ascending `stamps_ns` at each instant; -1 before the first."""
    return np.searchsorted(stamps_ns, instants_ns, side="right") - 1
