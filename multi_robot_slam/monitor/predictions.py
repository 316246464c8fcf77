"""Where the filter expects what a frame sees to be, before it has used the frame.

Truth and particles are draws from one posterior, so the innovation v' - E[l'] of an observation of
a landmark that lies at l' in `base_link` is N(0, S),

    S = cov(E[l' | particle]) + E[cov(l' | particle)] + H Q H^T + R',

with Q of the motion (7), and D = nu^T S^-1 nu is chi2 with three degrees of freedom. In the robot's
own frame, for what a particle errs in pose and landmark alike is no error there.
"""

from typing import NamedTuple

import numpy as np

from multi_robot_slam.filter import resampling
from multi_robot_slam.filter.kernels import FAR, are_usable
from multi_robot_slam.filter.relative import relative_moments
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.filter.state import State
from multi_robot_slam.models import motion
from multi_robot_slam.models.descriptors import squared_distances
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.models.parallel import one_thread
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.smoothing.odometry_scale import scaled

PARTICLES = 128
"""Particles that are asked: a covariance of three numbers then errs by 12 % (one sigma)."""

MOST_OBSERVATIONS = 64
"""Observations of a frame that are looked at: products with all landmarks take their time."""


class Predictions(NamedTuple):
    """P pairs of an observation and a landmark anywhere in the robot's piece that looks like it."""

    observations: np.ndarray
    """(P,) int: row in the frame, ascending."""
    ids: np.ndarray
    """(P,) int32: of the landmark."""
    mahalanobis_sq: np.ndarray
    """(P,): D."""
    expected: np.ndarray
    """(P, 3): where the landmark is expected, in `base_link` [m]."""
    observed: np.ndarray
    """(P, 3): v' [m]."""
    sigmas: np.ndarray
    """(P,): standard deviation of the innovation in the plane, root of the mean variance [m]."""
    pose: np.ndarray
    """(3,): where the robot is expected, x, y [m], yaw [rad] in `map`."""
    next_id: int
    """Landmarks of this frame and later ones have ids from here on."""

    @classmethod
    def none(cls) -> "Predictions":
        """Nothing is expected."""
        numbers, points = np.empty(0), np.empty((0, 3))
        return cls(
            numbers.astype(int), numbers.astype(np.int32), numbers, points, points, numbers,
            np.zeros(3), 0,
        )  # fmt: skip

    def with_noise(self, factor: float) -> "Predictions":
        """With `factor` times all standard deviations."""
        squared, sigmas = self.mahalanobis_sq / factor**2, factor * self.sigmas
        return self._replace(mahalanobis_sq=squared, sigmas=sigmas)

    def only(self, rows: np.ndarray) -> "Predictions":
        """Some of the pairs, by index or as booleans."""
        return self._replace(
            observations=self.observations[rows],
            ids=self.ids[rows],
            mahalanobis_sq=self.mahalanobis_sq[rows],
            expected=self.expected[rows],
            observed=self.observed[rows],
            sigmas=self.sigmas[rows],
        )

    def oldest(self) -> "Predictions":
        """Of each observation the pair with the oldest landmark."""
        order = np.lexsort((self.ids, self.observations))
        _, first = np.unique(self.observations[order], return_index=True)
        return self.only(order[first])

    def nearest(self) -> np.ndarray:
        """The least D of each observation that has a pair."""
        _, first = np.unique(self.observations, return_index=True)
        return (
            np.minimum.reduceat(self.mahalanobis_sq, first) if len(first) else first.astype(float)
        )

    def in_map(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where the points are seen (P, 2), where they are expected (P, 2), and `sigmas`."""
        (x, y, yaw) = self.pose
        cos, sin = np.cos(yaw), np.sin(yaw)
        turned = np.array([[cos, sin], [-sin, cos]])
        seen, expected = (p[:, :2] @ turned + [x, y] for p in (self.observed, self.expected))
        return seen, expected, self.sigmas


@one_thread
def predict(state: State, frame: RobotFrame, settings: FilterSettings) -> Predictions:
    """What `state`, which is only read, expects of `frame`; nothing where it is not usable."""
    landmarks = state.landmarks
    frame = frame.with_noise(state.noise.used[frame.robot, 1])
    if not are_usable(frame.positions, frame.covariances, FAR / 2):
        return Predictions.none()
    alive = landmarks.alive()
    alive = alive[landmarks.pieces[alive] == state.pieces.of_robots[frame.robot]]
    chosen = _spread(len(frame.positions), MOST_OBSERVATIONS)
    alike = squared_distances(frame.descriptors[chosen], landmarks.descriptors[alive])
    pairs, found = np.nonzero(alike <= settings.descriptor_gate)
    rows, columns = chosen[pairs], alive[found]
    particles = _spread(settings.particles, PARTICLES)
    poses = state.poses[frame.robot][:, particles]
    if frame.start is not None:
        poses[:] = frame.start.mean[:, None]
    weights = resampling.normalise(state.log_weights[particles])
    motion.move(poses, scaled(frame.motion, state.scales.factors[frame.robot])[:, None])
    mean = poses @ weights
    moments, shares = np.empty((len(rows), 15)), np.empty(len(rows))
    seen = np.array([np.cos(poses[2]), np.sin(poses[2]), poses[0], poses[1]])
    where = landmarks.rows_of(columns, particles)
    relative_moments(landmarks.planes, columns, where, seen, weights, FAR / 2, moments, shares)
    is_held = shares > 0.5
    rows, columns, moments = rows[is_held], columns[is_held], moments[is_held]
    expected = moments[:, :3]
    spread = unpack(moments[:, 3:9] + moments[:, 9:] + frame.covariances[rows])
    factor = state.noise.used[frame.robot, 0]
    spread += _of_pose(expected, _pose_covariance(frame, settings, factor, mean[2]))
    innovations = frame.positions[rows] - expected
    squared = np.einsum(
        "pi,pi->p", innovations, np.linalg.solve(spread, innovations[..., None])[..., 0]
    )
    sigmas = np.sqrt(0.5 * (spread[:, 0, 0] + spread[:, 1, 1]))
    return Predictions(
        rows,
        landmarks.ids[columns],
        squared,
        expected,
        frame.positions[rows],
        sigmas,
        mean,
        landmarks.next_id,
    )


def _pose_covariance(
    frame: RobotFrame, settings: FilterSettings, factor: float, yaw: float
) -> np.ndarray:
    """Q (3, 3) of the pose that the motion (7) led to, in its own frame; at the start, of that."""
    xx, xy, yy, turn = motion.spread(
        frame.motion, frame.seconds, settings.motion, frame.extra, factor
    )
    result = np.array([[xx, xy, 0], [xy, yy, 0], [0, 0, turn]])
    if frame.start is not None:
        cos, sin = np.cos(yaw), np.sin(yaw)
        turned = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        result += turned @ frame.start.covariance @ turned.T
    return result


def _of_pose(expected: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """H Q H^T (P, 3, 3): what the pose's covariance adds at the `expected` places (P, 3)."""
    by_pose = np.zeros((len(expected), 3, 3))
    by_pose[:, 0, 0] = by_pose[:, 1, 1] = -1
    by_pose[:, 0, 2], by_pose[:, 1, 2] = expected[:, 1], -expected[:, 0]
    return by_pose @ covariance @ by_pose.transpose(0, 2, 1)


def _spread(count: int, most: int) -> np.ndarray:
    """At most `most` of the numbers below `count`, evenly."""
    kept = min(count, most)
    return np.arange(kept) * count // max(kept, 1)
