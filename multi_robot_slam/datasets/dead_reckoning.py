"""Odometry from velocities: where a robot would be had it done what its wheels were told."""

import numpy as np

from multi_robot_slam.datasets.recording import Commands


def poses_at(commands: Commands, stamps_ns: np.ndarray) -> np.ndarray:
    """Poses (T, 3) x, y [m], yaw [rad] at `stamps_ns` (T,), from the origin at the first command.

    Each command holds until the next, the last for ever; before the first the robot stands. Along
    one command the robot drives an exact arc.
    """
    seconds = np.diff(commands.stamps_ns) * 1e-9
    yaw = np.concatenate([[0.0], np.cumsum(commands.yaw_rate[:-1] * seconds)])
    steps = _arc(yaw[:-1], commands.forward[:-1], commands.yaw_rate[:-1], seconds)
    places = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    last = np.maximum(np.searchsorted(commands.stamps_ns, stamps_ns, side="right") - 1, 0)
    since = np.maximum(stamps_ns - commands.stamps_ns[last], 0) * 1e-9
    forward, yaw_rate = commands.forward[last], commands.yaw_rate[last]
    ends = places[last] + _arc(yaw[last], forward, yaw_rate, since)
    return np.column_stack([ends, yaw[last] + yaw_rate * since])


def twists_at(commands: Commands, stamps_ns: np.ndarray) -> np.ndarray:
    """(T, 2) forward velocity [m/s] and yaw rate [rad/s] at `stamps_ns` (T,)."""
    last = np.searchsorted(commands.stamps_ns, stamps_ns, side="right") - 1
    held = np.column_stack([commands.forward, commands.yaw_rate])[np.maximum(last, 0)]
    return np.where(last[:, None] >= 0, held, 0.0)


def _arc(
    yaw: np.ndarray, forward: np.ndarray, yaw_rate: np.ndarray, seconds: np.ndarray
) -> np.ndarray:
    """(T, 2) displacement of a robot that starts at `yaw` and turns evenly: a chord of a circle."""
    half = yaw_rate * seconds / 2
    chord = forward * seconds * np.sinc(half / np.pi)
    return chord[:, None] * np.column_stack([np.cos(yaw + half), np.sin(yaw + half)])
