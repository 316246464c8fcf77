"""What a run left: load it, save it, judge it, compare it, export it."""

from multi_robot_slam.runs.estimates import LATER_PATHS
from multi_robot_slam.runs.estimates import write as write_estimates
from multi_robot_slam.runs.evaluation import evaluate
from multi_robot_slam.runs.loading import from_bag, from_folder, is_offline, load
from multi_robot_slam.runs.predictions import Predictions
from multi_robot_slam.runs.provenance import Provenance, here, version
from multi_robot_slam.runs.recording import recorded
from multi_robot_slam.runs.result import figures_in, flat
from multi_robot_slam.runs.run import (
    EMPTY,
    TEAM,
    Recorded,
    RobotRun,
    Run,
    assemble,
    trajectory,
)
from multi_robot_slam.runs.saving import write
from multi_robot_slam.runs.text_files import to_tum
from multi_robot_slam.runs.views import View, ViewChoice

__all__ = [
    "EMPTY",
    "LATER_PATHS",
    "TEAM",
    "Predictions",
    "Provenance",
    "Recorded",
    "RobotRun",
    "Run",
    "View",
    "ViewChoice",
    "assemble",
    "evaluate",
    "figures_in",
    "flat",
    "from_bag",
    "from_folder",
    "here",
    "is_offline",
    "load",
    "recorded",
    "to_tum",
    "trajectory",
    "version",
    "write",
    "write_estimates",
]
