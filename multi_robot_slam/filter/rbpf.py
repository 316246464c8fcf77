"""Algorithm 1: one particle set over the poses of K robots, each with a map of small EKFs."""

from typing import NamedTuple

import numpy as np

from msg_defs.types import DESCRIPTOR_SIZE
from multi_robot_slam.filter import resampling
from multi_robot_slam.filter.existence import Existence
from multi_robot_slam.filter.history import History
from multi_robot_slam.filter.landmarks import Landmarks
from multi_robot_slam.filter.losing import Lost
from multi_robot_slam.filter.matching import FrameInfo
from multi_robot_slam.filter.pieces import Pieces
from multi_robot_slam.filter.proposals import (
    PROPOSALS,
    NotFiniteError,
    require_finite,
    require_usable,
)
from multi_robot_slam.filter.rejuvenation import Rejuvenated
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.filter.state import State, best_particle, resample
from multi_robot_slam.filter.tying import Tie
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.models.parallel import one_thread
from multi_robot_slam.models.ranging import Ranging
from multi_robot_slam.smoothing.noise_factors import NoiseFactors
from multi_robot_slam.smoothing.odometry_scale import VAGUE, Scales
from multi_robot_slam.smoothing.prior import Prior

__all__ = ["NotFiniteError", "State", "StepInfo", "best_particle", "init", "step", "warm_up"]


class StepInfo(NamedTuple):
    """What an observer of a step wants to know."""

    frames: tuple[FrameInfo, ...]
    effective_particles: float
    moments: tuple[tuple[np.ndarray, np.ndarray], ...]
    """For each frame the weighted mean (3,) and covariance (3, 3) of its robot's pose.

    Before resampling, which would only add noise.
    """
    ancestors: np.ndarray | None
    """(M,) int32: the particle before resampling that each continues; None: not resampled."""
    rejuvenated: Rejuvenated | None = None
    """Of the rejuvenation that counts from this step on (`running`)."""
    tied: Tie | None = None
    """What was tied after this step (`running`)."""
    lost: tuple[Lost, ...] = ()
    """Robots that go on as others after this step (`running`)."""


def init(
    start_poses: np.ndarray,
    settings: FilterSettings,
    dtype: type = np.float32,
    keeps_frames: bool = True,
    are_known: np.ndarray | None = None,
) -> State:
    """All particles at `start_poses` (K, 3): x, y [m], yaw [rad]; an empty map.

    `keeps_frames`: whether frames that settle are kept whole. `are_known` (K,): which of the poses
    are in `map`; each other one is in a piece of the robot's own. None: all.
    """
    count = settings.particles
    start_poses = np.asarray(start_poses, float)
    if are_known is None:
        are_known = np.ones(len(start_poses), bool)
    return State(
        poses=np.repeat(start_poses[:, :, None], count, axis=2),
        landmarks=Landmarks(count, dtype),
        log_weights=np.zeros(count),
        log_weight_sum=np.zeros(count),
        history=History(count, keeps_frames),
        scales=Scales.unknown(len(start_poses), settings.motion.scale_sigma),
        bias=Scales.unknown(len(start_poses), VAGUE),
        noise=NoiseFactors.as_told(len(start_poses)),
        prior=Prior.exact(start_poses),
        existence=Existence.nothing(len(start_poses)),
        pieces=Pieces.of_starts(are_known),
    )


@one_thread
def step(
    state: State, frames: list[RobotFrame], settings: FilterSettings, rng: np.random.Generator
) -> StepInfo:
    """One pass of Algorithm 1's loop, lines 5-10, over the frames of one instant.

    `ValueError` when a robot sees one that has no frame among them. `NotFiniteError` when poses or
    weights would be no finite numbers: the state is as before, but for the random numbers drawn.
    """
    infos = _propose(state, frames, settings, rng)  # lines 12-42: (7)-(13), (18), (19)
    for frame, info in zip(frames, infos, strict=True):
        state.log_weights += info.log_likelihood  # (16)
        state.log_weight_sum += info.log_likelihood  # (17)
        poses = state.poses[frame.robot]
        state.history.append(frame, state.steps, poses, info.matches, info.new_ids)
        if frame.start is not None:
            state.prior = state.prior.starting(frame.robot, frame.start)
    state.steps += 1
    weights = resampling.normalise(state.log_weights)
    effective = resampling.effective_sample_size(weights)
    around = tuple(moments(state.poses[frame.robot], weights) for frame in frames)
    ancestors = None
    if effective <= settings.resample_below * len(weights):
        ancestors = resampling.systematic(weights, rng.random())  # line 10
        resample(state, ancestors)
    return StepInfo(tuple(infos), effective, around, ancestors)


def _propose(
    state: State, frames: list[RobotFrame], settings: FilterSettings, rng: np.random.Generator
) -> list[FrameInfo]:
    """Draw poses, match and update landmarks; all as before where that fails.

    Whatever can fail is looked at before the first landmark is written: the observations here, the
    moved poses and the sightings in the proposals.
    """
    before = state.poses.copy()
    frames = [
        state.pieces.within(frame).with_noise(state.noise.used[frame.robot, 1]) for frame in frames
    ]
    try:
        for frame in frames:
            require_usable(frame)
            if frame.start is not None:
                state.poses[frame.robot] = frame.start.mean[:, None]
        infos = PROPOSALS[settings.proposal](state, frames, settings, rng)
        for info in infos:
            require_finite(info.log_likelihood[None], np.finfo(float).max)
    except (ArithmeticError, np.linalg.LinAlgError, ValueError):
        state.poses = before
        state.landmarks.release_reserved()
        raise
    return infos


def moments(poses: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (3,) and covariance (3, 3) of `poses` (3, M) under normalised `weights` (M,)."""
    mean = poses @ weights
    deviations = poses - mean[:, None]
    return mean, (weights * deviations) @ deviations.T


def warm_up(settings: FilterSettings) -> State:
    """Compile every kernel or load it from the cache: steps of two robots that see two points."""
    rng = np.random.default_rng(0)
    state = init(np.zeros((2, 3)), settings)
    for precision in (1.0, 1.0, 1.0, 1e-9):  # the last one is believed in double
        step(state, two_robots(precision), settings, rng)
    return state


def two_robots(precision: float = 1.0) -> list[RobotFrame]:
    """Frames of two robots that see two points, with covariances times `precision`."""
    seen = (
        np.array([[2.0, 0, 0], [2, 0, 1]]),
        np.tile([precision, 0, 0, precision, 0, precision], (2, 1)),
        np.eye(2, DESCRIPTOR_SIZE, dtype=np.float32),
    )
    ranging = Ranging(seen[0], 0.1 * seen[0])
    return [
        RobotFrame(robot, 0, np.array([0.1, 0, 0.1]), *seen, ranging=ranging) for robot in range(2)
    ]
