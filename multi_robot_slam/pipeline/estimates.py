"""What the filter's state knows: the map, and every robot's path."""

from collections.abc import Iterable

import numpy as np

from msg_defs.types import LandmarkMap, Trajectory
from multi_robot_slam.config import Config
from multi_robot_slam.filter import rbpf, resampling
from multi_robot_slam.filter.state import State
from multi_robot_slam.models.frames import Record
from multi_robot_slam.models.motion import wrap


def landmark_map(state: State, config: Config) -> LandmarkMap:
    """The best particle's map (17); where it draws, what all make of its landmarks."""
    landmarks = state.landmarks
    best = rbpf.best_particle(state)
    columns, values = landmarks.of_particle(best)
    if config.publishes_mean:
        values = landmarks.mixture(columns, resampling.normalise(state.log_weights))
    ids = landmarks.ids[columns]
    observations = np.zeros(ids.max(initial=-1) + 1, np.uint32)
    robots = np.zeros_like(observations)
    for record, row in state.history.lineage(best):
        np.add.at(observations, record.matches[:, row], 1)
        np.bitwise_or.at(robots, record.matches[:, row], np.uint32(1 << record.robot))
    return LandmarkMap(
        ids=ids.astype(np.uint32),
        positions=values[:, :3].astype(np.float32),
        covariances=values[:, 3:].astype(np.float32),
        observations=observations[ids],
        robots=robots[ids],
        descriptors=landmarks.descriptors[columns],
    )


def lineage(state: State) -> list[tuple[Record, int]]:
    """The best particle's past, oldest first: its row in the record of each frame."""
    best = rbpf.best_particle(state)
    return list(state.history.lineage(best))[::-1]


def trajectories(state: State, config: Config) -> dict[str, Trajectory]:
    """The best particle's path of every robot that has moved or seen something."""
    poses = ((record, record.poses[:, row]) for record, row in lineage(state))
    return _by_robot(poses, config.robots)


def mean_trajectories(state: State, config: Config) -> dict[str, Trajectory]:
    """The weighted mean of all particles' whole paths, likewise."""
    weights = resampling.normalise(state.log_weights)
    means = [
        (record, record.poses @ np.bincount(rows, weights, len(record.parents)))
        for record, rows in state.history.lineage(slice(None))
    ]
    return _by_robot(reversed(means), config.robots)


def wrapped(poses: np.ndarray) -> np.ndarray:
    """Poses (..., 3) with the yaw in [-pi, pi)."""
    result = np.array(poses, float)
    result[..., 2] = wrap(result[..., 2])
    return result


def _by_robot(
    path: Iterable[tuple[Record, np.ndarray]], robots: tuple[str, ...]
) -> dict[str, Trajectory]:
    """Trajectories from the pose (3,) in each record, oldest first."""
    stamps: list[list[int]] = [[] for _ in robots]
    poses: list[list[np.ndarray]] = [[] for _ in robots]
    for record, pose in path:
        stamps[record.robot].append(record.stamp_ns)
        poses[record.robot].append(pose)
    return {
        robot: Trajectory(np.array(t, np.int64), wrapped(np.array(p)))
        for robot, t, p in zip(robots, stamps, poses, strict=True)
        if t
    }
