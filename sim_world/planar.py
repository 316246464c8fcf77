"""Planar poses (x [m], y [m], yaw [rad]) and movements between them."""

from typing import TypeVar

import numpy as np

Angle = TypeVar("Angle", float, np.ndarray)


def wrap(angle: Angle) -> Angle:
    """The same angle [rad] in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(3,) movement dx, dy, dyaw in the body frame of pose `first` that leads to `second`."""
    dx, dy, dyaw = second - first
    c, s = np.cos(first[2]), np.sin(first[2])
    return np.array([c * dx + s * dy, c * dy - s * dx, wrap(dyaw)])


def compose(pose: np.ndarray, movement: np.ndarray) -> np.ndarray:
    """(3,) pose reached from `pose` by `movement` (dx, dy, dyaw) in its body frame."""
    dx, dy, dyaw = movement
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([pose[0] + c * dx - s * dy, pose[1] + s * dx + c * dy, wrap(pose[2] + dyaw)])
