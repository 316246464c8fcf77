"""No landmark that a particle could match is left out by the boxes around landmarks and frames."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from multi_robot_slam.filter.association import field_of_search
from multi_robot_slam.filter.landmarks import Landmarks

GATE = 11.345
PARTICLES = 5
ALMOST = 0.999
sigmas = st.sampled_from([1e-4, 0.05, 0.5])
"""Of landmark and observation: where one is nothing beside the other, its bound is tight."""


@given(
    seed=st.integers(0, 10_000),
    landmark_sigma=sigmas,
    noise_sigma=sigmas,
    pose_spread=st.sampled_from([0.0, 0.3]),
    margin=st.sampled_from([(0.0, 0.0), (0.5, 0.0), (0.0, 0.2), (0.5, 0.2)]),
)
def test_a_landmark_on_the_edge_of_the_gate_is_near(
    seed, landmark_sigma, noise_sigma, pose_spread, margin
):
    rng = np.random.default_rng(seed)
    poses = rng.normal([[3], [-2], [1]], pose_spread, (3, PARTICLES))
    v = rng.uniform(-8, 8, (1, 3))
    direction = [(1, 0), (-1, 0), (0, 1), (0, -1)][rng.integers(4)]
    pose = poses[:, rng.integers(PARTICLES)] + ALMOST * np.array(
        [margin[0] * direction[0], margin[0] * direction[1], margin[1] * rng.choice([-1, 1])]
    )
    c, s = np.cos(pose[2]), np.sin(pose[2])
    place = pose[:2] + np.array([c * v[0, 0] - s * v[0, 1], s * v[0, 0] + c * v[0, 1]])
    edge = np.sqrt(GATE * (landmark_sigma**2 + noise_sigma**2))
    place += ALMOST * edge * np.array(direction)

    landmarks = Landmarks(PARTICLES, np.float64)
    column = landmarks.reserve(1)
    mean, covariance = [*place, v[0, 2]], landmark_sigma**2 * np.array([1, 0, 0, 1, 0, 1])
    landmarks.planes[column] = np.array([*mean, *covariance])[:, None]
    landmarks.bound(column, GATE)
    landmarks.commit(column, np.array([PARTICLES]), np.zeros((1, 128), np.float32))
    noise = noise_sigma**2 * np.array([[1.0, 0, 0, 1, 0, 1]])
    box = field_of_search(poses, v, noise, GATE, np.array(margin))
    assert landmarks.near(box).tolist() == column.tolist()
