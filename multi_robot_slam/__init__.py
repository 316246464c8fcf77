"""The estimate: one landmark map and all robots' paths from what the team sees.

A script needs no deeper import than this one; `examples/` has some.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msg_defs.errors import InputError
    from msg_defs.types import ObservationSet, PoseSample
    from multi_robot_slam.bags import BagReader, BagWriter
    from multi_robot_slam.config import Config, Keyframe
    from multi_robot_slam.filter.settings import FilterSettings, RejuvenationSettings
    from multi_robot_slam.models.motion import MotionSettings
    from multi_robot_slam.pipeline import Pipeline
    from multi_robot_slam.pipeline.offline import estimate, events, recorded_config
    from multi_robot_slam.runs import Run, evaluate
    from multi_robot_slam.runs import load as load_run

_PLACES = {
    "BagReader": "multi_robot_slam.bags.BagReader",
    "BagWriter": "multi_robot_slam.bags.BagWriter",
    "Config": "multi_robot_slam.config.Config",
    "FilterSettings": "multi_robot_slam.filter.settings.FilterSettings",
    "InputError": "msg_defs.errors.InputError",
    "Keyframe": "multi_robot_slam.config.Keyframe",
    "MotionSettings": "multi_robot_slam.models.motion.MotionSettings",
    "ObservationSet": "msg_defs.types.ObservationSet",
    "Pipeline": "multi_robot_slam.pipeline.Pipeline",
    "PoseSample": "msg_defs.types.PoseSample",
    "RejuvenationSettings": "multi_robot_slam.filter.settings.RejuvenationSettings",
    "Run": "multi_robot_slam.runs.Run",
    "estimate": "multi_robot_slam.pipeline.offline.estimate",
    "evaluate": "multi_robot_slam.runs.evaluate",
    "events": "multi_robot_slam.pipeline.offline.events",
    "load_run": "multi_robot_slam.runs.load",
    "recorded_config": "multi_robot_slam.pipeline.offline.recorded_config",
}

__all__ = [
    "BagReader",
    "BagWriter",
    "Config",
    "FilterSettings",
    "InputError",
    "Keyframe",
    "MotionSettings",
    "ObservationSet",
    "Pipeline",
    "PoseSample",
    "RejuvenationSettings",
    "Run",
    "estimate",
    "evaluate",
    "events",
    "load_run",
    "recorded_config",
]


def __getattr__(name: str) -> Any:
    """Load a room when its name is first used: a command that needs no filter loads none."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    room, _, own_name = _PLACES[name].rpartition(".")
    return getattr(import_module(room), own_name)
