"""Shapes against slow twins: what is drawn is where and as large as it is said to be."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from msg_defs.types import CameraMount, Walls
from multi_robot_slam.models import stereo
from multi_robot_slam.watch import shapes

angles = st.floats(-3.1, 3.1)


def turned(quaternion):
    """(3, 3) of w, x, y, z."""
    return Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()


@given(st.tuples(angles, angles, angles))
def test_quaternions_are_those_of_the_rotations(euler):
    rotation = Rotation.from_euler("zyx", euler).as_matrix()
    np.testing.assert_allclose(turned(shapes.quaternions(rotation[None])[0]), rotation, atol=1e-9)


@pytest.mark.parametrize("size", [2, 3])
def test_an_ellipsoid_has_two_sigma_along_every_axis(size):
    factors = np.random.default_rng(0).normal(size=(50, size, size))
    covariances = factors @ factors.transpose(0, 2, 1)
    turns, axes = shapes.ellipsoids(covariances)
    for turn, half, covariance in zip(turns, axes, covariances, strict=True):
        rotation = turned(turn)[:size, :size]
        rebuilt = rotation @ np.diag(half**2) @ rotation.T / shapes.SIGMAS**2
        np.testing.assert_allclose(rebuilt, covariance, atol=1e-9)


@given(st.tuples(angles, angles, angles), st.tuples(angles, angles, angles))
def test_a_camera_looks_where_the_observation_model_puts_what_it_sees(pose, look):
    mount = CameraMount(0.2, 0.1, 1.3, *look)
    turn, eye = shapes.camera(np.array(pose), mount)
    seen = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 2.0], [0.0, 1.0, 2.0]])  # X right, Y up, Z forward
    body, _ = stereo.to_body(seen, np.zeros((3, 6)), mount)
    optical = seen * [1, -1, 1]
    drawn = optical @ turned(turn).T + eye
    np.testing.assert_allclose(drawn, stereo.to_map(np.array(pose), body), atol=1e-9)


def test_about_z_is_a_yaw():
    np.testing.assert_allclose(
        turned(shapes.about_z(0.7)), Rotation.from_euler("z", 0.7).as_matrix(), atol=1e-12
    )


@pytest.mark.parametrize("mesh", [shapes.sphere(), shapes.arrow_head(1.0)])
def test_solids_are_closed_and_face_outwards(mesh):
    corners, faces = mesh
    triangles = corners[faces]
    assert faces.max() < len(corners)
    # The divergence theorem: the volume is positive only if faces look outwards.
    volume = np.einsum(
        "ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])
    ).sum()
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert volume > 0
    np.testing.assert_allclose(normals.sum(axis=0), 0, atol=1e-9)


def test_a_sphere_has_radius_1_and_a_disc_is_flat():
    corners, _ = shapes.sphere()
    np.testing.assert_allclose(np.linalg.norm(corners, axis=1), 1)
    corners, faces = shapes.disc()
    assert set(corners[:, 2]) == {0}
    triangles = corners[faces]
    area = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])[:, 2] / 2
    assert (area > 0).all()
    assert area.sum() == pytest.approx(np.pi, rel=0.01)


def test_walls_stand_on_the_ground():
    walls = Walls(np.array([[0.0, 0.0, 3.0, 0.0], [3.0, 0.0, 3.0, 4.0]]), 2.0)
    corners, faces = shapes.wall_faces(walls)
    np.testing.assert_array_equal(
        corners[4:], [[3.0, 0.0, 0.0], [3.0, 4.0, 0.0], [3.0, 4.0, 2.0], [3.0, 0.0, 2.0]]
    )
    triangles = corners[faces]
    sides = triangles[:, 1:] - triangles[:, :1]
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
    assert areas.sum() == pytest.approx(2.0 * (3 + 4))
    edges = shapes.outline(corners)
    assert np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).sum() == 2 * (3 + 4) + 4 * 2.0
    np.testing.assert_array_equal(shapes.joined(corners[:3]), [corners[:2], corners[1:3]])
