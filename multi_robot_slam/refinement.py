"""Batch smoothing of a whole run: the filter's answer refined, and the yardstick it is held to."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, chdtri

from msg_defs.types import LandmarkMap, Trajectory
from multi_robot_slam.config import Config
from multi_robot_slam.filter import smoothing, stereo
from multi_robot_slam.filter.association import squared_distances
from multi_robot_slam.filter.history import Record
from multi_robot_slam.filter.motion import wrap
from multi_robot_slam.filter.smoothing import Smoothed
from multi_robot_slam.filter.smoothing_problem import Problem, problem_of
from multi_robot_slam.pipeline import Pipeline
from multi_robot_slam.runs import Run

Lineage = Sequence[tuple[Record, int]]
"""The past of one particle, oldest first: its row in each record (`Pipeline.lineage`)."""

MAX_FRAMES = 5000
"""More would need over 2 GB, and minutes."""


@dataclass(frozen=True, eq=False)
class Refined:
    """The most likely paths and map, given what the best particle took for what."""

    paths: dict[str, Trajectory]
    landmarks: LandmarkMap
    """With marginal covariances; a landmark the filter had split keeps the oldest of its ids."""


def complete(run: Run, pipeline: Pipeline, with_refined: bool = False) -> Run:
    """The run with what only the filter's history tells.

    The mean of all particles' paths, the yardstick, and, if wanted, the refined paths and map.
    """
    lineage = pipeline.lineage()
    run = with_yardstick(run.with_paths(mean=pipeline.mean_trajectories()), lineage)
    if not with_refined:
        return run
    if len(lineage) > MAX_FRAMES:
        warning = f"not refined: {len(lineage)} frames, and {MAX_FRAMES} are the most"
        return replace(run, warnings=(*run.warnings, warning))
    refined = refine(lineage, run.landmarks, run.config)
    run = run.with_paths(refined=refined.paths)
    return replace(run, refined_landmarks=refined.landmarks)


def with_yardstick(run: Run, lineage: Lineage) -> Run:
    """The run with the yardstick, if all associations are known and the frames not too many."""
    batch = None
    if len(lineage) <= MAX_FRAMES:
        batch = yardstick(lineage, run.observation_truth, run.config)
    return run if batch is None else run.with_paths(batch=batch)


def refine(lineage: Lineage, landmarks: LandmarkMap, config: Config) -> Refined:
    """Smooth over the best particle's associations, robustly, and join landmarks it had split.

    A particle that misses a loop creates landmarks anew, and smoothing alone cannot know. So:
    smooth, join the pairs of landmarks that look alike (E <= E_0) and lie together (D, with the
    joint covariance that the smoothing gives them, inside `widened_gate`), repeat until none do.

    Parameters
    ----------
    lineage : the best particle's past; `landmarks` : its map (`Pipeline.landmark_map`).

    """
    if not lineage:
        return Refined({}, landmarks)
    records = [record for record, _ in lineage]
    poses = np.array([record.poses[:, row] for record, row in lineage])
    seen = [np.searchsorted(landmarks.ids, record.matches[:, row]) for record, row in lineage]
    alike = _alike(landmarks.descriptors, config.filter.descriptor_gate)
    owner = np.arange(len(landmarks.ids))
    while True:
        problem = _problem(records, [owner[rows] for rows in seen], config)
        smoothed = smoothing.smooth(problem, poses, robust_above=config.filter.robust_above)
        poses = smoothed.poses
        deviations = smoothing.landmark_deviations(problem, smoothed)
        pairs = np.searchsorted(problem.ids, _distinct(owner[alike]))
        joined = _together(problem, smoothed, deviations, pairs, config)
        if not len(joined):
            break
        heir = np.arange(len(owner))
        heir[problem.ids[joined[:, 1]]] = problem.ids[joined[:, 0]]
        owner = heir[owner]
    return Refined(
        _trajectories(records, poses, config),
        _map(problem, smoothed, deviations, landmarks),
    )


def widened_gate(gate: float, observations: int) -> float:
    """The gate (18) that all of a run's observations pass together as likely as one passes `gate`.

    The filter can afford to make a landmark anew for one true match in a hundred; what it costs is
    those hundredths, and here they are to be found.
    """
    return float(chdtri(3, chdtrc(3, gate) / max(observations, 1)))


def yardstick(
    lineage: Lineage, truth: Mapping[tuple[str, int], np.ndarray], config: Config
) -> dict[str, Trajectory] | None:
    """The best answer there is: paths by least squares with the true associations.

    Parameters
    ----------
    lineage : any particle's past; only where it starts the search from is its own.
    truth : (robot, stamp_ns) -> (B,) true landmark of each observation; with that of one frame
        missing there is no yardstick.

    """
    records = [record for record, _ in lineage]
    keys = [(config.robots[record.robot], record.stamp_ns) for record in records]
    identities = [truth.get(key, ()) for key in keys]
    known = [len(rows) == len(r.positions) for rows, r in zip(identities, records, strict=True)]
    if not records or not all(known):
        return None
    poses = np.array([record.poses[:, row] for record, row in lineage])
    problem = _problem(records, identities, config)
    return _trajectories(records, smoothing.smooth(problem, poses).poses, config)


def _problem(records: Sequence[Record], identities: list[np.ndarray], config: Config) -> Problem:
    starts = np.array(config.start_poses)
    return problem_of(records, identities, starts, config.filter.motion, config.mount)


def _alike(descriptors: np.ndarray, threshold: float) -> np.ndarray:
    """(A, 2) rows of descriptors with E <= `threshold`, the smaller row first."""
    distances = squared_distances(descriptors, descriptors)
    return np.argwhere(np.triu(distances <= threshold, k=1))


def _distinct(pairs: np.ndarray) -> np.ndarray:
    """Each pair (A, 2) of different members once, the smaller first."""
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    return pairs[pairs[:, 0] < pairs[:, 1]]


def _together(
    problem: Problem,
    smoothed: Smoothed,
    deviations: np.ndarray,
    pairs: np.ndarray,
    config: Config,
) -> np.ndarray:
    """The closest of `pairs` (A, 2) within the gate, each landmark in one pair at the most."""
    apart = smoothed.landmarks[pairs[:, 0], :3] - smoothed.landmarks[pairs[:, 1], :3]
    covariances = stereo.unpack(smoothed.landmarks[pairs, 3:].sum(axis=1))
    for pair, covariance in zip(pairs, covariances, strict=True):
        shared = deviations[pair[0]] - deviations[pair[1]]
        covariance += shared @ shared.T
    squared = np.einsum("ai,ai->a", apart, np.linalg.solve(covariances, apart[:, :, None])[:, :, 0])
    gate = widened_gate(config.filter.gate, len(problem.positions))
    chosen, taken = [], set()
    for row in np.argsort(squared, kind="stable"):
        pair = pairs[row]
        if squared[row] > gate:
            break
        if taken.isdisjoint(pair.tolist()) and not (
            config.filter.exclusive and _seen_together(problem, *pair)
        ):
            chosen.append(pair)
            taken.update(pair.tolist())
    return np.array(chosen, int).reshape(-1, 2)


def _seen_together(problem: Problem, one: int, other: int) -> bool:
    """Some frame has observations of both: they are two."""
    frames = [problem.seen_from[slice(*problem.starts[n : n + 2])] for n in (one, other)]
    return bool(len(np.intersect1d(*frames)))


def _trajectories(
    records: Sequence[Record], poses: np.ndarray, config: Config
) -> dict[str, Trajectory]:
    robots = np.array([record.robot for record in records])
    stamps = np.array([record.stamp_ns for record in records], np.int64)
    wrapped = np.column_stack([poses[:, :2], wrap(poses[:, 2])])
    return {
        config.robots[robot]: Trajectory(stamps[robots == robot], wrapped[robots == robot])
        for robot in np.unique(robots)
    }


def _map(
    problem: Problem, smoothed: Smoothed, deviations: np.ndarray, landmarks: LandmarkMap
) -> LandmarkMap:
    shared = stereo.pack(deviations @ deviations.transpose(0, 2, 1))
    robots = np.zeros(len(problem.ids), np.uint32)
    np.bitwise_or.at(robots, problem.landmarks, _bits(problem))
    return LandmarkMap(
        ids=landmarks.ids[problem.ids],
        positions=smoothed.landmarks[:, :3].astype(np.float32),
        covariances=(smoothed.landmarks[:, 3:] + shared).astype(np.float32),
        observations=np.diff(problem.starts).astype(np.uint32),
        robots=robots,
        descriptors=landmarks.descriptors[problem.ids],
    )


def _bits(problem: Problem) -> np.ndarray:
    """(O,) the bit of the robot that made each observation."""
    return np.uint32(1) << problem.robots[problem.seen_from].astype(np.uint32)
