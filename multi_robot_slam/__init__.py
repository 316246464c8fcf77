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

_ROOMS = {
    "BagReader": "bags",
    "BagWriter": "bags",
    "Config": "config",
    "FilterSettings": "filter.settings",
    "MotionSettings": "models.motion",
    "Pipeline": "pipeline",
    "RejuvenationSettings": "filter.settings",
}

__all__ = [
    "BagReader",
    "BagWriter",
    "Config",
    "FilterSettings",
    "MotionSettings",
    "Pipeline",
    "RejuvenationSettings",
]


def __getattr__(name: str) -> Any:
    """Load a room when its name is first used: a command that needs no filter loads none."""
    if name not in _ROOMS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_ROOMS[name]}"), name)
