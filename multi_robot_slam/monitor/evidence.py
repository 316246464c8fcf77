"""Evidence against an assumption: a product that starts anew whenever it speaks for it.

An e-value is a number of at least 0 whose mean, given all before it, is 1 at most while the
assumption holds. The product of those since any moment exceeds A with a probability of 1 / A at
most; so the largest product over all moments at which it may have begun does so after T of them
with one of T / A at most (Lorden, *Procedures for reacting to a change in distribution*, 1971).
However errors within a frame depend on each other, that holds.
"""

import math
from typing import Final

LOG_ALARM: Final = math.log(1e7)
"""A: a team of three has 15 products and 150 frames each in 75 s, 2250 chances of one in A, which
makes one false alarm in 4,400 such runs."""

LOG_MOST: Final = LOG_ALARM / 2
"""No frame says more than that: one may be spoilt, so it takes two."""

LOG_CAP: Final = LOG_ALARM + math.log(10)
"""No more is kept, so that a few frames that agree again end an alarm."""

KAPPA: Final = 0.25
"""Small: what is improbable counts for much, and what is usual for little."""


class Evidence:
    """How much speaks against one assumption: the logarithm of the product, at least 0."""

    def __init__(self) -> None:
        self.log = 0.0

    @property
    def is_alarming(self) -> bool:
        """The assumption does not hold."""
        return self.log >= LOG_ALARM

    def end(self) -> None:
        """Hold nothing against it any more."""
        self.log = 0.0

    def add(self, log_e: float) -> None:
        """Take the logarithm of the e-value of one more frame."""
        self.log = min(max(self.log + min(log_e, LOG_MOST), 0.0), LOG_CAP)


def log_e_value(p: float) -> float:
    """The logarithm of kappa p^(kappa - 1), an e-value where p is a p-value.

    (Vovk, Wang, *E-values: calibration, combination and applications*, 2021.)
    """
    return math.log(KAPPA) + (KAPPA - 1) * math.log(max(p, 1e-300))
