"""The estimate: one landmark map and all robots' paths from what the team sees.

A script needs no deeper import than this one; `examples/` has two.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from multi_robot_slam.bags import BagReader, BagWriter
    from multi_robot_slam.config import Config
    from multi_robot_slam.filter.settings import FilterSettings, RejuvenationSettings
    from multi_robot_slam.models.motion import MotionSettings
    from multi_robot_slam.pipeline import Pipeline
    from multi_robot_slam.pipeline.offline import estimate, events, recorded_config
    from multi_robot_slam.runs import Run, evaluate
    from multi_robot_slam.runs import load as load_run

_PLACES = {
    "BagReader": "bags.BagReader",
    "BagWriter": "bags.BagWriter",
    "Config": "config.Config",
    "FilterSettings": "filter.settings.FilterSettings",
    "MotionSettings": "models.motion.MotionSettings",
    "Pipeline": "pipeline.Pipeline",
    "RejuvenationSettings": "filter.settings.RejuvenationSettings",
    "Run": "runs.Run",
    "estimate": "pipeline.offline.estimate",
    "evaluate": "runs.evaluate",
    "events": "pipeline.offline.events",
    "load_run": "runs.load",
    "recorded_config": "pipeline.offline.recorded_config",
}

__all__ = [
    "BagReader",
    "BagWriter",
    "Config",
    "FilterSettings",
    "MotionSettings",
    "Pipeline",
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
    return getattr(import_module(f"{__name__}.{room}"), own_name)
