"""What is known before a problem's first frames: one joint Gaussian of anchors and centres.

A robot's anchor is its pose where the window of frames begins. Given all that left the window a
landmark is a Gaussian l ~ N(k, Lambda^-1), independent of the others; its centre k is uncertain
because the path that it was seen from is. Anchors and centres share one covariance. Heights hardly
depend on a path in the plane: a centre's z is known.

In a problem a centre is like a pose that never turns and from which the landmark is observed once,
at (0, 0, k_z), with the information Lambda.
"""

from typing import NamedTuple

import numpy as np

from multi_robot_slam.models.frames import Start
from multi_robot_slam.smoothing.lapack import whitener

SMALLEST_SIGMA = 1e-5
"""Floor of standard deviations of poses and of odometry [m, rad].

A robot that stood still has exact odometry; the information must stay finite all the same. A
hundredth of a millimetre is nothing beside what any camera sees.
"""


class Active(NamedTuple):
    """The part of a prior that a problem holds: A anchors, a centres, the rest marginalised out."""

    robots: np.ndarray
    """(A,) int64: robots whose anchors they are, ascending."""
    rows: np.ndarray
    """(a,) int64: which of the prior's centres."""
    ids: np.ndarray
    """(a,) int64: landmark of each centre."""
    poses: np.ndarray
    """(A, 3) float64: mean of the anchors."""
    centres: np.ndarray
    """(a, 3) float64: mean of the centres [m]."""
    landmark_information: np.ndarray
    """(a, 6) float64: Lambda of each [1/m^2]."""
    whitener: np.ndarray
    """(3 A + 2 a, 3 A + 2 a) float64: W, lower triangle, of anchors and centres: W P W^T = I."""
    information: np.ndarray
    """(3 A + 2 a, 3 A + 2 a) float64: W^T W, the inverse of their joint covariance P."""


class Prior(NamedTuple):
    """K anchors and the centres of n landmarks."""

    poses: np.ndarray
    """(K, 3) float64: mean of each robot's anchor, x, y [m], yaw [rad] in `map`."""
    ids: np.ndarray
    """(n,) int64: landmark of each centre. Landmarks that were joined have several."""
    centres: np.ndarray
    """(n, 3) float64: mean in `map` [m]."""
    information: np.ndarray
    """(n, 6) float64: Lambda, the landmark's information given its centre [1/m^2]."""
    covariance: np.ndarray
    """(3 K + 2 n, 3 K + 2 n) float64: anchors x, y, yaw by robot, then centres x, y."""

    @classmethod
    def exact(cls, start_poses: np.ndarray) -> "Prior":
        """No landmarks, and start poses (K, 3) that are known."""
        poses = np.array(start_poses, float)
        covariance = SMALLEST_SIGMA**2 * np.eye(poses.size)
        return cls(poses, np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 6)), covariance)

    def starting(self, robot: int, start: Start) -> "Prior":
        """With the anchor of `robot` where it starts, of which nothing else tells."""
        poses, covariance = self.poses.copy(), self.covariance.copy()
        own = 3 * robot + np.arange(3)
        poses[robot] = start.mean
        covariance[own], covariance[:, own] = 0, 0
        covariance[np.ix_(own, own)] = start.covariance + SMALLEST_SIGMA**2 * np.eye(3)
        return self._replace(poses=poses, covariance=covariance)

    def with_another(self, start: Start) -> "Prior":
        """With another robot after the others, which starts there."""
        count = self.poses.size
        rows = np.insert(np.arange(len(self.covariance)), count, [-1, -1, -1])
        covariance = self.covariance[np.ix_(rows, rows)]
        result = self._replace(poses=np.vstack([self.poses, start.mean]), covariance=covariance)
        return result.starting(len(self.poses), start)

    def rows(self, robots: np.ndarray, centres: np.ndarray) -> np.ndarray:
        """(3 A + 2 a,) rows in the covariance of robots' (A,) anchors, then of centres (a,)."""
        of_robots = 3 * robots[:, None] + np.arange(3)
        return np.append(of_robots, self.poses.size + 2 * centres[:, None] + np.arange(2))

    def active(self, robots: np.ndarray, centres: np.ndarray) -> Active:
        """The part with the anchors of `robots` (A,) and with `centres` (a,), rows of `ids`.

        `LinAlgError` if the covariance is not positive definite.
        """
        rows = self.rows(robots, centres)
        return Active(
            robots,
            centres,
            self.ids[centres],
            self.poses[robots],
            self.centres[centres],
            self.information[centres],
            *whitener(self.covariance[np.ix_(rows, rows)]),
        )

    def renamed(self, ids: np.ndarray) -> "Prior":
        """With other `ids` (n,): what joined landmarks go by."""
        return self._replace(ids=ids.astype(np.int64))

    def forget(self, ids: np.ndarray) -> "Prior":
        """Without the landmarks `ids`."""
        return self.of(np.flatnonzero(~np.isin(self.ids, ids)))

    def of(self, centres: np.ndarray) -> "Prior":
        """With those of the centres (a,), rows of `ids`, alone, in that order."""
        rows = self.rows(np.arange(len(self.poses)), centres)
        return Prior(
            self.poses,
            self.ids[centres],
            self.centres[centres],
            self.information[centres],
            self.covariance[np.ix_(rows, rows)],
        )
