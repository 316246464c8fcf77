"""What one run left behind, wherever it came from: a recorded bag or a pipeline in this process."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from msg_defs.types import (
    Estimate,
    FrameCount,
    LandmarkMap,
    PoseSample,
    StepRecord,
    Trajectory,
    Walls,
)
from msg_defs.wire import Estimates
from multi_robot_slam.config import UNKNOWN, Config, StartPose
from multi_robot_slam.models.motion import odom_in_map
from multi_robot_slam.runs import predictions
from multi_robot_slam.runs.provenance import Provenance
from multi_robot_slam.runs.trajectory_errors import at
from multi_robot_slam.runs.views import Views

TEAM = "team"
"""Whose figures those of all robots together are."""

EMPTY = Trajectory(np.empty(0, np.int64), np.empty((0, 3)))
"""The trajectory a run does not have."""


@dataclass(frozen=True, eq=False)
class RobotRun:
    """One robot's trajectories in `map`; one the run does not have is empty, unknown truth None."""

    start_pose: np.ndarray
    """(3,) float64: x [m], y [m], yaw [rad] of its odom frame in `map`."""
    odometry: Trajectory
    """As recorded, in the robot's own `odom` frame."""
    online: Trajectory
    """Poses as published, at the steps and between them; of one stamp that of the step."""
    path: Trajectory
    """The best particle's whole path at the end."""
    truth: Trajectory | None = None
    """True poses."""
    online_mean: Trajectory = EMPTY
    """Means of the particles as published at each step."""
    mean: Trajectory = EMPTY
    """The mean of all particles' whole paths at the end."""
    refined: Trajectory = EMPTY
    """The best particle's path, smoothed over its associations."""
    yardstick: Trajectory = EMPTY
    """The best answer there is: the path smoothed over the true associations."""
    predicted: Estimates = predictions.NONE
    """What was published between the steps."""


@dataclass(frozen=True, eq=False)
class Run:
    """Everything the evaluation and the figures of one run need."""

    config: Config
    robots: dict[str, RobotRun]
    """In the team's order."""
    landmarks: LandmarkMap
    """The best particle's map at the end."""
    steps: list[StepRecord]
    dropped: dict[str, int] = field(default_factory=dict)
    """How many messages the pipeline refused, by reason."""
    frames: dict[str, FrameCount] = field(default_factory=dict)
    """What became of each robot's frames; empty where nobody noted it."""
    true_landmarks: LandmarkMap | None = None
    walls: Walls | None = None
    observation_truth: dict[tuple[str, int], np.ndarray] = field(default_factory=dict)
    """(robot, stamp_ns) -> (B,) uint32: row in `true_landmarks` of each observation."""
    warnings: tuple[str, ...] = ()
    """What was missing or broken in the bag without making the rest useless."""
    refined_landmarks: LandmarkMap | None = None
    """The best particle's map, smoothed over its associations; ids are the same."""
    bag: Path | None = None
    """Where the recording is; None if the run was never recorded."""
    namespace: str = ""
    """Under which the team's topics are in the recording: `/fleet`; the root is empty."""
    views: Views = field(default_factory=dict)
    """What the cameras saw at some keyframes; empty where no pictures were recorded."""
    provenance: Provenance | None = None
    """What made the estimates, and where; None if nobody noted it."""

    def with_paths(self, **kinds: Mapping[str, Trajectory]) -> "Run":
        """Also these paths of the robots: `mean`, `refined`, `yardstick`."""
        robots = dict(self.robots)
        for name, robot in robots.items():
            own: dict[str, Any] = {kind: paths.get(name, EMPTY) for kind, paths in kinds.items()}
            robots[name] = replace(robot, **own)
        return replace(self, robots=robots)


@dataclass(frozen=True, eq=False)
class Recorded:
    """What a recording holds apart from estimates: odometry, and the truth where there is any."""

    odometry: dict[str, Trajectory]
    """Of each robot, in its own `odom` frame."""
    truth: dict[str, Trajectory] = field(default_factory=dict)
    true_landmarks: LandmarkMap | None = None
    walls: Walls | None = None
    observation_truth: dict[tuple[str, int], np.ndarray] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    bag: Path | None = None
    namespace: str = ""
    """Under which the team's topics are in the bag; the root is empty."""


def assemble(
    config: Config,
    recording: Recorded,
    steps: list[StepRecord],
    paths: dict[str, Trajectory],
    landmarks: LandmarkMap,
    dropped: Mapping[str, int],
    frames: Mapping[str, FrameCount] = MappingProxyType({}),
    predicted: Mapping[str, Estimates] = MappingProxyType({}),
) -> Run:
    """Join a recording with what the filter made of it: `paths` and `landmarks` at the end.

    `predicted` was published between the `steps`, of each robot.
    """
    estimates = {name: _estimates(steps, name) for name in config.robots}
    odometry = recording.odometry
    robots = {
        name: RobotRun(
            start_pose=_origin(start, odometry.get(name, EMPTY), paths.get(name, EMPTY), config),
            odometry=odometry.get(name, EMPTY),
            online=_online(estimates[name], predicted.get(name, predictions.NONE)),
            path=paths.get(name, EMPTY),
            truth=recording.truth.get(name),
            online_mean=trajectory(
                replace(e, pose=e.mean) for e in estimates[name] if e.mean is not None
            ),
            predicted=predicted.get(name, predictions.NONE),
        )
        for name, start in zip(config.robots, config.start_poses, strict=True)
    }
    return Run(
        config,
        robots,
        landmarks,
        steps,
        dict(dropped),
        dict(frames),
        recording.true_landmarks,
        recording.walls,
        {
            key: truth[config.plausible.used(len(truth))]
            for key, truth in recording.observation_truth.items()
        },
        recording.warnings,
        bag=recording.bag,
        namespace=recording.namespace,
    )


def _origin(start: StartPose, odometry: Trajectory, path: Trajectory, config: Config) -> np.ndarray:
    """Pose (3,) of the odometry's origin in `map`, as the configuration has it.

    Where that is unknown, as the `path` begins; without one it is nowhere, the origin.
    """
    if start == UNKNOWN:
        if not len(path.poses) or not len(odometry.poses):
            return np.zeros(3)
        return odom_in_map(path.poses[0], at(odometry, path.stamps_ns[:1])[0])
    pose = np.array(start, float)
    if config.start_at == "odom" or not len(odometry.poses):
        return pose
    return odom_in_map(pose, odometry.poses[0])


def _estimates(steps: Iterable[StepRecord], robot: str) -> list[Estimate]:
    return [e for step in steps for e in step.estimates if e.robot == robot]


def _online(steps: list[Estimate], predicted: Estimates) -> Trajectory:
    """All that was published by stamp; a step replaces what was predicted for its stamp."""
    at_steps = trajectory(steps)
    return by_stamp(
        np.concatenate([at_steps.stamps_ns, predicted.stamps_ns]),
        np.concatenate([at_steps.poses, predicted.poses]),
    )


def trajectory(samples: Iterable[PoseSample | Estimate]) -> Trajectory:
    """One robot's samples by stamp; of several with the same stamp the first counts."""
    samples = list(samples)
    stamps = np.array([sample.stamp_ns for sample in samples], np.int64)
    return by_stamp(stamps, np.array([sample.pose for sample in samples], float).reshape(-1, 3))


def by_stamp(stamps_ns: np.ndarray, poses: np.ndarray) -> Trajectory:
    """Poses (n, 3) sorted by `stamps_ns` (n,); of several with the same stamp the first counts."""
    stamps, first = np.unique(stamps_ns, return_index=True)
    return Trajectory(stamps, poses[first])
