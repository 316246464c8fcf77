"""The informed proposal, one particle and one observation at a time, with dense matrices.

The slow twin of `multi_robot_slam.filter.informed_kernels`; it shares Algorithm 1's landmarks and
weights with `literal_algorithm1`, and like the fast one matches only landmarks older than the
frame.
"""

import literal_algorithm1 as literal
import numpy as np


def fast_slam_2(S, robot, z, R, u, normals, model, step):
    """One robot's frame for all particles; normals (3, M). Returns the matches' origins."""
    return [
        propose(particle, robot, z, R, u, normals[:, m], model, step)
        for m, particle in enumerate(S)
    ]


def propose(particle, robot, z, R, u, normals, model, step):
    before = particle.poses[robot]
    x = literal.sample_motion_model(before, u, np.zeros(3), model)
    P = motion_covariance(before, x, u, model)
    matches, log_weight = [], 0.0
    for v, d, R_b in zip(*z, R, strict=True):
        best, x, P, log_density = believe(particle.landmarks, x, P, v, d, R_b, model)
        matches.append(best)
        log_weight += log_density
    pose = x + np.linalg.cholesky(P + 1e-18 * np.eye(3)) @ normals
    particle.poses[robot] = pose
    particle.log_weight += log_weight
    particle.log_weight_sum += log_weight
    for b, (v, d, R_b) in enumerate(zip(*z, R, strict=True)):
        if matches[b] is None:
            sigma = np.linalg.inv(literal.G(pose).T @ np.linalg.inv(R_b) @ literal.G(pose))
            mu = literal.g_inverse(pose, v, model)
            matches[b] = literal.Landmark(mu, sigma, d, (step, robot, b))
            particle.landmarks.append(matches[b])
            continue
        landmark, G = matches[b], literal.G(pose)
        Z = G @ landmark.sigma @ G.T + R_b
        K = landmark.sigma @ G.T @ np.linalg.inv(Z)
        landmark.mu = landmark.mu + K @ (v - literal.g(pose, landmark.mu, model))
        landmark.sigma = (np.eye(3) - K @ G) @ landmark.sigma
    return [landmark.origin for landmark in matches]


def motion_covariance(before, x, u, model):
    """Covariance of the pose under (7), from the variances in the body frame."""
    forward, left, yaw_m, yaw_rad = model.sigmas
    distance, turn = np.hypot(u[0], u[1]), abs(u[2])
    c, s = np.cos(before[2]), np.sin(before[2])
    V = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    body = np.diag([forward**2, left**2, yaw_m**2]) * distance
    body[2, 2] += yaw_rad**2 * turn
    return V @ body @ V.T


def believe(landmarks, x, P, v, d, R, model):
    """Match one observation and update the Gaussian (x, P): landmark or None, x, P, log weight."""
    best, least = None, np.inf
    for landmark in landmarks:
        nu, H, S = innovation(landmark, x, P, v, R, model)
        E = (d - landmark.d) @ (d - landmark.d)
        if nu @ np.linalg.inv(S) @ nu <= model.D_0 and min(model.E_0, least) >= E:
            best, least = landmark, E
    if best is None:
        return None, x, P, log_density(model.D_0, R)
    nu, H, S = innovation(best, x, P, v, R, model)
    K = P @ H.T @ np.linalg.inv(S)
    return best, x - K @ nu, P - K @ H @ P, log_density(nu @ np.linalg.inv(S) @ nu, S)


def innovation(landmark, x, P, v, R, model):
    """nu = g^-1(x, v) - mu in the map frame, its Jacobian by differences, and its covariance."""
    step = 1e-6 * np.eye(3)
    place = literal.g_inverse(x, v, model)
    H = np.stack(
        [
            (literal.g_inverse(x + h, v, model) - literal.g_inverse(x - h, v, model)) / 2e-6
            for h in step
        ],
        axis=1,
    )
    G = literal.G(x)
    return place - landmark.mu, H, H @ P @ H.T + landmark.sigma + G.T @ R @ G


def log_density(D, S):
    return -0.5 * D - 0.5 * np.log(np.linalg.det(2 * np.pi * S))
