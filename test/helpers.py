"""Fakes shared by the tests: a small but complete run of a team, made without a filter."""

import numpy as np

from msg_defs.types import (
    Estimate,
    FrameRecord,
    LandmarkMap,
    StepRecord,
    Trajectory,
    Walls,
)
from multi_robot_slam.config import Config
from multi_robot_slam.runs import RobotRun, Run

PERIOD_NS = 100_000_000


def fake_run(robots: int = 2, steps: int = 20, landmarks: int = 8) -> Run:
    """A perfect run: robots on circles, odometry and estimate equal to the truth.

    Odometry starts at the origin of its own frame. In step t robot i observes the true landmarks
    t, t + 1 and t + 2 (modulo their number); an estimated landmark's id is 100 + its true row.
    """
    names = tuple(f"robot_{i + 1}" for i in range(robots))
    truths = {name: fake_circle(i, steps) for i, name in enumerate(names)}
    starts = tuple(tuple(truth.poses[0].tolist()) for truth in truths.values())
    true_landmarks = fake_landmarks(landmarks)
    records, observation_truth = fake_steps(truths, landmarks)
    return Run(
        config=Config(robots=names, start_poses=starts),
        robots={name: fake_robot(truth) for name, truth in truths.items()},
        landmarks=fake_landmarks(landmarks, first_id=100, sigma_m=0.1),
        steps=records,
        dropped={"late": 2},
        true_landmarks=true_landmarks,
        walls=Walls(np.array([[-5.0, -5.0, 5.0, -5.0], [5.0, -5.0, 5.0, 5.0]]), 2.0),
        observation_truth=observation_truth,
    )


def fake_circle(index: int, steps: int) -> Trajectory:
    """A counter-clockwise circle; the yaw passes pi on the way."""
    angle = np.linspace(0, 1.5 * np.pi, steps) + 0.3 * index
    radius = 2.0 + index
    yaw = np.arctan2(np.cos(angle), -np.sin(angle))
    stamps = 1_700_000_000_000_000_000 + PERIOD_NS * np.arange(steps)
    return Trajectory(
        stamps, np.column_stack([radius * np.cos(angle), radius * np.sin(angle), yaw])
    )


def fake_robot(truth: Trajectory) -> RobotRun:
    return RobotRun(
        start_pose=truth.poses[0],
        odometry=seen_from(truth.poses[0], truth),
        online=truth,
        path=truth,
        truth=truth,
    )


def seen_from(origin: np.ndarray, path: Trajectory) -> Trajectory:
    """The same path in the frame whose pose is `origin`."""
    x, y, yaw = (path.poses - origin).T
    c, s = np.cos(origin[2]), np.sin(origin[2])
    yaw = np.arctan2(np.sin(yaw), np.cos(yaw))
    return Trajectory(path.stamps_ns, np.column_stack([c * x + s * y, c * y - s * x, yaw]))


def moved(path: Trajectory, by: tuple[float, float, float]) -> Trajectory:
    """The path with `by` added to every pose."""
    return Trajectory(path.stamps_ns, path.poses + by)


def fake_landmarks(count: int, first_id: int = 0, sigma_m: float = 0.0) -> LandmarkMap:
    """Landmarks on a spiral, one metre up, equally uncertain in all directions."""
    rows = np.arange(count)
    x, y = (3 + rows / count) * np.cos(rows), (3 + rows / count) * np.sin(rows)
    return LandmarkMap(
        ids=(first_id + rows).astype(np.uint32),
        positions=np.column_stack([x, y, np.ones(count)]).astype(np.float32),
        covariances=np.tile(np.float32(sigma_m**2) * np.float32([1, 0, 0, 1, 0, 1]), (count, 1)),
        observations=np.full(count, 3, np.uint32),
        robots=np.ones(count, np.uint32),
        descriptors=np.zeros((count, 128), np.float32),
    )


def fake_steps(
    truths: dict[str, Trajectory], landmarks: int
) -> tuple[list[StepRecord], dict[tuple[str, int], np.ndarray]]:
    """A record of each step with perfect association, and the truth of each observation."""
    records, observation_truth, mapped = [], {}, set()
    stamps = next(iter(truths.values())).stamps_ns.tolist()
    for step, stamp in enumerate(stamps):
        seen = np.unique((step + np.arange(3)) % landmarks)
        frames = []
        for name in truths:
            observation_truth[name, stamp] = seen.astype(np.uint32)
            frames.append(fake_frame(name, 100 + seen, ~np.isin(seen, list(mapped))))
            mapped.update(seen.tolist())
        estimates = [
            Estimate(name, stamp, truth.poses[step], 1e-4 * np.eye(3))
            for name, truth in truths.items()
        ]
        records.append(fake_step(step, stamp, frames, estimates))
    return records, observation_truth


def fake_step(
    step: int, stamp_ns: int, frames: list[FrameRecord], estimates: list[Estimate]
) -> StepRecord:
    return StepRecord(stamp_ns, step, tuple(frames), tuple(estimates), 12.5, False, step + 1.0)


def fake_frame(robot: str, landmarks: list[int], is_new: list[bool]) -> FrameRecord:
    """A frame whose observations updated or created `landmarks`."""
    nothing = np.full(len(landmarks), np.nan, np.float32)
    return FrameRecord(
        robot=robot,
        landmarks=np.array(landmarks, np.int64),
        is_new=np.array(is_new, bool),
        is_rejected=np.zeros(len(landmarks), bool),
        mahalanobis=nothing,
        descriptor_distance=nothing,
    )
