"""The two ways to propose new poses: from the motion alone, or knowing what the robot sees.

Each takes the frames of one instant, draws a pose for every particle and robot, matches,
updates and weighs: Algorithm 1, lines 12 to 42.
"""

import numpy as np

from multi_robot_slam.filter import informed_kernels, kernels, matching, sightings
from multi_robot_slam.filter.kernels import Observed
from multi_robot_slam.filter.matching import FrameInfo, as_seen
from multi_robot_slam.filter.settings import FilterSettings, threads
from multi_robot_slam.filter.sightings import JointBelief, Sighted
from multi_robot_slam.filter.state import State
from multi_robot_slam.models import motion, parallel
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.models.symmetric import pack, root
from multi_robot_slam.smoothing.odometry_scale import scaled

MANY_SIGMA = 10.0
"""No belief moves a pose further from its prediction."""


WIDEST_M = kernels.FAR / 2
"""No pose is further away: what lies beyond stands for a landmark that a particle does not have."""


class NotFiniteError(ArithmeticError):
    """A step would leave poses or weights that are no numbers: it was not done."""


def propose_by_motion(
    state: State, frames: list[RobotFrame], settings: FilterSettings, rng: np.random.Generator
) -> list[FrameInfo]:
    """Draw the poses from the motion model (7), then match and update as seen from them."""
    for frame in frames:
        poses = state.poses[frame.robot]
        normals = rng.standard_normal(poses.shape)
        if frame.start is None:
            factor = state.noise.used[frame.robot, 0]
            sigma = motion.standard_deviations(
                frame.motion, frame.seconds, settings.motion, frame.extra, factor
            )
            moved = scaled(frame.motion, state.scales.factors[frame.robot])[:, None]
            motion.move(poses, moved + sigma[:, None] * normals)
        else:
            poses += root(frame.start.covariance) @ normals
        require_finite(poses)
    certain = np.zeros((len(frames), 6, settings.particles))
    _, sighted = _see_all(frames, state.poses, certain, settings.sighting_gate)
    return [
        _update_as_drawn(state, frame, settings, seen)
        for frame, seen in zip(frames, sighted, strict=True)
    ]


def _update_as_drawn(
    state: State, frame: RobotFrame, settings: FilterSettings, sighted: Sighted
) -> FrameInfo:
    """Match, update and weigh as seen from the drawn poses."""
    found = matching.begin(state, frame, settings, pose_margin=np.zeros(2))
    dtype = state.landmarks.planes.dtype
    parallel.over_particles(
        kernels.associate_and_update,
        settings.particles,
        threads(settings),
        state.landmarks.planes,
        found.candidates,
        found.new_columns,
        as_seen(state.poses[frame.robot], dtype),
        found.observed,
        dtype.type(settings.gate),
        settings.exclusive,
        found.matches,
    )
    return matching.finish(state.landmarks, settings, found, sighted)


def propose_informed(
    state: State, frames: list[RobotFrame], settings: FilterSettings, rng: np.random.Generator
) -> list[FrameInfo]:
    """Match first, then draw each pose from what motion, sightings and matches say, then update."""
    priors = np.empty((len(frames), 6, settings.particles), state.landmarks.planes.dtype)
    for frame, prior in zip(frames, priors, strict=True):
        poses = state.poses[frame.robot]
        motion.move(poses, scaled(frame.motion, state.scales.factors[frame.robot])[:, None])
        factor = state.noise.used[frame.robot, 0]
        spread = motion.spread(frame.motion, frame.seconds, settings.motion, frame.extra, factor)
        spread = spread.astype(prior.dtype)
        informed_kernels.spread_in_map(as_seen(poses, prior.dtype), spread, prior)
        if frame.start is not None:
            prior += pack(frame.start.covariance).astype(prior.dtype)[:, None]
        require_finite(poses)
    joint, sighted = _see_all(frames, state.poses, priors, settings.sighting_gate)
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
    sighted: Sighted,
) -> FrameInfo:
    """Match, draw the pose from the `prior` (6, M) and what was matched, update and weigh."""
    poses = state.poses[frame.robot]
    variances = np.array([(prior[0] + prior[3]).max(), prior[5].max()])
    found = matching.begin(state, frame, settings, MANY_SIGMA * np.sqrt(variances))
    frame, observed, gate = found.frame, found.observed, settings.gate
    believed = observed
    if informed_kernels.needs_double(variances, frame.positions, frame.covariances):
        believed, prior = Observed(frame.positions, frame.covariances), prior.astype(np.float64)
    beliefs = np.empty((9, settings.particles), prior.dtype)
    parallel.over_particles(
        informed_kernels.associate_and_believe,
        settings.particles,
        threads(settings),
        state.landmarks.planes,
        found.candidates,
        as_seen(poses, prior.dtype),
        prior,
        believed,
        prior.dtype.type(gate),
        settings.exclusive,
        beliefs,
        found.matches,
    )
    informed_kernels.draw(poses, beliefs, rng.standard_normal(poses.shape))
    require_finite(poses)
    parallel.over_particles(
        informed_kernels.update_matched,
        settings.particles,
        threads(settings),
        state.landmarks.planes,
        found.candidates,
        found.new_columns,
        as_seen(poses, observed.v.dtype),
        observed,
        observed.v.dtype.type(gate),
        found.matches,
    )
    return matching.finish(state.landmarks, settings, found, sighted)


def _see_all(
    frames: list[RobotFrame], poses: np.ndarray, priors: np.ndarray, gate: float
) -> tuple[JointBelief | None, list[Sighted]]:
    """`sightings.see_all`, whose weights must be numbers before a landmark is written."""
    joint, sighted = sightings.see_all(frames, poses, priors, gate)
    if joint is not None:
        for own in sighted:
            require_finite(own.log_factor[None], np.finfo(float).max)
    return joint, sighted


def require_finite(values: np.ndarray, limit: float = WIDEST_M) -> None:
    """`NotFiniteError` unless all `values` (n, M), float64, are numbers of size up to `limit`."""
    if not kernels.all_within(values, limit):
        raise NotFiniteError("the step leads to poses or weights that are no finite numbers")


def require_usable(frame: RobotFrame) -> None:
    """`NotFiniteError` where an observation of the frame, or its noise, is beyond all numbers."""
    if not kernels.are_usable(frame.positions, frame.covariances, WIDEST_M):
        raise NotFiniteError(
            f"an observation of robot {frame.robot} is no finite point with a positive definite "
            f"covariance, variances {kernels.LEAST_VARIANCE:g} to {kernels.LARGEST_VARIANCE:g} m^2"
        )


PROPOSALS = {"motion": propose_by_motion, "informed": propose_informed}
