"""What a step of the filter tells whoever watches it."""

from collections.abc import Sequence

import numpy as np

from msg_defs.types import WRONG, Estimate, FrameRecord, StepRecord, Verdict
from multi_robot_slam.config import Config
from multi_robot_slam.filter import rbpf
from multi_robot_slam.filter.matching import FrameInfo
from multi_robot_slam.filter.state import State
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.pipeline import ties
from multi_robot_slam.pipeline.estimates import wrapped


def step_record(
    config: Config,
    state: State,
    frames: Sequence[RobotFrame],
    info: rbpf.StepInfo,
    verdicts: tuple[Verdict, ...],
    duration_ms: float,
) -> StepRecord:
    """The record of a step over `frames` that led to `state`.

    Estimates are of the robots whose place in `map` was known before, and is in no doubt.
    """
    best = rbpf.best_particle(state)
    before = best if info.ancestors is None else info.ancestors[best]
    was_in_map = state.pieces.robots_in_map
    if info.tied is not None:  # the moments are from before
        was_in_map[list(info.tied.robots)] = False
    misled = {verdict.robot for verdict in verdicts if verdict.level in WRONG}
    names = [config.robots[state.pieces.team[frame.robot]] for frame in frames]
    return StepRecord(
        stamp_ns=frames[0].stamp_ns,
        step=state.steps,
        frames=tuple(
            _frame_record(name, seen, before, config.filter.sighting_gate)
            for name, seen in zip(names, info.frames, strict=True)
        ),
        estimates=tuple(
            Estimate(
                robot=name,
                stamp_ns=frame.stamp_ns,
                pose=wrapped(mean if config.publishes_mean else state.poses[frame.robot, :, best]),
                covariance=covariance,
                mean=wrapped(mean),
            )
            for frame, name, (mean, covariance) in zip(frames, names, info.moments, strict=True)
            if was_in_map[frame.robot] and name not in misled
        ),
        effective_particles=info.effective_particles,
        resampled=info.ancestors is not None,
        rejuvenated=_rejuvenated(info),
        duration_ms=duration_ms,
        verdicts=verdicts,
        tied=None if info.tied is None else ties.told(config, info.tied, state.pieces.team),
    )


def _rejuvenated(info: rbpf.StepInfo) -> float | None:
    """Effective sample size of what was drawn anew, None where nothing was."""
    drawn = info.rejuvenated
    return drawn.effective_particles if drawn is not None and drawn.groups else None


def _frame_record(robot: str, info: FrameInfo, particle: int, sighting_gate: float) -> FrameRecord:
    matches = info.matches[:, particle]
    sighted = info.sighted.mahalanobis_sq[:, particle]
    is_new = matches == info.new_ids
    return FrameRecord(
        robot=robot,
        landmarks=matches.astype(np.int64),
        is_new=is_new,
        is_rejected=is_new & (np.diff(info.candidates.starts) > 0),
        mahalanobis=np.where(is_new, np.nan, info.mahalanobis_sq[:, particle]).astype(np.float32),
        descriptor_distance=np.where(is_new, np.nan, info.descriptor_distances(matches)),
        others=info.sighted.seen.others,
        other_mahalanobis=sighted.astype(np.float32),
        is_other_rejected=sighted > sighting_gate,
    )
