"""What the filter's state knows: the map, and every robot's path."""

from collections.abc import Sequence

import numpy as np

from msg_defs.types import LandmarkMap, Trajectory
from multi_robot_slam.config import Config
from multi_robot_slam.filter import rbpf, resampling
from multi_robot_slam.filter.pieces import MAP
from multi_robot_slam.filter.published import are_there
from multi_robot_slam.filter.state import State
from multi_robot_slam.models.frames import Record
from multi_robot_slam.models.motion import wrap


def landmark_map(state: State, config: Config) -> LandmarkMap:
    """The published map: what the best particle (17) has seen and is likely to be there.

    Where it draws, what all particles make of its landmarks. Which ones are there: `existence`.
    """
    landmarks = state.landmarks
    best = rbpf.best_particle(state)
    columns, values = landmarks.of_particle(best)
    is_in_map = landmarks.pieces[columns] == MAP
    columns, values = columns[is_in_map], values[is_in_map]
    lineage = _in_map(state, list(state.history.lineage(best))[::-1])
    if config.filter.existence.is_on:
        kept = are_there(state, lineage, columns, values, config.filter)
        columns, values = columns[kept], values[kept]
    return _map_of(state, config, columns, values, lineage)


def unplaced(state: State, config: Config) -> tuple[LandmarkMap, np.ndarray]:
    """What the best particle has seen in pieces whose place in `map` is not known.

    Each landmark in the frame of its piece, and the pieces (N,); whether it is there is not asked.
    """
    landmarks, best = state.landmarks, rbpf.best_particle(state)
    columns, values = landmarks.of_particle(best)
    is_apart = landmarks.pieces[columns] != MAP
    columns, values = columns[is_apart], values[is_apart]
    lineage = list(state.history.lineage(best))[::-1]
    return _map_of(state, config, columns, values, lineage), landmarks.pieces[columns]


def _map_of(
    state: State,
    config: Config,
    columns: np.ndarray,
    values: np.ndarray,
    lineage: Sequence[tuple[Record, int]],
) -> LandmarkMap:
    """Landmarks by their `columns` and the `values` (N, 9) of the particle with that `lineage`."""
    landmarks = state.landmarks
    if config.publishes_mean:
        values = landmarks.mixture(columns, resampling.normalise(state.log_weights))
    ids = landmarks.ids[columns]
    seen = state.history.settled.seen.also(
        [record for record, _ in lineage], [record.matches[:, row] for record, row in lineage]
    )
    observations, robots = seen.of_ids(ids)
    robots = state.pieces.bits_of_team(robots)
    return LandmarkMap(
        ids=ids.astype(np.uint32),
        positions=values[:, :3].astype(np.float32),
        covariances=values[:, 3:].astype(np.float32),
        observations=observations.astype(np.uint32),
        robots=robots.astype(np.uint32),
        descriptors=landmarks.descriptors[columns],
    )


def lineage(state: State) -> list[tuple[Record, int]]:
    """The best particle's past, oldest first: its row in the record of each frame.

    Of the robots whose place in `map` is known.
    """
    return _in_map(state, state.history.whole_lineage(rbpf.best_particle(state)))


def _in_map(state: State, lineage: list[tuple[Record, int]]) -> list[tuple[Record, int]]:
    """Without the frames of robots whose place in `map` is not known, and sightings of them."""
    pieces = state.pieces
    return [
        (pieces.within(record), row)
        for record, row in lineage
        if pieces.robots_in_map[record.robot]
    ]


def trajectories(state: State, config: Config) -> dict[str, Trajectory]:
    """The best particle's path of every robot; of settled frames the one they settled with."""
    lineage = state.history.lineage(rbpf.best_particle(state))
    return _by_robot(state, [(record, record.poses[:, row]) for record, row in lineage], config)


def mean_trajectories(state: State, config: Config) -> dict[str, Trajectory]:
    """The weighted mean of all particles' paths, likewise."""
    weights = resampling.normalise(state.log_weights)
    means = [
        (record, record.poses @ np.bincount(rows, weights, len(record.parents)))
        for record, rows in state.history.lineage(slice(None))
    ]
    return _by_robot(state, means, config)


def wrapped(poses: np.ndarray) -> np.ndarray:
    """Poses (..., 3) with the yaw in [-pi, pi)."""
    result = np.array(poses, float)
    result[..., 2] = wrap(result[..., 2])
    return result


def _by_robot(
    state: State, path: Sequence[tuple[Record, np.ndarray]], config: Config
) -> dict[str, Trajectory]:
    """Trajectories: settled poses, then the pose (3,) in each record, newest first.

    Of the robots whose place in `map` is known.
    """
    pieces, result = state.pieces, {}
    for robot, name in enumerate(config.robots):
        stamps, poses = [np.empty(0, np.int64)], [np.empty((0, 3))]
        for index in np.flatnonzero((pieces.team == robot) & pieces.robots_in_map).tolist():
            before = state.history.settled.path(index)
            own = [(r.stamp_ns, pose) for r, pose in reversed(path) if r.robot == index]
            stamps += [before[0], np.array([stamp for stamp, _ in own], np.int64)]
            poses += [before[1], np.array([pose for _, pose in own]).reshape(-1, 3)]
        if sum(map(len, stamps)):
            result[name] = Trajectory(np.concatenate(stamps), wrapped(np.concatenate(poses)))
    return result
