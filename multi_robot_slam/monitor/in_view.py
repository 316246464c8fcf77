"""Is what a robot has just seen, and must still have in view, seen again?

A robot that was carried to a place where nobody has been sees nothing that contradicts the map. But
landmarks of its last keyframe, moved by its odometry, that lie well inside of where it has seen
landmarks so far, are mostly seen again. Their share s / n varies more than by chance alone, for a
wall hides many at once: it is taken for beta-binomial (a, b), with the mean m of the robot's own
frames and

    var(share) = m (1 - m) (r + (1 - r) / n),   a = m (1 / r - 1),   b = (1 - m) (1 / r - 1)

with the correlation r between landmarks of one frame. Where the share is very small, the landmarks
stay in mind, and the next frames are asked for them, too.
"""

from collections import deque

import numpy as np
from scipy.special import betaln, gammaln

from msg_defs.types import CameraMount
from multi_robot_slam.models.descriptors import squared_distances
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.monitor.evidence import Evidence, log_e_value
from multi_robot_slam.monitor.predictions import Predictions
from multi_robot_slam.monitor.recognition import p_value

LEAST = 6
"""Landmarks that must be in view to be asked, and that the frame must see."""

LEAST_FRAMES = 10
"""Frames after which a robot's share is known."""

CORRELATION = 0.2
"""r. In the simulated building it is 0.1; larger is more careful."""

SUSPECT = 0.1
"""Share seen again up to which the landmarks stay in mind. What a wall hides it hides in the next
frame, too, so that the law alone would not do for these: of 6016 frames of 24 simulated
explorations that were as told none saw less than a quarter again."""

REMEMBERED = 30
"""Frames by which it is known where a robot sees landmarks."""

RARE = 0.05
"""Share of the directions and distances that is left out at each side: random ones, and edges."""

MARGIN = 0.1
"""Share of the range of the others that is left out, too: what lies near an edge may have left."""

FARTHEST_M, FARTHEST_RAD = 1.0, 0.5
"""A longer way between two keyframes leaves little in view of what was."""


class InView:
    """The last landmarks that one robot saw, and where it sees landmarks at all.

    Parameters
    ----------
    camera : where its camera sits, and looks.
    alike : E_0.

    """

    def __init__(self, camera: CameraMount, alike: float) -> None:
        self.evidence = Evidence()
        self.seen, self.expected = 0, 0
        """Of those in view, in the last frame that was asked."""
        self._camera, self._alike = camera, alike
        self._positions = np.empty((0, 3))
        self._descriptors = np.empty((0, 0), np.float32)
        self._sum_of_shares, self._frames = 0.0, 0
        """Over the frames that were asked and not suspect."""
        self._directions: deque[np.ndarray] = deque(maxlen=REMEMBERED)

    def note(self, frame: RobotFrame) -> bool:
        """Take a keyframe; True when the landmarks in view are newly missed, beyond doubt."""
        was_alarming = self.evidence.is_alarming
        self._move(frame.motion)
        is_near = np.hypot(*frame.motion[:2]) <= FARTHEST_M and abs(frame.motion[2]) <= FARTHEST_RAD
        in_view = self._in_view()
        is_suspect = False
        if is_near and np.count_nonzero(in_view) >= LEAST and len(frame.positions) >= LEAST:
            is_suspect = self._ask(in_view, frame.descriptors)
        if is_suspect:
            self._positions, self._descriptors = (
                self._positions[in_view],
                self._descriptors[in_view],
            )
        else:
            self._positions, self._descriptors = frame.positions, frame.descriptors
            if not self.evidence.is_alarming:
                self.evidence.add(-np.inf)
        self._directions.append(self._seen_at(frame.positions))
        return self.evidence.is_alarming and not was_alarming

    @property
    def share(self) -> float:
        """Of those in view in the last frame that was asked, which were seen again."""
        return self.seen / self.expected if self.expected else 1.0

    def confirm(self, known: Predictions) -> None:
        """Older landmarks that are seen where they are known to be end an alarm."""
        p = p_value(known)
        if p is not None:
            self.evidence.add(min(log_e_value(p), 0.0))

    def _ask(self, in_view: np.ndarray, descriptors: np.ndarray) -> bool:
        """Judge the share seen again; whether it is so small that they stay in mind."""
        distances = squared_distances(self._descriptors[in_view], descriptors)
        self.seen = int(np.count_nonzero((distances <= self._alike).any(axis=1)))
        self.expected = int(np.count_nonzero(in_view))
        if self._frames >= LEAST_FRAMES and self.share <= SUSPECT:
            mean = self._sum_of_shares / self._frames
            self.evidence.add(log_e_value(beta_binomial_tail(self.seen, self.expected, mean)))
            return True
        self._sum_of_shares += self.share
        self._frames += 1
        return False

    def _move(self, motion: np.ndarray) -> None:
        """What was seen, from where the robot is now."""
        cos, sin = np.cos(motion[2]), np.sin(motion[2])
        ahead, aside = self._positions[:, 0] - motion[0], self._positions[:, 1] - motion[1]
        moved = [cos * ahead + sin * aside, cos * aside - sin * ahead, self._positions[:, 2]]
        self._positions = np.stack(moved, axis=1)

    def _in_view(self) -> np.ndarray:
        if not len(self._positions):
            return np.empty(0, bool)
        known = np.sort(np.concatenate(self._directions), axis=0)
        rare = int(RARE * len(known))
        low, high = known[rare], known[-1 - rare]
        margin = MARGIN * (high - low)
        seen = self._seen_at(self._positions)
        return ((seen >= low + margin) & (seen <= high - margin)).all(axis=1)

    def _seen_at(self, positions: np.ndarray) -> np.ndarray:
        """(n, 3) to the left [rad], up (tangent), and the distance [m], from the camera."""
        camera = self._camera
        x, y, up = (positions - [camera.forward_m, camera.left_m, camera.up_m]).T
        cos, sin = np.cos(camera.yaw_rad), np.sin(camera.yaw_rad)
        ahead, left, distance = cos * x + sin * y, cos * y - sin * x, np.hypot(x, y)
        return np.stack(
            [np.arctan2(left, ahead), up / np.maximum(distance, 1e-6), distance], axis=1
        )


def beta_binomial_tail(seen: int, expected: int, mean: float) -> float:
    """P(at most `seen` of `expected`), the share's mean being `mean`."""
    mean = min(max(mean, 0.01), 0.99)
    strength = (1 - CORRELATION) / CORRELATION
    a, b = mean * strength, (1 - mean) * strength
    k = np.arange(seen + 1)
    ways = gammaln(expected + 1) - gammaln(k + 1) - gammaln(expected - k + 1)
    logs = ways + betaln(k + a, expected - k + b) - betaln(a, b)
    return float(min(1.0, np.exp(logs).sum()))
