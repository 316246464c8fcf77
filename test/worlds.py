"""A small made-up world for the filter's tests: no simulator, every number at hand."""

import numpy as np

from msg_defs.types import CameraMount, ObservationSet
from multi_robot_slam.filter.settings import NO_REJUVENATION, ExistenceSettings, FilterSettings
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.models.motion import MotionSettings

MOUNT = CameraMount(forward_m=0.1, left_m=0.06, up_m=1.0)
EVERYTHING = ExistenceSettings(published_from=1, gone_below=0.0)
"""All landmarks are published."""
START = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 1.5], [2.0, 3.0, -2.0]])


def settings(particles: int = 12, **changes) -> FilterSettings:
    """The paper's choices, with noise that fits `drive`."""
    noise = MotionSettings(
        forward_per_sqrt_m=0.05, left_per_sqrt_m=0.03, yaw_per_sqrt_m=0.03, yaw_per_sqrt_rad=0.05
    )
    paper = {"proposal": "motion", "resample_below": 1.0, "exclusive": False, "motion": noise}
    paper["rejuvenation"] = NO_REJUVENATION
    paper["existence"] = EVERYTHING
    return FilterSettings(particles=particles, **paper | changes)


class CameraFrame(RobotFrame):
    """A frame that also knows what the camera itself saw, for the literal filters."""

    observations: ObservationSet


def frame(robot, motion, observations, mount=MOUNT, seconds=0.0):
    """The frame of what a camera saw, with `observations` kept beside it."""
    made = CameraFrame.from_camera(robot, motion, seconds, observations, mount)
    object.__setattr__(made, "observations", observations)
    return made


def drive(seed: int, steps: int, robots: int = 3, seen: int = 5, alike: float = 0.0):
    """Frames of `robots` robots that circle among 40 landmarks: a list of lists of RobotFrame.

    Every robot sees `seen` random landmarks each step, wherever they are, with an anisotropic,
    correlated covariance. A share `alike` of the landmarks has nearly the descriptor of another.
    """
    rng = np.random.default_rng(seed)
    landmarks = rng.uniform([-3, -3, 0], [7, 7, 2], (40, 3))
    descriptors = rng.random((40, 128))
    twins = rng.random(40) < alike
    descriptors[twins] = np.roll(descriptors, 1, axis=0)[twins]
    landmarks[twins] = np.roll(landmarks, 1, axis=0)[twins] + rng.normal(0, 0.3, (twins.sum(), 3))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    poses = START[:robots].copy()
    result = []
    for step in range(steps):
        frames = []
        for robot in range(robots):
            u = np.array([0.2, 0.0, 0.15]) if step else np.zeros(3)
            c, s = np.cos(poses[robot, 2]), np.sin(poses[robot, 2])
            poses[robot] += [c * u[0], s * u[0], u[2]]
            chosen = rng.choice(40, seen, replace=False)
            frames.append(
                frame(
                    robot,
                    u + rng.normal(0, 0.01, 3) * (step > 0),
                    observe(poses[robot], landmarks[chosen], descriptors[chosen], rng, step),
                )
            )
        result.append(frames)
    return result


def observe(pose, landmarks, descriptors, rng, step) -> ObservationSet:
    """Noisy observations of `landmarks` (B, 3) from `pose`, with random full covariances."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    body = (landmarks - [pose[0], pose[1], 0]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    body -= [MOUNT.forward_m, MOUNT.left_m, MOUNT.up_m]
    camera = np.stack([-body[:, 1], body[:, 2], body[:, 0]], axis=1)
    roots = rng.normal(0, 0.05, (len(landmarks), 3, 3)) + 0.05 * np.eye(3)
    full = roots @ roots.transpose(0, 2, 1) + 1e-4 * np.eye(3)
    noise = (np.linalg.cholesky(full) @ rng.standard_normal((len(full), 3, 1)))[:, :, 0]
    return ObservationSet(
        "robot",
        step * 10**9,
        (camera + noise).astype(np.float32),
        full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].astype(np.float32),
        (descriptors + rng.normal(0, 0.01, descriptors.shape)).astype(np.float32),
    )
