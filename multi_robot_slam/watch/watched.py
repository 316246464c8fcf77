"""What is known of a fusion from what it has published so far."""

from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from msg_defs import wire
from msg_defs.types import (
    CameraInfo,
    Estimate,
    FrameRecord,
    Image,
    LandmarkMap,
    StepRecord,
    Trajectory,
    Verdict,
    Walls,
)
from multi_robot_slam.config import UNKNOWN, Config

MOST_STEPS = 1000
"""Kept for the charts; of more, the newest."""
MOST_TRAIL = 1000
"""Poses kept since the last path; of more, every other one."""
LAG = "lag [s]"
"""What the fusion calls how far it is behind."""
SMALLEST_M = 6.0
"""Width of a scene in which there is next to nothing [m]."""
OWN = ("fusion", "camera: ")
"""How the names of the entries in `/diagnostics` begin that are ours; others may be there."""


@dataclass(eq=False)
class Robot:
    """What is known of one robot; nothing of one whose place in `map` is not known."""

    estimate: Estimate | None = None
    """The newest pose."""
    path: Trajectory | None = None
    trail: list[Estimate] = field(default_factory=list)
    """Poses since the end of the path."""
    particles: np.ndarray | None = None
    """(M, 3) float64: x [m], y [m], yaw [rad] in `map`."""
    frame: FrameRecord | None = None
    """What its last keyframe saw."""
    verdict: Verdict | None = None
    picture: Image | None = None
    calibration: CameraInfo | None = None
    """Of the picture."""


class Watched:
    """Takes what is published, piece by piece; each `take_...` replaces what was before.

    Records are not changed: what is another object is news.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self.landmarks: LandmarkMap | None = None
        self.walls: Walls | None = None
        self.statuses: dict[str, wire.Status] = {}
        """The newest of the fusion and of each robot and camera, by name."""
        self._begin()

    def _begin(self) -> None:
        self.robots = {name: Robot() for name in self.config.robots}
        self.steps: deque[StepRecord] = deque(maxlen=MOST_STEPS)
        self.lags: deque[tuple[int, float]] = deque(maxlen=MOST_STEPS)
        """Stamp of the newest step [ns], and how far the fusion was behind then [s]."""
        self.first_ns: int | None = None
        """Stamp of the first step that was heard of."""
        self.stamp_ns: int | None = None
        """Of the newest pose or step."""

    def take_map(self, landmarks: LandmarkMap) -> None:
        self.landmarks = landmarks

    def take_walls(self, walls: Walls) -> None:
        self.walls = walls

    def take_step(self, step: StepRecord) -> None:
        """A step; one that is not newer than the last says that the fusion began anew."""
        if self.steps and step.step <= self.steps[-1].step:
            self._begin()
            self.landmarks = None
        self.steps.append(step)
        if self.first_ns is None:
            self.first_ns = step.stamp_ns
        self._note(step.stamp_ns)
        for frame in step.frames:
            self.robots[frame.robot].frame = frame
        for verdict in step.verdicts:
            self.robots[verdict.robot].verdict = verdict

    def take_pose(self, estimate: Estimate) -> None:
        robot = self.robots[estimate.robot]
        robot.estimate = estimate
        trail = robot.trail if len(robot.trail) < MOST_TRAIL else robot.trail[::2]
        robot.trail = [*trail, estimate]
        self._note(estimate.stamp_ns)

    def take_path(self, name: str, path: Trajectory) -> None:
        robot = self.robots[name]
        robot.path = path
        end_ns = path.stamps_ns[-1] if len(path.stamps_ns) else 0
        robot.trail = [pose for pose in robot.trail if pose.stamp_ns > end_ns]

    def take_particles(self, name: str, poses: np.ndarray) -> None:
        self.robots[name].particles = poses

    def take_picture(self, name: str, picture: Image) -> None:
        self.robots[name].picture = picture

    def take_calibration(self, name: str, info: CameraInfo) -> None:
        self.robots[name].calibration = info

    def take_diagnostics(self, statuses: tuple[wire.Status, ...]) -> None:
        own = {status.name: status for status in statuses if status.name.startswith(OWN)}
        self.statuses |= own
        lag = own["fusion"].values.get(LAG, "") if "fusion" in own else ""
        if self.steps and lag:
            with suppress(ValueError):
                self.lags.append((self.steps[-1].stamp_ns, float(lag)))

    def seconds(self, stamp_ns: int) -> float:
        """Since the first step that was heard of [s]."""
        return (stamp_ns - (self.first_ns or stamp_ns)) / 1e9

    def _note(self, stamp_ns: int) -> None:
        self.stamp_ns = max(stamp_ns, self.stamp_ns or stamp_ns)

    def extent(self) -> tuple[np.ndarray, float]:
        """Middle (3,) and width [m] of what there is to see."""
        starts = [pose for pose in self.config.start_poses if pose != UNKNOWN]
        flat = [np.reshape(starts, (-1, 3))[:, :2]]
        flat += [np.array([r.estimate.pose[:2]]) for r in self.robots.values() if r.estimate]
        flat += [r.path.poses[:, :2] for r in self.robots.values() if r.path is not None]
        if self.walls is not None:
            flat.append(self.walls.segments.reshape(-1, 2))
        if self.landmarks is not None:
            flat.append(self.landmarks.positions[:, :2])
        places = np.concatenate(flat)
        if not len(places):
            return np.zeros(3), SMALLEST_M
        low, high = np.quantile(places, [0.01, 0.99], axis=0)
        return np.array([*(low + high) / 2, 0.0]), float(max((high - low).max(), SMALLEST_M))
