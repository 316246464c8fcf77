"""The benchmark's world: robots on a ring road between two walls full of landmarks.

Evenly spaced landmarks on both walls; each robot drives along the middle and sees the next few
ahead of it, so that it meets every landmark again and again until it has passed, and new ones at a
steady rate.
"""

import numpy as np

from msg_defs.types import ObservationSet, StereoCamera
from multi_robot_slam.models import motion, stereo
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.models.motion import MotionSettings
from multi_robot_slam.models.symmetric import pack

CAMERA = StereoCamera(sigma_rc_px=1.0)
SPACING_M = 0.25
"""Between two landmarks, along the road."""
AHEAD_M = 2.5
"""From a robot to the first landmark it sees, along the road."""
WALL_M = 1.5
"""From the middle of the road to each wall."""
DESCRIPTOR_NOISE = 0.01
"""Standard deviation of each element."""


class World:
    """A ring of `landmarks` with `robots` spread evenly over it.

    Attributes
    ----------
    seen : the landmarks observed so far; seen_before : so far but for the latest frames.
    latest : for each robot the (B,) landmarks of its latest frame.

    """

    def __init__(
        self, landmarks: int, robots: int, noise: MotionSettings, observations: int, seed: int
    ):
        self._rng = np.random.default_rng(seed)
        self._noise = noise
        self._observations = observations
        self._radius = landmarks * SPACING_M / (2 * np.pi)
        angles = np.arange(landmarks) * SPACING_M / self._radius
        distances = self._radius + self._rng.choice([-WALL_M, WALL_M], landmarks)
        heights = self._rng.uniform(0.3, 2.0, landmarks)
        self._landmarks = np.column_stack(
            [distances * np.cos(angles), distances * np.sin(angles), heights]
        )
        self._descriptors = self._rng.standard_normal((landmarks, 128))
        self._descriptors /= np.linalg.norm(self._descriptors, axis=1, keepdims=True)
        self._passed = np.arange(robots) * (landmarks / robots)
        self._stamp_ns = 0
        self.seen: set[int] = set()
        self.seen_before: set[int] = set()
        self.latest: list[np.ndarray] = []

    def poses(self) -> np.ndarray:
        """(K, 3): x, y [m], yaw [rad] of each robot."""
        angles = self._passed * SPACING_M / self._radius
        x, y = self._radius * np.cos(angles), self._radius * np.sin(angles)
        return np.column_stack([x, y, angles + np.pi / 2])

    def drive(self, landmarks: float) -> list[RobotFrame]:
        """Every robot drives past so many landmarks and looks: a frame of each."""
        before = self.poses()
        if self.latest:
            self._passed += landmarks
        self._stamp_ns += 100_000_000
        first = np.ceil(self._passed + AHEAD_M / SPACING_M).astype(int)
        count = len(self._landmarks)
        self.latest = [np.arange(n, n + self._observations) % count for n in first]
        self.seen_before = set(self.seen)
        self.seen.update(np.concatenate(self.latest).tolist())
        return [
            RobotFrame.from_camera(
                robot, self._odometry(old, new), 0.0, self._observe(new, numbers), CAMERA.mount
            )
            for robot, (old, new, numbers) in enumerate(
                zip(before, self.poses(), self.latest, strict=True)
            )
        ]

    def _odometry(self, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        u = motion.increment(before, after)
        return u + motion.standard_deviations(u, 0.0, self._noise) * self._rng.standard_normal(3)

    def _observe(self, pose: np.ndarray, numbers: np.ndarray) -> ObservationSet:
        """What the camera makes of landmarks: (14), (15), linear in the noise of the image."""
        ground = self._landmarks[numbers] - [pose[0], pose[1], 0.0]
        offset = np.array([CAMERA.mount.forward_m, CAMERA.mount.left_m, CAMERA.mount.up_m])
        body = stereo.to_map(np.array([0.0, 0.0, -pose[2]]), ground) - offset
        places = body @ stereo.CAMERA_TO_BODY
        depth = places[:, 2]
        roots = np.zeros((len(numbers), 3, 3))
        roots[:, 0, 0] = roots[:, 1, 1] = depth / CAMERA.focal_px * CAMERA.sigma_rc_px
        disparity = CAMERA.focal_px * CAMERA.baseline_m / depth
        roots[:, :, 2] = places * (CAMERA.sigma_disparity_px / disparity)[:, None]
        noise = roots @ self._rng.standard_normal((len(numbers), 3, 1))
        covariances = pack(roots @ roots.transpose(0, 2, 1))
        blur = self._rng.normal(0, DESCRIPTOR_NOISE, (len(numbers), 128))
        return ObservationSet(
            "",
            self._stamp_ns,
            (places + noise[:, :, 0]).astype(np.float32),
            covariances.astype(np.float32),
            (self._descriptors[numbers] + blur).astype(np.float32),
        )
