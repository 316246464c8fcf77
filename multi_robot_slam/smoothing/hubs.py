"""Hubs: the landmarks that smoothing keeps as unknowns instead of eliminating them.

Eliminating a landmark ties all poses that saw it to each other. With few landmarks in one room,
each seen again and again, that ties everything to everything, and the arithmetic grows with the
cube of the poses. Kept as the last three unknowns, such a landmark costs three full rows, and
without it the poses are a band (a bordered band matrix, as in photogrammetry: Triggs, McLauchlan,
Hartley, Fitzgibbon: Bundle adjustment, a modern synthesis, 2000, section 6).
"""

from collections.abc import Iterator

import numpy as np

from multi_robot_slam.smoothing.envelope import TILE, Envelope, envelope_of
from multi_robot_slam.smoothing.problem import Problem

PAIR = 400
"""Multiplications of the factorisation that take as long as adding one pair of observations."""


def cheapest_envelope(problem: Problem) -> Envelope:
    """With those hubs that cost least: none, or the landmarks seen over many of the poses."""
    return min(
        (envelope_of(problem, hubs) for hubs in _candidates(problem)),
        key=lambda envelope: _cost(problem, envelope),
    )


def _candidates(problem: Problem) -> Iterator[np.ndarray]:
    """No hubs, then the landmarks seen over more than 1/2, 1/8, 1/32, ... of the poses."""
    hubs = np.empty(0, np.int64)
    yield hubs
    spans, limit = _spans(problem), problem.poses // 2
    while limit > TILE:
        before, hubs = hubs, np.flatnonzero(spans > limit)
        if len(hubs) > len(before):
            yield hubs
        limit //= 4


def _spans(problem: Problem) -> np.ndarray:
    """(N,) from how many poses before its last observation each landmark was seen first."""
    moving = problem.seen_from < problem.poses
    seen_from, landmarks = problem.seen_from[moving], problem.landmarks[moving]
    first = np.full(len(problem.ids), problem.poses)
    last = np.full(len(problem.ids), -1)
    np.minimum.at(first, landmarks, seen_from)
    np.maximum.at(last, landmarks, seen_from)
    return last - first


def _cost(problem: Problem, envelope: Envelope) -> float:
    """Multiplications of one factorisation, and of the sums before it."""
    counts = np.diff(problem.starts)
    counts[envelope.hubs] = 0
    return envelope.multiplications + PAIR * np.sum(counts * (counts + 1) / 2)
