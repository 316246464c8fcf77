"""The observation model: frames, covariances, and its twin in the literal algorithm."""

import literal_algorithm1 as literal
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from msg_defs.types import CameraMount
from multi_robot_slam.models import stereo
from multi_robot_slam.models.symmetric import pack, unpack

MOUNT = CameraMount(forward_m=0.2, left_m=-0.1, up_m=0.7)
coordinates = st.floats(-20, 20)
poses = st.tuples(coordinates, coordinates, st.floats(-7, 7)).map(np.array)
points = st.tuples(coordinates, coordinates, coordinates).map(np.array)
MODEL = literal.Model(0, 0, (MOUNT.forward_m, MOUNT.left_m, MOUNT.up_m), (0, 0, 0, 0))


@given(poses, points)
def test_the_way_back_is_the_inverse_of_g(pose, landmark):
    v = literal.g(pose, landmark, MODEL)
    body, _ = stereo.to_body(v[None], np.zeros((1, 6)), MOUNT)
    np.testing.assert_allclose(stereo.to_map(pose, body)[0], landmark, atol=1e-9)


@given(poses, points)
def test_jacobian_is_the_finite_difference(pose, landmark):
    step = 1e-5
    numeric = np.stack(
        [
            (literal.g(pose, landmark + d, MODEL) - literal.g(pose, landmark - d, MODEL)) / 2 / step
            for d in step * np.eye(3)
        ],
        axis=1,
    )
    np.testing.assert_allclose(literal.G(pose), numeric, atol=1e-6)
    np.testing.assert_allclose(numeric @ numeric.T, np.eye(3), atol=1e-5)


def test_straight_ahead_is_straight_ahead():
    body, _ = stereo.to_body(np.array([[0.0, 0.0, 3.0]]), np.zeros((1, 6)), MOUNT)
    np.testing.assert_allclose(body, [[3.2, -0.1, 0.7]])


def test_covariances_turn_with_their_axes():
    diagonal = np.array([[1.0, 0, 0, 2.0, 0, 3.0]])
    _, turned = stereo.to_body(np.zeros((1, 3)), diagonal, MOUNT)
    np.testing.assert_allclose(turned, [[3.0, 0, 0, 1.0, 0, 2.0]])


def test_pack_undoes_unpack():
    packed = np.arange(12.0).reshape(2, 6)
    np.testing.assert_array_equal(pack(unpack(packed)), packed)
