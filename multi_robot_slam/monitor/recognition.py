"""Do known landmarks lie where they are known to lie?

Of each observation that looks like a landmark known before, D is asked of the oldest of these: what
lies outside the gate makes a landmark anew, and that is found where it was put. If the D of a frame
are chi2 with three degrees of freedom, whatever they have in common, then

    P(at least half of them exceed x) <= 2 P(chi2_3 > x)

by Markov's inequality, so twice the tail at their lower median is a p-value. Less than half of them
have no say: moved landmarks, points that look alike, random ones.
"""

import math
from collections import deque

import numpy as np

from multi_robot_slam.monitor.alignment import Alignment, align
from multi_robot_slam.monitor.evidence import Evidence, log_e_value
from multi_robot_slam.monitor.predictions import Predictions

LEAST = 6
"""Known landmarks that a frame must see to be asked. Of six, four must be wrong: that happens by
itself twice in 100,000 times where a landmark in thirty was moved."""

USUAL = 0.05
"""p from which on a frame agrees."""

REMEMBERED = 4
"""Frames whose pairs tell how far off it is."""


def tail(squared: float) -> float:
    """P(chi2 with three degrees of freedom > `squared`)."""
    root = math.sqrt(0.5 * squared)
    return math.erfc(root) + 2 / math.sqrt(math.pi) * root * math.exp(-0.5 * squared)


def p_value(seen: Predictions) -> float | None:
    """Of a frame's pairs, one for each observation; None where they are too few."""
    if len(seen.ids) < LEAST:
        return None
    squared = np.sort(seen.mahalanobis_sq)
    return min(1.0, 2 * tail(float(squared[(len(squared) - 1) // 2])))


class Recognition:
    """What one robot sees of what one robot, itself or another, has mapped.

    Parameters
    ----------
    gate : D_0.

    """

    def __init__(self, gate: float) -> None:
        self.evidence = Evidence()
        self.agreed = 0
        """Frames in which the landmarks lay where they should, and nothing was held against it."""
        self.outside = 0.0
        """Share of the landmarks of the last frame that was asked with D above the gate."""
        self._gate = gate
        self._offset: Alignment | None = None
        self._frames: deque[tuple[np.ndarray, np.ndarray, np.ndarray]] = deque(maxlen=REMEMBERED)

    def note(self, frame: Predictions, are_asked: np.ndarray) -> None:
        """Take those pairs of a frame (P,) with landmarks that are asked of."""
        if np.count_nonzero(are_asked) < LEAST:
            return
        seen = frame.only(are_asked).oldest()
        p = p_value(seen)
        if p is None:
            return
        self.evidence.add(log_e_value(p))
        self.outside = float(np.mean(seen.mahalanobis_sq > self._gate))
        if self.evidence.log == 0:
            self.agreed += p >= USUAL
            self._frames.clear()
            self._offset = None
        elif p < USUAL:
            self._frames.append(seen.in_map())
            if self.evidence.is_alarming:
                points, places, sigmas = map(np.concatenate, zip(*self._frames, strict=True))
                self._offset = align(points, places, sigmas)

    @property
    def offset(self) -> Alignment | None:
        """The motion in `map` that brings what is seen to where it is known to be.

        None where the landmarks lie where they should, or most of them do not agree on one motion:
        then they do not tell that the robot is elsewhere, but look like others.
        """
        return self._offset if self.evidence.is_alarming else None
