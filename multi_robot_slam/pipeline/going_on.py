"""A pipeline taken apart, and one that goes on from there as if nothing had happened.

Everything it consists of is kept, whatever that is: what is waiting, what was learnt, the particles
and their pasts, the state of the random numbers. So all that follows is the same to the last bit.
"""

from collections.abc import Callable, Iterable
from types import ModuleType

from msg_defs import types, wire
from msg_defs.errors import InputError
from multi_robot_slam import config
from multi_robot_slam.filter import (
    covisible,
    existence,
    history,
    kept,
    landmarks,
    losing,
    new_map,
    pieces,
    running,
    settled,
    snapshot,
    state,
    views,
    vote,
)
from multi_robot_slam.filter import settings as filter_settings
from multi_robot_slam.front_end import settings as camera_settings
from multi_robot_slam.maps.graph import Known, Parts, Taken, put_together
from multi_robot_slam.models import frames, motion, ranging
from multi_robot_slam.monitor import (
    alignment,
    continuity,
    evidence,
    in_view,
    innovations,
    learnt_noise,
    monitor,
    recognition,
    verdicts,
)
from multi_robot_slam.pipeline import (
    gaps,
    intervals,
    keyframes,
    levels,
    losses,
    odometry,
    pairing,
    pipeline,
    reorder,
    time_guard,
)
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.smoothing import (
    envelope,
    noise_factors,
    odometry_scale,
    prior,
    solve,
)

MODULES: tuple[ModuleType, ...] = (
    *(types, config, filter_settings, camera_settings, frames, motion, ranging),
    *(prior, solve, envelope, noise_factors, odometry_scale),
    *(state, history, landmarks, settled, covisible, existence, views, new_map, kept),
    *(pieces, vote, losing, snapshot, running),
    *(
        monitor,
        continuity,
        evidence,
        alignment,
        in_view,
        innovations,
        learnt_noise,
        recognition,
        verdicts,
    ),
    *(pipeline, reorder, pairing, odometry, gaps, intervals, losses, keyframes, levels, time_guard),
)
"""Whose classes a pipeline consists of."""


def _classes(modules: Iterable[ModuleType]) -> list[type]:
    return [
        one
        for module in modules
        for one in vars(module).values()
        if isinstance(one, type) and one.__module__ == module.__name__
    ]


LASTING = (
    *(frames.Record, frames.RobotFrame, prior.Prior, solve.Smoothed, snapshot.Snapshot),
    *(settled.Settled, covisible.Covisible, existence.Existence, kept.KeptMap),
    *(types.PoseSample, types.ObservationSet, types.Sightings, odometry.Sample, gaps.Gap),
)
"""Most of what it consists of; the rest is told in a few milliseconds."""

KNOWN = Known(_classes(MODULES), [wire.decode_observations], LASTING)


def taken_apart(pipeline: Pipeline) -> Taken:
    """All that `pipeline` goes on from; what it does later has no effect.

    `InputError` where pictures wait that nobody has looked at yet.
    """
    try:
        return Taken(pipeline, KNOWN, {"warn": pipeline.warn})
    except TypeError as error:
        raise InputError(f"the state cannot be saved now: {error}") from None


def put_back(parts: Parts, warn: Callable[[str], None]) -> Pipeline:
    """The pipeline that was taken apart, as it was; `warn` as for a new one.

    `InputError` where the parts are those of no pipeline of this version of the program.
    """
    result = put_together(parts, KNOWN, {"warn": warn})
    if not isinstance(result, Pipeline):
        raise InputError("no state of this program (it is no pipeline's)")
    return result
