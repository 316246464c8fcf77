"""Covariances at the distance of the landmark, not of the measurement (N1)."""

import numpy as np
import pytest

from msg_defs.types import CameraMount
from multi_robot_slam.models import stereo
from multi_robot_slam.models.ranging import FARTHEST_SIGMA, Ranging, at_landmarks
from multi_robot_slam.models.symmetric import pack, unpack

F_PX, F_TIMES_BASELINE = 400.0, 48.0
SIGMAS = np.array([0.4, 0.3, 0.1])
MOUNT = CameraMount(forward_m=0.2, left_m=0.1, up_m=0.7, roll_rad=0.1, pitch_rad=-0.2, yaw_rad=0.4)


def camera_points(pixels):
    """(n, 3) X right, Y up, Z of column, row (from the centre) and disparity."""
    z = F_TIMES_BASELINE / pixels[:, 2]
    return np.column_stack([pixels[:, 0] * z / F_PX, -pixels[:, 1] * z / F_PX, z])


def covariances(pixels):
    """(n, 6) by central differences of `camera_points`."""
    jacobian = np.empty((len(pixels), 3, 3))
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-5
        jacobian[:, :, k] = (camera_points(pixels + step) - camera_points(pixels - step)) / 2e-5
    return pack(jacobian @ np.diag(SIGMAS**2) @ jacobian.transpose(0, 2, 1))


def some_pixels(count=20):
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-300, 300, (count, 2)), rng.uniform(4, 40, count)])


@pytest.mark.parametrize("share", [0.97, 1.0, 1.03])
def test_what_another_distance_has_is_what_the_camera_would_tell_there(share):
    pixels = some_pixels()
    there = pixels * [1, 1, 1 / share]
    seen, R = stereo.to_body(camera_points(pixels), covariances(pixels), MOUNT)
    places, expected = stereo.to_body(camera_points(there), covariances(there), MOUNT)
    ranging = Ranging.of(camera_points(pixels), covariances(pixels), MOUNT)
    sigmas = np.linalg.norm(ranging.along, axis=1) / np.linalg.norm(ranging.rays, axis=1)
    near = np.abs(share - 1) <= FARTHEST_SIGMA * sigmas
    found = at_landmarks(R, *ranging, places - seen)
    assert near.any()
    np.testing.assert_allclose(found[near], expected[near], rtol=1e-4, atol=1e-9)
    np.testing.assert_array_equal(found[~near], R[~near])


def test_what_is_no_landmark_changes_nothing():
    pixels = some_pixels()
    seen, R = stereo.to_body(camera_points(pixels), covariances(pixels), MOUNT)
    ranging = Ranging.of(camera_points(pixels), covariances(pixels), MOUNT)
    np.testing.assert_array_equal(at_landmarks(R, *ranging, np.full_like(seen, np.nan)), R)


def test_the_mean_of_many_is_not_too_near():
    """Averages with the weights that measured points have are too near; with (N1) they are not."""
    rng = np.random.default_rng(1)
    true = np.array([[50.0, -20.0, 5.0]])
    pixels = true + rng.standard_normal((20_000, 3)) * [0.4, 0.3, 0.25]
    points, place = camera_points(pixels), camera_points(true)[0]
    R = covariances(pixels) * [1.0] * 6
    ranging = Ranging.of(points, R, CameraMount(left_m=0.0, up_m=0.0))
    to_body = stereo.to_body(points, R, CameraMount(left_m=0.0, up_m=0.0))
    at = stereo.to_body(place[None], R[:1], CameraMount(left_m=0.0, up_m=0.0))[0]

    def mean_depth(noise):
        W = np.linalg.inv(unpack(noise))
        return np.linalg.solve(W.sum(axis=0), np.einsum("nij,nj->i", W, to_body[0]))[0]

    measured = mean_depth(to_body[1])
    known = mean_depth(at_landmarks(to_body[1], *ranging, at - to_body[0]))
    expected_bias = 4 * (0.25 / 5.0) ** 2
    assert (measured - place[2]) / place[2] == pytest.approx(-expected_bias, rel=0.5)
    assert abs(known - place[2]) / place[2] < 0.4 * expected_bias
