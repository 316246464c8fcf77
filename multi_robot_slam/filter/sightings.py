"""Robots that see robots: the poses of the team are in every particle, so a sighting ties two.

Robot i sees the `base_link` of robot j at s in its own; both have just moved. The residual

    r(x_i, x_j) = p_j - p_i - Rz(yaw_i) s   is   N(0, Rz R Rz^T),

planar: at which height a robot was seen says nothing about its pose. Given a particle's last poses,
those after the motion (7) are Gaussian and independent; each sighting is a Kalman update of their
joint belief, with N(r; 0, S) its factor of the weight. Robots are then drawn one after the other,
each given those before it: p(x_1) p(x_2 | x_1) ..., with what its camera sees of landmarks in
between. In a linear world that is exact.

A sighting outside of its gate is taken for a gross error: it changes no belief, and its factor is
the density on the gate.
"""

from typing import NamedTuple

import numpy as np

from multi_robot_slam.models.frames import NOBODY, BodySightings, RobotFrame

SMALLEST_VARIANCE = 1e-18
"""Added where a covariance is inverted: a robot that stood still has none."""


class Sighted(NamedTuple):
    """What one robot's sightings at one instant were worth to each particle."""

    seen: BodySightings
    mahalanobis_sq: np.ndarray
    """(S, M): squared Mahalanobis distance of each."""
    log_factor: np.ndarray
    """(M,): logarithm of their factor of the weight, up to a constant."""

    @classmethod
    def nothing(cls, particles: int) -> "Sighted":
        """Nobody was seen."""
        return cls(NOBODY, np.empty((0, particles)), np.zeros(particles))


class JointBelief:
    """What each particle believes of the poses of F robots that have not been drawn yet.

    Parameters
    ----------
    robots : the F robots, in the order they will be drawn.
    means : (F, 3, M) x, y [m], yaw [rad] in `map`; changed in place.
    covariances : (F, 6, M) of each robot, `xx xy xt yy yt tt`.

    """

    def __init__(self, robots: list[int], means: np.ndarray, covariances: np.ndarray):
        self._rows = {robot: 3 * i for i, robot in enumerate(robots)}
        size, particles = 3 * len(robots), means.shape[2]
        self.mean = means.reshape(size, particles)
        self.covariance = np.zeros((size, size, particles))
        for i, own in enumerate(covariances):
            rows = slice(3 * i, 3 * i + 3)
            self.covariance[rows, rows] = own[[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3, -1)

    def see(self, robot: int, seen: BodySightings, gate: float) -> Sighted:
        """Update the belief with all that `robot` saw."""
        worth = [
            self._see(self._rows[robot], self._rows[int(other)], position, noise, gate)
            for other, position, noise in zip(*seen, strict=True)
        ]
        if not worth:
            return Sighted.nothing(self.mean.shape[1])
        squared, factors = map(np.array, zip(*worth, strict=True))
        return Sighted(seen, squared, factors.sum(axis=0))

    def _see(
        self, i: int, j: int, position: np.ndarray, noise: np.ndarray, gate: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Kalman update with one sighting, in the particles where it lies inside the gate.

        Parameters
        ----------
        i, j : first row of the robot that sees and of the one that is seen.
        position : (2,) in `base_link` [m]; noise : (3,) its R, `xx xy yy` [m^2].

        Returns
        -------
        Squared Mahalanobis distance and logarithm of the weight's factor, each (M,).

        """
        mean, covariance = self.mean, self.covariance
        cos, sin = np.cos(mean[i + 2]), np.sin(mean[i + 2])
        rotation = np.array([[cos, -sin], [sin, cos]])
        turned = np.einsum("abm,b->am", rotation, position)
        residual = mean[j : j + 2] - mean[i : i + 2] - turned
        jacobian = np.zeros((2, *mean.shape))
        jacobian[[0, 1], [i, i + 1]] = -1
        jacobian[[0, 1], [j, j + 1]] = 1
        jacobian[:, i + 2] = turned[1], -turned[0]
        gain = np.einsum("abm,cbm->acm", covariance, jacobian)  # P H^T
        spread = np.einsum("abm,bcm->acm", jacobian, gain)
        spread += np.einsum("abm,bc,dcm->adm", rotation, noise[[[0, 1], [1, 2]]], rotation)
        inverse, determinant = _inverted(spread)
        squared = np.einsum("am,abm,bm->m", residual, inverse, residual)
        step = np.einsum("abm,bcm->acm", gain, inverse * (squared <= gate))
        mean -= np.einsum("abm,bm->am", step, residual)
        covariance -= np.einsum("abm,cbm->acm", step, gain)
        return squared, -0.5 * (np.minimum(squared, gate) + np.log(determinant))

    def of(self, robot: int) -> tuple[np.ndarray, np.ndarray]:
        """Mean (3, M) and covariance (6, M) of one robot, `xx xy xt yy yt tt`."""
        rows = slice(self._rows[robot], self._rows[robot] + 3)
        return self.mean[rows], self.covariance[rows, rows][[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]

    def fix(self, robot: int, poses: np.ndarray) -> None:
        """Robot was drawn at `poses` (3, M): what the others are believed to be given that."""
        rows = slice(self._rows[robot], self._rows[robot] + 3)
        own = self.covariance[rows, rows] + SMALLEST_VARIANCE * np.eye(3)[:, :, None]
        shared = self.covariance[:, rows].transpose(2, 0, 1)
        gain = np.linalg.solve(own.transpose(2, 0, 1), shared.transpose(0, 2, 1))
        self.mean += np.einsum("mba,bm->am", gain, poses - self.mean[rows])
        self.covariance -= np.einsum("mba,mcb->acm", gain, shared)


def _inverted(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse (2, 2, M) and determinant (M,) of symmetric (2, 2, M)."""
    (a, b), (_, d) = matrices
    determinant = a * d - b * b
    return np.array([[d, -b], [-b, a]]) / determinant, determinant


def see_all(
    frames: list[RobotFrame], poses: np.ndarray, priors: np.ndarray, gate: float
) -> tuple[JointBelief | None, list[Sighted]]:
    """The joint belief of the robots of F `frames` after all they saw of each other.

    Parameters
    ----------
    poses : (K, 3, M) of the whole team; priors : (F, 6, M) covariance of each frame's robot.

    Returns
    -------
    The belief, None where nobody saw anybody, and what each frame's sightings were worth.
    `ValueError` when a robot sees one that has no frame among these.

    """
    if not any(len(frame.sightings.others) for frame in frames):
        return None, [Sighted.nothing(poses.shape[2])] * len(frames)
    robots = [frame.robot for frame in frames]
    joint = JointBelief(robots, poses[robots], priors.astype(float))
    return joint, [joint.see(frame.robot, frame.sightings, gate) for frame in frames]
