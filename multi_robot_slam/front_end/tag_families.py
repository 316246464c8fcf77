"""Families of tags that are found, and the descriptor that stands for a tag's number."""

from typing import NamedTuple

import numpy as np

from msg_defs.types import DESCRIPTOR_SIZE


class Family(NamedTuple):
    """A set of patterns, one a number."""

    dictionary: str
    """Name of OpenCV's."""
    numbers: int
    """Patterns in it, numbered from 0."""


_APRILTAGS = {"16h5": 30, "25h9": 35, "36h10": 2320, "36h11": 587}

FAMILIES = (
    {name: Family(f"DICT_APRILTAG_{name}", count) for name, count in _APRILTAGS.items()}
    | {
        f"{n}x{n}_{count}": Family(f"DICT_{n}X{n}_{count}", count)
        for n in (4, 5, 6, 7)
        for count in (50, 100, 250, 1000)
    }
    | {
        "original": Family("DICT_ARUCO_ORIGINAL", 1024),
        "mip_36h12": Family("DICT_ARUCO_MIP_36h12", 250),
    }
)
"""By the name in the settings: AprilTag's, ArUco's by cells and patterns, and two older ones."""

_PRIME = 11
_DIGITS = 4


def descriptors(numbers: np.ndarray) -> np.ndarray:
    """(T, 128) float32 of unit norm for tags of these numbers (T,), below 11^4.

    A number's four digits to the base 11 are the coefficients of a polynomial over the integers
    modulo 11. Its values at 0 to 10 say which of 11 elements, in 11 groups of as many, are
    -1 / sqrt(11); the others are 0. Polynomials of degree k agree at k points at most, so that
    E (19) of two numbers is 0 if they are equal and else 2 - 2 k / 11 at least: 18 / 11 below
    number 1331, 16 / 11 above. SIFT has no negative elements, so E of a tag and any SIFT
    descriptor of unit norm is 2 at least.
    """
    at = np.arange(_PRIME)
    digits = np.asarray(numbers)[:, None] // _PRIME ** np.arange(_DIGITS) % _PRIME
    values = digits @ at ** np.arange(_DIGITS)[:, None] % _PRIME
    result = np.zeros((len(digits), DESCRIPTOR_SIZE), np.float32)
    np.put_along_axis(result, _PRIME * at + values, np.float32(-(_PRIME**-0.5)), axis=1)
    return result
