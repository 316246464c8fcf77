"""What smoothing found of a robot's noise and of its odometry's factors, where it is beyond doubt.

With r degrees of freedom behind a factor f on standard deviations, r f^2 / q^2 is chi2 with r of
them where the true factor is q. What is told is larger than q = `TOLERATED`, or less than 1 / q,
with a probability of `IMPROBABLE` at most.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import chdtr, chdtrc, ndtri

from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.filter.state import State
from multi_robot_slam.monitor.evidence import LOG_ALARM
from multi_robot_slam.monitor.innovations import TOLERATED

IMPROBABLE = float(np.exp(-LOG_ALARM))
"""The same one in ten million as of all other evidence; there are some tens of rejuvenations."""

SIGMAS = float(-ndtri(IMPROBABLE / 2))
"""Of a normal distribution: 5.3."""

WORTH_TELLING = 0.01
"""Of a factor on distances or turns: by default (7) errs as much in the first four metres."""

LEAST_FREEDOM = 50
"""Degrees of freedom after which the noise of odometry is known to a tenth, and its factors are
judged by it."""

KINDS = ("odometry", "observations")
WAYS = ("distance", "turn")


class Found(NamedTuple):
    """What there is to say of one robot; empty where there is nothing."""

    cause: str
    remedy: str
    is_wrong: bool
    """It is noisier than told, or off; otherwise less noisy."""
    numbers: dict[str, float]
    factor: float
    """How many times as large as used its standard deviations may be, at least 1."""


def found(state: State, robot: int, name: str, settings: FilterSettings) -> Found:
    """What is known of the robot by the last rejuvenation."""
    factors, freedoms = state.noise.factors[robot], state.noise.redundancies[robot]
    ways, sigmas = state.bias.factors[robot], state.bias.sigmas[robot]
    numbers = {
        **{f"factor on the noise of {k}": float(f) for k, f in zip(KINDS, factors, strict=True)},
        **{f"degrees of freedom of {k}": float(r) for k, r in zip(KINDS, freedoms, strict=True)},
        **{f"factor on each {w}": float(f) for w, f in zip(WAYS, ways, strict=True)},
        **{f"sigma of the factor on each {w}": float(s) for w, s in zip(WAYS, sigmas, strict=True)},
    }
    wrong = [
        *_biased(ways, sigmas, factors[0], freedoms[0], settings.motion.scale_sigma > 0),
        *_noisier(factors, freedoms, settings.learn_noise),
    ]
    causes, remedies = zip(*(wrong or _quieter(factors, freedoms) or [("", "")]), strict=True)
    cause = " and ".join(causes)
    told = f"of {name} {cause}" if cause else ""
    factor = max(1.0, *(factors / state.noise.used[robot]).tolist()) if wrong else 1.0
    return Found(told, "; ".join(remedies), bool(wrong), numbers, factor)


def _noisier(factors: np.ndarray, freedoms: np.ndarray, is_used: bool) -> list[tuple[str, str]]:
    remedies = (
        "raise the standard deviations of filter.motion by that factor",
        "publish observations with covariances larger by its square",
    )
    known = "; the filter goes by it already, as learn_noise is on" if is_used else ""
    return [
        (f"{kind} are {factor:.1f} times as noisy as told" if kind == KINDS[1]
         else f"{kind} is {factor:.1f} times as noisy as told", remedy + known)
        for kind, factor, freedom, remedy in zip(KINDS, factors, freedoms, remedies, strict=True)
        if freedom > 0 and chdtrc(freedom, freedom * (factor / TOLERATED) ** 2) < IMPROBABLE
    ]  # fmt: skip


def _quieter(factors: np.ndarray, freedoms: np.ndarray) -> list[tuple[str, str]]:
    return [
        (f"the noise of {kind} is {factor:.2f} times what was told", "")
        for kind, factor, freedom in zip(KINDS, factors, freedoms, strict=True)
        if freedom > 0 and chdtr(freedom, freedom * (factor * TOLERATED) ** 2) < IMPROBABLE
    ]


def _biased(
    ways: np.ndarray, sigmas: np.ndarray, noise: float, freedom: float, is_used: bool
) -> list[tuple[str, str]]:
    """Of an odometry that is `noise` times as noisy as told the sigmas are larger as well."""
    if freedom < LEAST_FREEDOM:
        return []
    remedy = (
        "the filter goes by it already, as scale_sigma is set"
        if is_used
        else "calibrate the odometry, or set filter.motion.scale_sigma to as much as it is off"
    )
    return [
        (f"each {way} is {factor:.3f} times what its odometry tells", remedy)
        for way, factor, sigma in zip(WAYS, ways, sigmas, strict=True)
        if abs(factor - 1) > WORTH_TELLING + SIGMAS * sigma * max(noise, 1)
    ]
