"""Algorithm 1 of the paper, transcribed line by line: slow, obvious, and the filter's oracle.

It shares nothing with the filter but the vocabulary. Where the paper leaves something open it
takes the same decision as docs/design.md: a new landmark's covariance is (G^T R^-1 G)^-1, its
weight p_0 the density on the gate, logarithms instead of products, systematic resampling, and one
candidate after another within a frame (B > 1). Observations are in the camera frame.
"""

import copy
from dataclasses import dataclass, field

import numpy as np


@dataclass
class Landmark:
    """l_n = {mu, Sigma, d} and an id of the observation (t, i, b) that created it."""

    mu: np.ndarray
    sigma: np.ndarray
    d: np.ndarray
    origin: tuple


@dataclass
class Particle:
    """S^[m] (6)."""

    poses: list
    landmarks: list = field(default_factory=list)
    log_weight: float = 0.0
    log_weight_sum: float = 0.0


@dataclass
class Model:
    """Constants of the algorithm."""

    D_0: float
    E_0: float
    mount: tuple
    """forward, left, up of the left camera [m]."""
    sigmas: tuple
    """after 1 m: forward, left, yaw; after 1 rad: yaw."""


def camera_axes(yaw):
    """Columns: the camera's X (right), Y (up), Z (forward) in the map."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[s, 0, c], [-c, 0, s], [0, 1, 0]])


def camera_position(pose, mount):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array(
        [
            pose[0] + c * mount[0] - s * mount[1],
            pose[1] + s * mount[0] + c * mount[1],
            mount[2],
        ]
    )


def g(pose, mu, model):  # (8)
    return camera_axes(pose[2]).T @ (mu - camera_position(pose, model.mount))


def g_inverse(pose, v, model):
    return camera_position(pose, model.mount) + camera_axes(pose[2]) @ v


def G(pose):  # (9)
    return camera_axes(pose[2]).T


def sample_motion_model(pose, u, normals, model):  # (7)
    forward, left, yaw_m, yaw_rad = model.sigmas
    distance, turn = np.hypot(u[0], u[1]), abs(u[2])
    variances = [forward**2 * distance, left**2 * distance, yaw_m**2 * distance + yaw_rad**2 * turn]
    sigma = np.sqrt(variances)
    dx, dy, dyaw = u + np.multiply(sigma, normals)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([pose[0] + c * dx - s * dy, pose[1] + s * dx + c * dy, pose[2] + dyaw])


def fast_slam_mr(S, robot, z, R, u, normals, model, step):
    """Lines 12-42 for one robot. z = (v (B, 3), d (B, 128)); normals (3, M). Returns c (M, B)."""
    choices = []
    for m, particle in enumerate(S):
        pose = sample_motion_model(particle.poses[robot], u, normals[:, m], model)  # line 14
        particle.poses[robot] = pose
        choices.append(
            [
                integrate(particle, pose, v, d, R_b, model, (step, robot, b))
                for b, (v, d, R_b) in enumerate(zip(*z, R, strict=True))
            ]
        )
    return choices


def integrate(particle, pose, v, d, R, model, origin):
    """Lines 15-39 for one observation; returns the origin of the landmark c_t, D and E."""
    D, E = [], []
    for landmark in particle.landmarks:  # line 15
        nu = v - g(pose, landmark.mu, model)  # line 16
        Z = G(pose) @ landmark.sigma @ G(pose).T + R  # line 18
        D.append(nu @ np.linalg.inv(Z) @ nu)  # line 19
        E.append((d - landmark.d) @ (d - landmark.d))  # line 20
    candidates = [n for n in range(len(D)) if D[n] <= model.D_0]  # line 23
    c = min(candidates, key=lambda n: E[n], default=None)  # line 24
    if c is None or E[c] > model.E_0:  # lines 25-27
        sigma = np.linalg.inv(G(pose).T @ np.linalg.inv(R) @ G(pose))  # line 31, inverted
        particle.landmarks.append(Landmark(g_inverse(pose, v, model), sigma, d, origin))  # line 30
        weigh(particle, model.D_0, R)  # line 32
        return origin, np.nan, np.nan
    landmark = particle.landmarks[c]
    nu = v - g(pose, landmark.mu, model)
    Z = G(pose) @ landmark.sigma @ G(pose).T + R
    K = landmark.sigma @ G(pose).T @ np.linalg.inv(Z)  # line 35
    landmark.mu = landmark.mu + K @ nu  # line 36
    landmark.sigma = (np.eye(3) - K @ G(pose)) @ landmark.sigma  # line 37
    weigh(particle, D[c], Z)  # line 39
    return landmark.origin, D[c], E[c]


def weigh(particle, D, Z):  # (16)
    log_density = -0.5 * D - 0.5 * np.log(np.linalg.det(2 * np.pi * Z))
    particle.log_weight += log_density
    particle.log_weight_sum += log_density  # (17)


def importance_resampling(S, uniform):
    """Line 10, systematic: particle m gets floor or ceil of M times its weight copies."""
    weights = np.exp([p.log_weight - max(q.log_weight for q in S) for p in S])
    cumulative = np.cumsum(weights / weights.sum())
    cumulative[-1] = 1.0
    chosen = [int(np.argmax(cumulative > (n + uniform) / len(S))) for n in range(len(S))]
    survivors = [copy.deepcopy(S[m]) for m in chosen]
    for particle in survivors:
        particle.log_weight = 0.0
    return survivors, chosen


def best(S):  # (17)
    return int(np.argmax([p.log_weight_sum for p in S]))


def run(steps, starts, settings, mount, rng):
    """Lines 1-11 over `steps` (lists of RobotFrame): S and the choices c of each frame.

    Draws in the filter's order: normals (3, M) for each frame, one uniform for each step.
    """
    model = Model(
        settings.gate,
        settings.descriptor_gate,
        (mount.forward_m, mount.left_m, mount.up_m),
        tuple(vars(settings.motion).values())[:4],
    )
    S = [Particle([np.array(pose, float) for pose in starts]) for _ in range(settings.particles)]
    choices = []
    for t, frames in enumerate(steps):
        for frame in frames:
            seen = frame.observations
            z = (seen.positions.astype(float), seen.descriptors.astype(float))
            R = seen.covariances.astype(float)[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
            normals = rng.standard_normal((3, settings.particles))
            choices.append(fast_slam_mr(S, frame.robot, z, R, frame.motion, normals, model, t))
        S, _ = importance_resampling(S, rng.random())
    return S, choices
