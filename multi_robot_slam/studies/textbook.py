"""FastSLAM as textbooks write it: particle objects, loops in Python, small matrices.

For the benchmark alone. After Thrun, Burgard, Fox: Probabilistic Robotics (2005), chapter 13, with
unknown correspondence decided as in Algorithm 1: of the landmarks inside the gate (18) the one
whose descriptor is closest (19).
"""

from dataclasses import dataclass, field

import numpy as np

from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.models import motion
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.models.symmetric import unpack


@dataclass
class Landmark:
    """A small extended Kalman filter: `mean` (3,) [m], `covariance` (3, 3) [m^2], in `map`."""

    mean: np.ndarray
    covariance: np.ndarray
    descriptor: np.ndarray


@dataclass
class Particle:
    """One hypothesis: `poses`, K times (3,), and the map that goes with them."""

    poses: list[np.ndarray]
    landmarks: list[Landmark] = field(default_factory=list)
    log_weight: float = 0.0


def update_particles(
    particles: list[Particle],
    frame: RobotFrame,
    settings: FilterSettings,
    normals: np.ndarray,
) -> list[list[int]]:
    """Predict, associate, update and weigh; returns which landmark each observation updated.

    Parameters
    ----------
    normals : (3, M) standard normal draws of the motion noise.

    Returns
    -------
    For each particle B indices into its landmarks; a new one is the last of its time.

    """
    covariances = unpack(frame.covariances)
    sigma = motion.standard_deviations(frame.motion, frame.seconds, settings.motion, frame.extra)
    matches = []
    for particle, normal in zip(particles, normals.T, strict=True):
        pose = predict(particle.poses[frame.robot], frame.motion + sigma * normal)
        particle.poses[frame.robot] = pose
        rotation, position = base_link(pose)
        chosen = []
        for v, R, d in zip(frame.positions, covariances, frame.descriptors, strict=True):
            n = associate(particle.landmarks, rotation, position, v, R, d, settings)
            if n is None:
                n = len(particle.landmarks)
                particle.landmarks.append(create(rotation, position, v, R, d))
                log_weight = log_likelihood(settings.gate, R)
            else:
                log_weight = correct(particle.landmarks[n], rotation, position, v, R)
            particle.log_weight += log_weight
            chosen.append(n)
        matches.append(chosen)
    return matches


def predict(pose: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The pose (3,) after the motion `u` (3,)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return pose + np.array([c * u[0] - s * u[1], s * u[0] + c * u[1], u[2]])


def base_link(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) from `base_link` to the map and position (3,) of the robot."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return rotation, np.array([pose[0], pose[1], 0.0])


def associate(
    landmarks: list[Landmark],
    rotation: np.ndarray,
    position: np.ndarray,
    v: np.ndarray,
    R: np.ndarray,
    d: np.ndarray,
    settings: FilterSettings,
) -> int | None:
    """Index of the landmark an observation is of; None: of none in the map."""
    best, least = None, settings.descriptor_gate
    for n, landmark in enumerate(landmarks):
        innovation, Z = innovate(landmark, rotation, position, v, R)
        if innovation @ np.linalg.inv(Z) @ innovation > settings.gate:  # (18)
            continue
        difference = d - landmark.descriptor
        distance = difference @ difference  # (19)
        if distance < least or (best is None and distance == least):
            best, least = n, distance
    return best


def innovate(
    landmark: Landmark, rotation: np.ndarray, position: np.ndarray, v: np.ndarray, R: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Innovation (3,) and its covariance Z (3, 3), in `base_link` (8)-(10)."""
    H = rotation.T
    return v - H @ (landmark.mean - position), H @ landmark.covariance @ H.T + R


def correct(
    landmark: Landmark, rotation: np.ndarray, position: np.ndarray, v: np.ndarray, R: np.ndarray
) -> float:
    """Kalman update (11)-(13) of a landmark, in place; returns the log weight (16)."""
    innovation, Z = innovate(landmark, rotation, position, v, R)
    H, inverse = rotation.T, np.linalg.inv(Z)
    K = landmark.covariance @ H.T @ inverse
    landmark.mean = landmark.mean + K @ innovation
    landmark.covariance = (np.eye(3) - K @ H) @ landmark.covariance
    return log_likelihood(innovation @ inverse @ innovation, Z)


def create(
    rotation: np.ndarray, position: np.ndarray, v: np.ndarray, R: np.ndarray, d: np.ndarray
) -> Landmark:
    """A landmark where an observation puts it."""
    return Landmark(position + rotation @ v, rotation @ R @ rotation.T, d)


def log_likelihood(squared: float, Z: np.ndarray) -> float:
    """Logarithm of (16) for the squared Mahalanobis distance `squared`."""
    return -0.5 * squared - 0.5 * np.log(np.linalg.det(2 * np.pi * Z))
