"""What truth and estimate both must know is written twice; here the two are held together."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from msg_defs.types import CameraMount, StereoCamera
from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.models import motion
from multi_robot_slam.models import stereo as estimated
from sim_world import planar, robot
from sim_world import stereo as simulated
from sim_world.messages import camera_infos
from sim_world.scenario import OdometryNoise, Scenario

coordinates = st.floats(-30, 30)
poses = st.tuples(coordinates, coordinates, st.floats(-3.1, 3.1)).map(np.array)
points = st.tuples(coordinates, coordinates, st.floats(-2, 4)).map(np.array)
mounts = st.builds(CameraMount, *[st.floats(-1, 1)] * 3, *[st.floats(-3, 3)] * 3)
shares = st.floats(0, 0.5)


@given(poses, points, mounts)
def test_the_filter_puts_a_point_where_the_simulator_saw_it(pose, point, mount):
    seen = simulated.camera_from_map(point[None], pose, mount)
    body, _ = estimated.to_body(seen, np.zeros((1, 6)), mount)
    np.testing.assert_allclose(estimated.to_map(pose, body)[0], point, atol=1e-9)


@given(points, mounts)
def test_the_transform_of_the_camera_puts_a_point_where_the_filter_does(seen, mount):
    """`seen` in the optical frame: x right, y down, z forward."""
    *place, x, y, z, w = simulated.optical_in_base(mount)
    body, _ = estimated.to_body(seen[None] * [1, -1, 1], np.zeros((1, 6)), mount)
    transformed = Rotation.from_quat([x, y, z, w]).apply(seen) + place
    np.testing.assert_allclose(transformed, body[0], atol=1e-9)


@given(st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(0.5, 30)).map(np.array))
def test_the_front_end_puts_a_pixel_where_the_simulator_saw_its_point(point):
    """By way of the calibration that goes with the pictures."""
    camera = StereoCamera()
    rig = StereoRig.of(*camera_infos("robot_1", 0, camera), rectify=False)
    row, column, disparity = simulated.project(point[None], camera).T
    np.testing.assert_allclose(rig.point(column, row, disparity)[0], point, atol=1e-9)


@given(poses, poses)
def test_movements_between_two_poses_are_the_same(first, second):
    made, read = planar.between(first, second), motion.increment(first, second)
    np.testing.assert_allclose(read, made, atol=1e-12)
    reached = first[:, None].copy()
    motion.move(reached, read[:, None])
    composed = planar.compose(first, made)
    np.testing.assert_allclose(reached[:2, 0], composed[:2], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * reached[2, 0]), np.exp(1j * composed[2]), atol=1e-9)


@given(poses, st.tuples(*[shares] * 4))
def test_the_motion_model_is_the_odometry_s_noise(movement, sigmas):
    made = robot.movement_variances(movement, OdometryNoise(*sigmas))
    assumed = motion.standard_deviations(movement, 0.0, motion.MotionSettings(*sigmas)) ** 2
    np.testing.assert_allclose(assumed, made, rtol=1e-12, atol=1e-30)


def test_by_default_the_filter_assumes_the_noise_and_the_mount_that_are_simulated():
    assert motion.MotionSettings() == motion.MotionSettings(**vars(OdometryNoise()))
    assert Scenario().camera.mount == CameraMount()
