"""Which observations are of one point, found from true poses.

Real images name no landmarks. With the true pose of the camera each observation is a point in
`map`, and two of them are of one landmark where these points agree within their covariances and the
truth's own error, and the descriptors are not plainly of different things. Descriptors decide only
between points in one place, such as keypoints of two sizes round one corner.
"""

import numpy as np

from multi_robot_slam.datasets.levelling import Cloud
from multi_robot_slam.models.symmetric import unpack

GATE = 16.27
"""Squared Mahalanobis distance of two sightings of one point; 99.9 % of chi2 with 3 dof."""

ALIKE = 0.6
"""Squared descriptor distance beyond which two points in one place are different things: where
those of one and of several meet (`study descriptors`)."""

PLACE_SIGMA_M = 0.01
"""Error of a true place, in each direction."""
ANGLE_SIGMA_RAD = 0.003
"""Error of a true attitude: it moves a point by so much of its distance."""


class Identities:
    """Numbers landmarks in the order in which they are first seen; frames come by time."""

    def __init__(self) -> None:
        self.positions = np.empty((0, 3))
        """(N, 3) mean of what was seen of each landmark, in `map` [m]."""
        self._covariances = np.empty((0, 3, 3))
        self.descriptors = np.empty((0, 128), np.float32)
        """(N, 128) of each when it was first seen."""
        self._last = np.empty((0, 128), np.float32)

    def __len__(self) -> int:
        return len(self.positions)

    def of(self, cloud: Cloud, place: np.ndarray) -> np.ndarray:
        """(B,) uint32: the landmarks of one frame's points in `map`, seen from `place` (3,)."""
        distances = np.linalg.norm(cloud.positions - place, axis=1)
        slack = PLACE_SIGMA_M**2 + (ANGLE_SIGMA_RAD * distances) ** 2
        covariances = unpack(cloud.covariances) + slack[:, None, None] * np.eye(3)
        rows, landmarks = self._candidates(cloud.positions, covariances)
        alike = self._alike(cloud.descriptors[rows], landmarks)
        found = _one_to_one(rows, landmarks, alike, len(cloud.positions))
        known = found >= 0
        self._update(found[known], cloud.positions[known], covariances[known])
        self._last[found[known]] = cloud.descriptors[known]
        found[~known] = self._add(
            cloud.positions[~known], covariances[~known], cloud.descriptors[~known]
        )
        return found.astype(np.uint32)

    def _candidates(
        self, positions: np.ndarray, covariances: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows and landmarks (P,) of the pairs within the gate."""
        difference = positions[:, None] - self.positions
        variances = [np.diagonal(c, axis1=1, axis2=2) for c in (covariances, self._covariances)]
        reach = GATE * (variances[0][:, None] + variances[1])
        rows, landmarks = np.nonzero((difference**2 <= reach).all(axis=2))
        apart = difference[rows, landmarks]
        both = covariances[rows] + self._covariances[landmarks]
        squared = np.einsum("pi,pi->p", apart, np.linalg.solve(both, apart[..., None])[..., 0])
        inside = squared <= GATE
        return rows[inside], landmarks[inside]

    def _alike(self, descriptors: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
        """(P,) squared distance to the first or the last descriptor of each, whichever is less."""
        first, last = (
            2 - 2 * np.einsum("pi,pi->p", descriptors, known[landmarks])
            for known in (self.descriptors, self._last)
        )
        return np.minimum(first, last)

    def _update(
        self, landmarks: np.ndarray, positions: np.ndarray, covariances: np.ndarray
    ) -> None:
        """The Kalman filter's (10) to (13)."""
        before = self._covariances[landmarks]
        gain = before @ np.linalg.inv(before + covariances)
        innovation = positions - self.positions[landmarks]
        self.positions[landmarks] += np.einsum("pij,pj->pi", gain, innovation)
        self._covariances[landmarks] = gain @ covariances

    def _add(
        self, positions: np.ndarray, covariances: np.ndarray, descriptors: np.ndarray
    ) -> np.ndarray:
        """The numbers of new landmarks."""
        numbers = len(self) + np.arange(len(positions))
        self.positions = np.concatenate([self.positions, positions])
        self._covariances = np.concatenate([self._covariances, covariances])
        self.descriptors = np.concatenate([self.descriptors, descriptors])
        self._last = np.concatenate([self._last, descriptors])
        return numbers


def _one_to_one(
    rows: np.ndarray, landmarks: np.ndarray, distances: np.ndarray, count: int
) -> np.ndarray:
    """(count,) int64: the landmark of each row, most alike pairs first, each used once; else -1."""
    found = np.full(count, -1, np.int64)
    taken: set[int] = set()
    for pair in np.argsort(distances, kind="stable").tolist():
        row, landmark = int(rows[pair]), int(landmarks[pair])
        if distances[pair] <= ALIKE and found[row] < 0 and landmark not in taken:
            found[row] = landmark
            taken.add(landmark)
    return found
