"""Smoothing of a whole run: the filter's answer refined, and the yardstick it is held to."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from msg_defs.types import LandmarkMap, Trajectory
from multi_robot_slam.config import Config
from multi_robot_slam.models.frames import Record
from multi_robot_slam.models.motion import wrap
from multi_robot_slam.models.parallel import one_thread
from multi_robot_slam.models.symmetric import pack
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs import Run
from multi_robot_slam.smoothing import joining, marginals, noise_factors, solve
from multi_robot_slam.smoothing.aliases import Aliases
from multi_robot_slam.smoothing.known_distance import covariances_of
from multi_robot_slam.smoothing.noise_factors import NoiseFactors
from multi_robot_slam.smoothing.odometry_scale import Scales, learn
from multi_robot_slam.smoothing.prior import Prior
from multi_robot_slam.smoothing.problem import Problem, problem_of
from multi_robot_slam.smoothing.solve import Smoothed, SmoothingError

Lineage = Sequence[tuple[Record, int]]
"""The past of one particle, oldest first: its row in each record (`Pipeline.lineage`)."""

Team = Sequence[int] | None
"""Which robot of the team each one is; None: nobody was lost."""

MAX_FRAMES = 20_000
"""Smoothing this many took 10 s and 1.2 GB in simulated tours; both grow with the square."""

AT_A_TIME = 64
"""Landmarks whose deviations are in memory together; each is as long as all paths."""

SMALLEST_CHANGE = 1e-4
"""Change of the odometry's factors below which paths and factors are done: 1 mm in 10 m."""
NOISE_CHANGE = 0.01
"""The same of the factors of noise, relative: they are known to a hundredth at best."""
MOST_ROUNDS = 20
"""Times that paths and factors are estimated in turn; a usual run needs four."""


@dataclass(frozen=True, eq=False)
class Refined:
    """The most likely paths and map, given the best particle's data association."""

    paths: dict[str, Trajectory]
    landmarks: LandmarkMap
    """With marginal covariances; a landmark the filter had split keeps the oldest of its ids."""


class Learnt(NamedTuple):
    """What the paths tell of the odometry and of the noise."""

    scales: Scales
    noise: NoiseFactors

    @classmethod
    def nothing(cls, config: Config, robots: int) -> "Learnt":
        """As configured."""
        scales = Scales.unknown(robots, config.filter.motion.scale_sigma)
        return cls(scales, NoiseFactors.as_told(robots))

    def is_near(self, before: "Learnt") -> bool:
        """Whether the paths would be the same with what was learnt `before`."""
        scales = np.abs(self.scales.factors - before.scales.factors).max()
        noise = np.abs(self.noise.used / before.noise.used - 1).max()
        return bool(scales < SMALLEST_CHANGE and noise < NOISE_CHANGE)


def complete(
    run: Run, pipeline: Pipeline, with_refined: bool = False, with_yardstick: bool = False
) -> Run:
    """The run with what only the filter's history tells.

    The mean of all particles' paths and, if wanted, the refined paths and map, and the yardstick.
    What smoothing cannot give is missing, with a warning.
    """
    run = run.with_paths(mean=pipeline.mean_trajectories())
    lineage = pipeline.lineage() if with_refined or with_yardstick else []
    if with_yardstick:
        run = measured(run, lineage, pipeline.team)
    if not with_refined:
        return run
    if len(lineage) > MAX_FRAMES:
        return _warned(run, f"not refined: {len(lineage)} frames, and {MAX_FRAMES} are the most")
    try:
        refined = refine(lineage, run.landmarks, run.config, pipeline.team)
    except SmoothingError as error:
        return _warned(run, f"not refined: {error}")
    run = run.with_paths(refined=refined.paths)
    return replace(run, refined_landmarks=refined.landmarks)


def measured(run: Run, lineage: Lineage, team: Team = None) -> Run:
    """The run with the yardstick, if all associations are known and the frames not too many.

    If it cannot be computed, a warning says why.
    """
    if len(lineage) > MAX_FRAMES:
        return run
    try:
        paths = yardstick(lineage, run.observation_truth, run.config, team)
    except SmoothingError as error:
        return _warned(run, f"no yardstick: {error}")
    return run if paths is None else run.with_paths(yardstick=paths)


def _warned(run: Run, warning: str) -> Run:
    return replace(run, warnings=(*run.warnings, warning))


@one_thread
def refine(lineage: Lineage, landmarks: LandmarkMap, config: Config, team: Team = None) -> Refined:
    """Smooth over the best particle's associations, robustly, and join landmarks it had split.

    Smooth, with the factors of the odometry if those are in doubt; join (`joining`); repeat until
    no landmarks join. `SmoothingError` if there is no optimum.

    Parameters
    ----------
    lineage : the best particle's past; `landmarks` : its map (`Pipeline.landmark_map`).
    team : which robot each one in it is (`Pipeline.team`).

    """
    if not lineage:
        return Refined({}, landmarks)
    records = [record for record, _ in lineage]
    poses = np.array([record.poses[:, row] for record, row in lineage])
    seen = [record.matches[:, row] for record, row in lineage]
    settings, team = config.filter, _all(config) if team is None else team
    learnt = Learnt.nothing(config, len(team))
    alike = landmarks.ids[joining.alike(landmarks.descriptors, settings.descriptor_gate)]
    alike = alike.astype(np.int64)

    def smoothed_with(aliases: Aliases, poses: np.ndarray) -> tuple[Problem, Smoothed]:
        nonlocal learnt
        identities = [aliases.of(ids) for ids in seen]
        problem, smoothed, learnt = _smooth(
            records, identities, poses, learnt, settings.robust_above, config, team
        )
        return problem, smoothed

    problem, smoothed, _ = joining.smooth_and_join(
        smoothed_with,
        poses,
        alike,
        settings.gate,
        settings.exclusive,
        settings.correlated,
    )
    paths = _trajectories(records, smoothed.of_records, config, team)
    return Refined(paths, _map(problem, smoothed, landmarks, team))


@one_thread
def yardstick(
    lineage: Lineage,
    truth: Mapping[tuple[str, int], np.ndarray],
    config: Config,
    team: Team = None,
) -> dict[str, Trajectory] | None:
    """The best answer there is: paths by least squares with the true associations.

    Gross errors, as real recordings have them, count less: observations whose D is larger than
    any of the run's should be. Without gross errors this is plain least squares.

    Parameters
    ----------
    lineage : any particle's past; the search starts from its path.
    truth : (robot, stamp_ns) -> (B,) true landmark of each observation; where that of one frame
        is missing there is no yardstick, nor where a robot was lost and what it saw was forgotten.
    team : as of `refine`.

    `SmoothingError` if there is no optimum.

    """
    records = [record for record, _ in lineage]
    team = _all(config) if team is None else team
    keys = [(config.robots[team[record.robot]], record.stamp_ns) for record in records]
    identities = [np.asarray(truth.get(key, ())) for key in keys]
    known = [len(rows) == len(r.positions) for rows, r in zip(identities, records, strict=True)]
    if not records or not all(known):
        return None
    poses = np.array([record.poses[:, row] for record, row in lineage])
    certain = joining.widened_gate(config.filter.robust_above, sum(map(len, identities)))
    nothing = Learnt.nothing(config, len(team))
    _, smoothed, _ = _smooth(records, identities, poses, nothing, certain, config, team)
    return _trajectories(records, smoothed.of_records, config, team)


def _all(config: Config) -> Sequence[int]:
    """The team, nobody of which was ever lost."""
    return range(len(config.robots))


def _smooth(
    records: Sequence[Record],
    identities: list[np.ndarray],
    poses: np.ndarray,
    known: Learnt,
    robust_above: float,
    config: Config,
    team: Sequence[int],
) -> tuple[Problem, Smoothed, Learnt]:
    """The optimum of the paths and of what is learnt with them, from `poses` (P, 3) and `known`."""
    motion, prior = config.filter.motion, _prior(records, config.starts[list(team)])
    motions = np.array([record.motion for record in records])
    covariances, is_final = None, config.filter.noise_at == "measurement"
    for _ in range(MOST_ROUNDS):
        problem = problem_of(
            records,
            identities,
            prior,
            motion,
            known.scales.factors,
            covariances=covariances,
            noisier=known.noise.used,
        )
        smoothed = solve.smooth(problem, poses, robust_above)
        learnt = _learnt(known, problem, smoothed, motions, config)
        if is_final and learnt.is_near(known):
            break
        known, poses = learnt, smoothed.of_records
        if not is_final:
            places = smoothed.landmarks[:, :3]
            covariances = covariances_of(records, identities, poses, problem.ids, places)
            is_final = True
    return problem, smoothed, known


def _prior(records: Sequence[Record], starts: np.ndarray) -> Prior:
    """What was believed of each robot's start; where nothing was told it is at `starts` (K, 3)."""
    prior = Prior.exact(starts)
    for record in records:
        if record.start is not None:
            prior = prior.starting(record.robot, record.start)
    return prior


def _learnt(
    known: Learnt, problem: Problem, smoothed: Smoothed, motions: np.ndarray, config: Config
) -> Learnt:
    """One step from `known`, for which `smoothed` is the optimum."""
    scales, noise = learn(known.scales, problem, smoothed, motions, fixed=0.0), known.noise
    if config.filter.learn_noise:
        shares = noise_factors.shares_of(problem, smoothed)
        limit = min(config.filter.gate, config.filter.robust_above)
        noise = noise_factors.learn(noise, problem, smoothed, shares, 0, limit, is_used=True)
    return Learnt(scales, noise)


def _trajectories(
    records: Sequence[Record], poses: np.ndarray, config: Config, team: Sequence[int]
) -> dict[str, Trajectory]:
    robots = np.array([team[record.robot] for record in records])
    stamps = np.array([record.stamp_ns for record in records], np.int64)
    wrapped = np.column_stack([poses[:, :2], wrap(poses[:, 2])])
    return {
        config.robots[robot]: Trajectory(stamps[robots == robot], wrapped[robots == robot])
        for robot in np.unique(robots)
    }


def _map(
    problem: Problem, smoothed: Smoothed, landmarks: LandmarkMap, team: Sequence[int]
) -> LandmarkMap:
    """Of those that the filter's map still has: of others the descriptor is forgotten."""
    robots = np.zeros(len(problem.ids), np.uint32)
    np.bitwise_or.at(robots, problem.landmarks, _bits(problem, team))
    order = np.argsort(landmarks.ids)
    has = np.flatnonzero(np.isin(problem.ids, landmarks.ids))
    known = order[np.searchsorted(landmarks.ids[order], problem.ids[has])]
    return LandmarkMap(
        ids=landmarks.ids[known],
        positions=smoothed.landmarks[has, :3].astype(np.float32),
        covariances=_marginal_covariances(problem, smoothed)[has].astype(np.float32),
        observations=np.diff(problem.starts)[has].astype(np.uint32),
        robots=robots[has],
        descriptors=landmarks.descriptors[known],
    )


def _marginal_covariances(problem: Problem, smoothed: Smoothed) -> np.ndarray:
    """(N, 6) of the landmarks [m^2]."""
    covariances = smoothed.landmarks[:, 3:].copy()
    for start in range(0, len(covariances), AT_A_TIME):
        wanted = np.arange(start, min(start + AT_A_TIME, len(covariances)))
        deviations = marginals.landmark_deviations(problem, smoothed, wanted)
        covariances[wanted] += pack(deviations @ deviations.transpose(0, 2, 1))
    return covariances


def _bits(problem: Problem, team: Sequence[int]) -> np.ndarray:
    """(O,) the bit of the robot that made each observation."""
    return np.uint32(1) << np.array(team, np.uint32)[problem.robots[problem.seen_from]]
