"""How well observations were matched with landmarks, and from which true one each landmark came."""

from collections import Counter
from typing import NamedTuple

import numpy as np

from msg_defs.errors import InputError
from multi_robot_slam.runs.run import Run


class Associations(NamedTuple):
    """All observations with known truth, in the order of the steps; C of them."""

    steps: np.ndarray
    """(C,) int64: index of the step in the run."""
    ids: np.ndarray
    """(C,) int64: landmark the observation updated or created."""
    is_new: np.ndarray
    """(C,) bool: it created the landmark."""
    truth: np.ndarray
    """(C,) int64: row of the observed landmark in the true map."""
    robots: np.ndarray
    """(C,) int64: index in the team of the robot that observed it."""


class Origins(NamedTuple):
    """From which true landmark each estimated one came."""

    landmarks: dict[int, int]
    """Estimated id -> row in the true map."""
    by_majority: frozenset[int]
    """Ids whose creation no step record shows, attributed by the majority of their matches."""


def associations(run: Run) -> Associations:
    """Join the step records of the best particle with the truth of each observation."""
    rows = [np.empty((0, 5), np.int64)]
    team = list(run.robots)
    for index, step in enumerate(run.steps):
        for frame in step.frames:
            truth = run.observation_truth.get((frame.robot, step.stamp_ns))
            if truth is None:
                continue
            if len(truth) != len(frame.landmarks):
                raise InputError(
                    f"{frame.robot} at {step.stamp_ns} ns: {len(frame.landmarks)} observations "
                    f"but truth for {len(truth)}; evaluate against the truth of the same run"
                )
            steps, robots = np.full((2, len(truth)), [[index], [team.index(frame.robot)]])
            rows.append(np.column_stack([steps, frame.landmarks, frame.is_new, truth, robots]))
    steps, ids, is_new, truth, robots = np.concatenate(rows).astype(np.int64).T
    return Associations(steps, ids, is_new.astype(bool), truth, robots)


def origins(observed: Associations) -> Origins:
    """The true landmark each estimated one came from: that of the observation that created it.

    One observation creates a landmark, the same in all particles; but the step records show the
    best particle of their step, which need not be an ancestor of the final one and may have matched
    where its ancestor created. A landmark created unseen counts for the true landmark most of its
    recorded matches came from (the lowest row in a tie).
    """
    ids, truths = observed.ids[observed.is_new], observed.truth[observed.is_new]
    created = dict(zip(ids.tolist(), truths.tolist(), strict=True))
    votes: dict[int, Counter] = {}
    for landmark, truth in zip(observed.ids.tolist(), observed.truth.tolist(), strict=True):
        if landmark not in created:
            votes.setdefault(landmark, Counter())[truth] += 1
    elected = {landmark: _winner(count) for landmark, count in votes.items()}
    return Origins(created | elected, frozenset(elected))


def association_quality(
    observed: Associations, origin: Origins, among: np.ndarray | bool = True
) -> tuple[float | None, float | None]:
    """Precision and recall of the association, 0 to 1; None where there is nothing to count.

    A match is right if its landmark came (`origins`) from the true landmark the observation came
    from. Precision: the share of right ones among the matched (not new) observations. Recall: the
    share of rightly matched ones among the observations of a true landmark that any robot of the
    team had observed in an earlier step. `among` (C,) limits which observations count.
    """
    source = np.array([origin.landmarks[i] for i in observed.ids.tolist()], np.int64)
    right = ~observed.is_new & (source == observed.truth)
    _, first, row = np.unique(observed.truth, return_index=True, return_inverse=True)
    known = observed.steps[first][row] < observed.steps
    return _share(right, ~observed.is_new & among), _share(right, known & among)


def _winner(count: Counter) -> int:
    return min(count, key=lambda truth: (-count[truth], truth))


def _share(hits: np.ndarray, among: np.ndarray) -> float | None:
    return float(hits[among].mean()) if among.any() else None
