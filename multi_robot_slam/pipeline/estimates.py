"""What the filter's state knows: the map, and every robot's path."""

from collections.abc import Iterable, Sequence

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
    observations, robots = _seen(list(state.history.lineage(best)), ids.max(initial=-1) + 1)
    return LandmarkMap(
        ids=ids.astype(np.uint32),
        positions=values[:, :3].astype(np.float32),
        covariances=values[:, 3:].astype(np.float32),
        observations=observations[ids],
        robots=robots[ids],
        descriptors=landmarks.descriptors[columns],
    )


def _seen(past: Sequence[tuple[Record, int]], landmarks: int) -> tuple[np.ndarray, np.ndarray]:
    """How often each of so many landmarks was observed in a past, and by which robots, as bits."""
    if not past:
        return np.zeros(landmarks, np.uint32), np.zeros(landmarks, np.uint32)
    matches = [record.matches[:, row] for record, row in past]
    by_robot = np.repeat([record.robot for record, _ in past], [len(ids) for ids in matches])
    ids = np.concatenate(matches)
    observations = np.bincount(ids, minlength=landmarks)
    robots = np.zeros(len(observations), np.uint32)
    for robot in np.unique(by_robot).tolist():
        robots[ids[by_robot == robot]] |= np.uint32(1 << robot)
    return observations.astype(np.uint32), robots


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
