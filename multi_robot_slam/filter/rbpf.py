"""Algorithm 1: one particle set over the poses of K robots, each with a map of small EKFs."""

from typing import NamedTuple

import numpy as np

from msg_defs.types import DESCRIPTOR_SIZE
from multi_robot_slam.filter import (
    association,
    informed,
    kernels,
    rejuvenation,
    resampling,
    sightings,
)
from multi_robot_slam.filter.history import History
from multi_robot_slam.filter.landmarks import Landmarks
from multi_robot_slam.filter.rejuvenation import Rejuvenated
from multi_robot_slam.filter.settings import FilterSettings, threads
from multi_robot_slam.filter.state import State, resample
from multi_robot_slam.models import motion, parallel
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.smoothing.odometry_scale import Scales, scaled

MANY_SIGMA = 10.0
"""No belief moves a pose further from its prediction."""


class FrameInfo(NamedTuple):
    """What each particle made of one robot's frame, before resampling."""

    matches: np.ndarray
    """(B, M) int32: id of the landmark that was updated or created."""
    squared: np.ndarray
    """(B, M): D (18)."""
    log_likelihood: np.ndarray
    """(M,) float64: sum of the logarithms of (16) and of the sightings' factors."""
    new_ids: np.ndarray
    """(B,) int32: id of the landmark that each observation would create."""
    candidates: association.Candidates
    candidate_ids: np.ndarray
    """(C,) int32: id of each candidate."""
    sighted: sightings.Sighted

    def descriptor_distances(self, matches: np.ndarray) -> np.ndarray:
        """E (19) of B `matches` (ids), (B,) float32; NaN where a match was no candidate."""
        observation = np.repeat(np.arange(len(matches)), np.diff(self.candidates.starts))
        chosen = self.candidate_ids == matches[observation]
        result = np.full(len(matches), np.nan, np.float32)
        result[observation[chosen]] = self.candidates.distances[chosen]
        return result


class StepInfo(NamedTuple):
    """What an observer of a step wants to know."""

    frames: tuple[FrameInfo, ...]
    effective_particles: float
    moments: tuple[tuple[np.ndarray, np.ndarray], ...]
    """For each frame the weighted mean (3,) and covariance (3, 3) of its robot's pose.

    Before resampling, which would only add noise, but after rejuvenation.
    """
    ancestors: np.ndarray | None
    """(M,) int32: the particle before resampling that each continues; None: not resampled."""
    rejuvenated: Rejuvenated | None


def init(start_poses: np.ndarray, settings: FilterSettings, dtype: type = np.float32) -> State:
    """All particles at `start_poses` (K, 3): x, y [m], yaw [rad] in `map`; an empty map."""
    count = settings.particles
    start_poses = np.asarray(start_poses, float)
    return State(
        start_poses=start_poses,
        poses=np.repeat(start_poses[:, :, None], count, axis=2),
        landmarks=Landmarks(count, dtype),
        log_weights=np.zeros(count),
        log_weight_sum=np.zeros(count),
        history=History(count),
        scales=Scales.unknown(len(start_poses), settings.motion.scale_sigma),
    )


def step(
    state: State,
    frames: list[RobotFrame],
    settings: FilterSettings,
    rng: np.random.Generator,
) -> StepInfo:
    """One pass of Algorithm 1's loop, lines 5-10, over the frames of one instant.

    `ValueError` when a robot sees one that has no frame among them.
    """
    infos = PROPOSALS[settings.proposal](state, frames, settings, rng)  # (7)-(13), (18), (19)
    for frame, info in zip(frames, infos, strict=True):
        state.log_weights += info.log_likelihood  # (16)
        state.log_weight_sum += info.log_likelihood  # (17)
        state.history.append(
            frame,
            state.steps,
            state.poses[frame.robot],
            info.matches,
            info.new_ids,
        )
    weights = resampling.normalise(state.log_weights)
    effective = resampling.effective_sample_size(weights)
    around = tuple(moments(state.poses[frame.robot], weights) for frame in frames)
    state.steps += 1
    ancestors = rejuvenated = None
    if effective <= settings.resample_below * len(weights):
        ancestors = resampling.systematic(weights, rng.random())
        resample(state, ancestors)
    if rejuvenation.is_due(state, settings.rejuvenation):
        rejuvenated = rejuvenation.rejuvenate(state, settings, rng)
        ancestors = rejuvenated.ancestors if ancestors is None else ancestors[rejuvenated.ancestors]
        weights = resampling.normalise(state.log_weights)
        around = tuple(moments(state.poses[frame.robot], weights) for frame in frames)
    return StepInfo(tuple(infos), effective, around, ancestors, rejuvenated)


def propose_by_motion(
    state: State,
    frames: list[RobotFrame],
    settings: FilterSettings,
    rng: np.random.Generator,
) -> list[FrameInfo]:
    """Algorithm 1, lines 14-39: draw the poses from the motion model (7), then match and update."""
    for frame in frames:
        poses = state.poses[frame.robot]
        sigma = motion.standard_deviations(frame.motion, frame.seconds, settings.motion)
        noise = sigma[:, None] * rng.standard_normal(poses.shape)
        motion.move(poses, scaled(frame.motion, state.scales.factors[frame.robot])[:, None] + noise)
    certain = np.zeros((len(frames), 6, settings.particles))
    _, sighted = _look_at_each_other(state, frames, certain, settings)
    return [
        _update_as_drawn(state, frame, settings, seen)
        for frame, seen in zip(frames, sighted, strict=True)
    ]


def _update_as_drawn(
    state: State,
    frame: RobotFrame,
    settings: FilterSettings,
    sighted: sightings.Sighted,
) -> FrameInfo:
    """Match, update and weigh as seen from the drawn poses."""
    poses = state.poses[frame.robot]
    work = _open(state, frame, settings, doubt=np.zeros(2))
    parallel.over_particles(
        kernels.associate_and_update,
        settings.particles,
        threads(settings),
        state.landmarks.planes,
        work.candidates.starts,
        work.candidates.columns,
        work.new_columns,
        _as_seen(poses, work.v.dtype),
        work.v,
        work.noise,
        work.v.dtype.type(settings.gate),
        settings.exclusive,
        work.matches,
        work.squared,
        work.determinants,
    )
    return _close(state, frame, settings, work, sighted)


def propose_informed(
    state: State,
    frames: list[RobotFrame],
    settings: FilterSettings,
    rng: np.random.Generator,
) -> list[FrameInfo]:
    """Match first, then draw each pose from what motion, sightings and matches say, then update."""
    priors = np.empty((len(frames), 6, settings.particles), state.landmarks.planes.dtype)
    for frame, prior in zip(frames, priors, strict=True):
        poses = state.poses[frame.robot]
        motion.move(poses, scaled(frame.motion, state.scales.factors[frame.robot])[:, None])
        spread = motion.spread(frame.motion, frame.seconds, settings.motion).astype(prior.dtype)
        informed.spread_in_map(_as_seen(poses, prior.dtype), spread, prior)
    joint, sighted = _look_at_each_other(state, frames, priors, settings)
    infos = []
    for frame, prior, seen in zip(frames, priors, sighted, strict=True):
        if joint is not None:
            state.poses[frame.robot], prior[:] = joint.of(frame.robot)
        infos.append(_match_and_draw(state, frame, prior, settings, rng, seen))
        if joint is not None:
            joint.fix(frame.robot, state.poses[frame.robot])
    return infos


def _match_and_draw(
    state: State,
    frame: RobotFrame,
    prior: np.ndarray,
    settings: FilterSettings,
    rng: np.random.Generator,
    sighted: sightings.Sighted,
) -> FrameInfo:
    """Match, draw the pose from the `prior` (6, M) and what was matched, update and weigh."""
    poses = state.poses[frame.robot]
    variances = [(prior[0] + prior[3]).max(), prior[5].max()]
    work = _open(state, frame, settings, doubt=MANY_SIGMA * np.sqrt(variances))
    beliefs = np.empty((9, settings.particles), work.v.dtype)
    gate = work.v.dtype.type(settings.gate)
    parallel.over_particles(
        informed.associate_and_believe,
        settings.particles,
        threads(settings),
        state.landmarks.planes,
        work.candidates.starts,
        work.candidates.columns,
        _as_seen(poses, work.v.dtype),
        prior,
        work.v,
        work.noise,
        gate,
        settings.exclusive,
        beliefs,
        work.matches,
        work.squared,
        work.determinants,
    )
    informed.draw(poses, beliefs, rng.standard_normal(poses.shape))
    parallel.over_particles(
        informed.update_matched,
        settings.particles,
        threads(settings),
        state.landmarks.planes,
        work.candidates.starts,
        work.candidates.columns,
        work.new_columns,
        _as_seen(poses, work.v.dtype),
        work.v,
        work.noise,
        gate,
        work.matches,
        work.squared,
        work.determinants,
    )
    return _close(state, frame, settings, work, sighted)


PROPOSALS = {"motion": propose_by_motion, "informed": propose_informed}


def _look_at_each_other(
    state: State,
    frames: list[RobotFrame],
    priors: np.ndarray,
    settings: FilterSettings,
) -> tuple[sightings.JointBelief | None, list[sightings.Sighted]]:
    """The joint belief after all sightings, None without any; what each frame's were worth."""
    if not any(len(frame.sightings.others) for frame in frames):
        nothing = sightings.Sighted.nothing(settings.particles)
        return None, [nothing] * len(frames)
    robots = [frame.robot for frame in frames]
    joint = sightings.JointBelief(robots, state.poses[robots], priors.astype(float))
    sighted = [joint.see(frame.robot, frame.sightings, settings.sighting_gate) for frame in frames]
    return joint, sighted


class _Work(NamedTuple):
    """Inputs and outputs of the kernels for one frame, in the dtype of the planes."""

    v: np.ndarray
    noise: np.ndarray
    candidates: association.Candidates
    touched: np.ndarray
    """Landmark columns among the candidates, each once."""
    new_columns: np.ndarray
    new_ids: np.ndarray
    matches: np.ndarray
    squared: np.ndarray
    determinants: np.ndarray


def _open(
    state: State,
    frame: RobotFrame,
    settings: FilterSettings,
    doubt: np.ndarray,
) -> _Work:
    """Find the candidates (18), (19) of a frame and bring them up to date.

    `doubt` (2,): how far each pose may still move [m] and turn [rad] before the gate is tried.
    """
    landmarks = state.landmarks
    v, noise = frame.positions, frame.covariances
    count, dtype = len(v), landmarks.planes.dtype
    near = np.empty(0, int)
    if count:
        poses = state.poses[frame.robot]
        near = landmarks.near(association.field_of_search(poses, v, noise, settings.gate, doubt))
    candidates = association.find_candidates(
        frame.descriptors, landmarks.descriptors[near], near, settings.descriptor_gate
    )
    touched = np.unique(candidates.columns[candidates.columns >= 0])
    landmarks.bring_up_to_date(touched, threads(settings))
    new_columns = landmarks.reserve(count)
    return _Work(
        v.astype(dtype),
        noise.astype(dtype),
        candidates,
        touched,
        new_columns,
        landmarks.ids[new_columns],
        np.empty((count, settings.particles), np.int32),
        np.empty((count, settings.particles), dtype),
        np.empty((count, settings.particles), dtype),
    )


def _close(
    state: State,
    frame: RobotFrame,
    settings: FilterSettings,
    work: _Work,
    sighted: sightings.Sighted,
) -> FrameInfo:
    """Keep the landmarks that were created, and weigh (16)."""
    landmarks = state.landmarks
    ids = landmarks.ids[work.matches]
    candidate_ids = landmarks.ids[_columns(work.candidates.columns, work.new_columns)]
    created = kernels.complete_new(landmarks.planes, work.new_columns, work.matches)
    landmarks.bound(work.touched, settings.gate)
    landmarks.bound(work.new_columns[created > 0], settings.gate)
    landmarks.settle(work.new_columns, created, frame.descriptors)
    return FrameInfo(
        ids,
        work.squared,
        kernels.log_likelihood(work.squared, work.determinants) + sighted.log_factor,
        work.new_ids,
        work.candidates,
        candidate_ids,
        sighted,
    )


def _columns(candidates: np.ndarray, new_columns: np.ndarray) -> np.ndarray:
    """The column each candidate stands for, see `association.Candidates`."""
    columns = candidates.copy()
    columns[candidates < 0] = new_columns[-1 - candidates[candidates < 0]]
    return columns


def _as_seen(poses: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """(4, M) cos yaw, sin yaw, x, y of `poses` (3, M)."""
    seen = np.empty((4, poses.shape[1]), dtype)
    yaw = poses[2].astype(dtype)
    np.cos(yaw, out=seen[0])
    np.sin(yaw, out=seen[1])
    seen[2:] = poses[:2]
    return seen


def best_particle(state: State) -> int:
    """The particle with the largest sum of log weights (17)."""
    return int(np.argmax(state.log_weight_sum))


def moments(poses: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (3,) and covariance (3, 3) of `poses` (3, M) under normalised `weights` (M,)."""
    mean = poses @ weights
    deviations = poses - mean[:, None]
    return mean, (weights * deviations) @ deviations.T


def warm_up(settings: FilterSettings) -> None:
    """Compile every kernel or load it from the cache: steps of two robots that see two points."""
    rng = np.random.default_rng(0)
    state = init(np.zeros((2, 3)), settings)
    seen = (
        np.array([[2.0, 0, 0], [2, 0, 1]]),
        np.tile([1.0, 0, 0, 1, 0, 1], (2, 1)),
        np.eye(2, DESCRIPTOR_SIZE, dtype=np.float32),
    )
    for _ in range(3):
        frames = [RobotFrame(robot, 0, np.array([0.1, 0, 0.1]), *seen) for robot in range(2)]
        step(state, frames, settings, rng)
    if settings.rejuvenation.ancestors_below > 0:
        rejuvenation.rejuvenate(state, settings, rng)
