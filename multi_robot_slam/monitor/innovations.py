"""Are a robot's innovations as large as they should be? Their D is chi2 with three degrees.

Cut at the gate D_0, beyond which nothing is matched, D has the density of chi2 over its share below
D_0. If all standard deviations were q times as large, D / q^2 would be chi2: with

    Z(q) = q^3 F3(D_0 / q^2),   F3 the distribution function of chi2 with three degrees,

the likelihood ratio of q_1 to q_0 is exp(D (1 / q_0^2 - 1 / q_1^2) / 2) Z(q_0) / Z(q_1). Its mean
is 1 at q_0 and less below. The observations of a frame share the error of their pose, so they do
not count as many: exp of the mean is at most the mean of exp, so the mean D of a frame, used for
all of it, gives an e-value whatever they have in common.
"""

import math
from collections import deque

import numpy as np
from scipy.special import gammainc

from multi_robot_slam.monitor.evidence import Evidence
from multi_robot_slam.monitor.predictions import Predictions

TOLERATED = 1.25
"""q_0: with standard deviations so much too small, regions of 95 % still hold 85 % of the truth."""

WORTH_TELLING = 2.0
"""q_1: then it holds 53 %, and a gate of 99 % turns away four right matches in ten."""

FACTORS = np.geomspace(0.1, 10, 100)
"""Of which the mean is tabulated."""

WINDOW = 40
"""Frames over which the mean D is told."""


def density_factor(q: float, gate: float) -> float:
    """Z(q)."""
    return q**3 * float(gammainc(1.5, gate / (2 * q * q)))


def mean_below(q: float, gate: float) -> float:
    """Mean of the D below the gate where standard deviations are q times what was told."""
    half = gate / (2 * q * q)
    return float(3 * q * q * gammainc(2.5, half) / gammainc(1.5, half))


class Innovations:
    """Those of one robot.

    Parameters
    ----------
    gate : D_0.

    """

    def __init__(self, gate: float) -> None:
        self.evidence = Evidence()
        self._gate = gate
        self._slope = 0.5 * (TOLERATED**-2 - WORTH_TELLING**-2)
        ratio = density_factor(TOLERATED, gate) / density_factor(WORTH_TELLING, gate)
        self._log_ratio = math.log(ratio)
        self._mean_of = [mean_below(q, gate) for q in FACTORS]
        self.pose = np.zeros(3)
        """(3,) where the robot was expected last, x, y [m], yaw [rad] in `map`."""
        self._means: deque[float] = deque(maxlen=WINDOW)

    def note(self, predicted: Predictions) -> None:
        """Take what was expected of one frame."""
        self.pose = predicted.pose
        nearest = predicted.nearest()
        inside = nearest[nearest <= self._gate]
        if len(inside):
            mean = float(inside.mean())
            self._means.append(mean)
            self.evidence.add(self.log_e_value(mean))

    def log_e_value(self, mean: float) -> float:
        """The logarithm of the e-value of a frame with this `mean` D below the gate."""
        return self._slope * mean + self._log_ratio

    @property
    def mean(self) -> float:
        """Mean D of the last frames, 3 at most where nothing is known."""
        return sum(self._means) / len(self._means) if self._means else mean_below(1.0, self._gate)

    @property
    def factor(self) -> float:
        """How many times as large as told standard deviations are, by the last frames."""
        return float(np.interp(self.mean, self._mean_of, FACTORS))
