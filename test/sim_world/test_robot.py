"""One robot: odometry noise, and what its camera measures."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from msg_defs.types import CameraMount, PoseSample, StereoCamera
from sim_world import messages, planar, robot, stereo, trajectories, world
from sim_world.scenario import OdometryNoise, Scenario
from sim_world.simulator import Simulation

EXACT = OdometryNoise(0.0, 0.0, 0.0, 0.0)
POSE = np.array([15.0, 8.0, np.pi / 2])

poses = st.tuples(*[st.floats(-30, 30)] * 2, st.floats(-3.1, 3.1)).map(np.array)


@pytest.fixture(scope="module")
def built():
    return world.build(Scenario())


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def arc(movements, length_m=4.0, turn_rad=1.5):
    """A path of equal movements on an arc."""
    path = [np.array([1.0, 2.0, 0.5])]
    for _ in range(movements):
        path.append(planar.compose(path[-1], np.array([length_m, 0, turn_rad]) / movements))
    return np.array(path)


def drive(path, scenario, rng):
    stamps = robot.stamps_ns(len(path), scenario.period_s)
    return list(robot.odometry_samples("r", path, stamps, scenario, rng))


def look(built, scenario, rng, frames=1, pose=POSE):
    true = PoseSample("r", 7, pose)
    return [robot.observe(true, built, scenario, rng) for _ in range(frames)]


@given(poses, poses)
def test_a_movement_leads_from_one_pose_to_the_other(first, second):
    reached = planar.compose(first, planar.between(first, second))
    np.testing.assert_allclose(reached[:2], second[:2], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * reached[2]), np.exp(1j * second[2]), atol=1e-9)


def test_exact_odometry_is_the_path_seen_from_its_start(rng):
    path = trajectories.poses("ring", 1, 100)[0]
    samples = drive(path, Scenario(odometry=EXACT), rng)
    assert not samples[0].pose.any()
    for sample, true in zip(samples, path, strict=True):
        assert not sample.covariance.any()
        np.testing.assert_allclose(planar.compose(path[0], sample.pose)[:2], true[:2], atol=1e-9)


def test_twist_is_the_measured_movement_over_the_period(rng):
    scenario = Scenario(period_s=0.25)
    samples = drive(arc(8), scenario, rng)
    assert not samples[0].twist.any()
    for before, after in pairwise(samples):
        movement = planar.between(before.pose, after.pose)
        np.testing.assert_allclose(after.twist, movement[[0, 2]] / 0.25, atol=1e-9)


def test_a_robot_that_stands_still_adds_no_noise(rng):
    samples = drive(np.tile([1.0, 2.0, 3.0], (5, 1)), Scenario(), rng)
    assert not np.any([s.pose for s in samples])
    assert not np.any([s.covariance for s in samples])


@pytest.mark.parametrize("pieces", [1, 10])
def test_odometry_noise_does_not_depend_on_the_number_of_movements(pieces):
    noise = OdometryNoise(0.02, 0.005, 0.01, 0.02)
    movement = np.array([3.0, 4.0, -2.0]) / pieces
    total = pieces * robot.movement_variances(movement, noise)
    expected = [5 * 0.02**2, 5 * 0.005**2, 5 * 0.01**2 + 2 * 0.02**2]
    np.testing.assert_allclose(total, expected)


def test_covariance_is_propagated_to_first_order():
    """Against central differences of the composition in pose and movement."""
    pose, movement = np.array([1.0, -2.0, 0.7]), np.array([0.4, 0.1, 0.3])
    variances = np.array([0.01, 0.002, 0.03])
    covariance = np.array([[0.5, 0.1, 0.02], [0.1, 0.4, -0.03], [0.02, -0.03, 0.2]])
    h = 1e-6 * np.eye(3)
    by_pose, by_movement = (
        np.column_stack([(f(d) - f(-d)) / 2e-6 for d in h])
        for f in (
            lambda d: planar.compose(pose + d, movement),
            lambda d: planar.compose(pose, movement + d),
        )
    )
    expected = by_pose @ covariance @ by_pose.T + by_movement @ np.diag(variances) @ by_movement.T
    np.testing.assert_allclose(
        robot.propagate(covariance, pose, movement, variances), expected, atol=1e-8
    )


def test_covariance_follows_from_what_the_robot_measured(rng):
    noise = OdometryNoise(0.2, 0.1, 0.1, 0.2)
    covariance = np.zeros((3, 3))
    for before, after in pairwise(drive(arc(8), Scenario(odometry=noise), rng)):
        movement = planar.between(before.pose, after.pose)
        variances = robot.movement_variances(movement, noise)
        covariance = robot.propagate(covariance, before.pose, movement, variances)
        np.testing.assert_allclose(after.covariance, covariance, atol=1e-12)


def test_odometry_errors_have_the_published_covariance(rng):
    path = arc(8)
    ends = [drive(path, Scenario(), rng)[-1] for _ in range(1500)]
    true = planar.between(path[0], path[-1])
    errors = np.array([end.pose - true for end in ends])
    squared = [e @ np.linalg.solve(end.covariance, e) for e, end in zip(errors, ends, strict=True)]
    # Chi-squared with 3 degrees of freedom: mean 3, variance 6.
    assert np.mean(squared) == pytest.approx(3, abs=5 * np.sqrt(6 / 1500))
    np.testing.assert_allclose(errors.mean(0), 0, atol=5 * errors.std(0).max() / np.sqrt(1500))


def test_projection_inverts_the_camera_equations(rng):
    """(14), written out."""
    camera = StereoCamera(focal_px=400.0, baseline_m=0.2, width_px=500, height_px=300)
    points = rng.uniform([-3, -1, 0.5], [3, 1, 10], (50, 3))
    r, c, d = stereo.project(points, camera).T
    back = [0.2 * (c - 250) / d, 0.2 * (150 - r) / d, 400 * 0.2 / d]
    np.testing.assert_allclose(np.column_stack(back), points)


def test_disparity_is_the_shift_between_the_two_cameras(rng):
    camera = StereoCamera(mount=CameraMount(0.3, 0.1, 1.2))
    right = replace(camera.mount, left_m=0.1 - camera.baseline_m)
    pose = np.array([3.0, 4.0, 2.0])
    points = np.array([3.0, 4.0, 0.0]) + rng.uniform(-9, 9, (200, 3))
    in_left = stereo.camera_from_map(points, pose, camera.mount)
    ahead = in_left[:, 2] > 0.1
    in_right = stereo.camera_from_map(points, pose, right)
    r, c, d = stereo.project(in_left[ahead], camera).T
    row, column, _ = stereo.project(in_right[ahead], camera).T
    np.testing.assert_allclose(row, r)
    np.testing.assert_allclose(column, c - d)


def test_eyes_are_the_origins_of_the_cameras():
    camera = StereoCamera(mount=CameraMount(0.3, 0.1, 1.2))
    pose = np.array([3.0, 4.0, 2.0])
    in_left = stereo.camera_from_map(stereo.eyes(pose, camera), pose, camera.mount)
    np.testing.assert_allclose(in_left, [[0, 0, 0], [camera.baseline_m, 0, 0]], atol=1e-12)


def test_published_covariance_is_15_at_the_measured_point(built, rng):
    camera = StereoCamera(sigma_rc_px=3.0, sigma_disparity_px=0.4)
    ((seen, _),) = look(built, Scenario(camera=camera), rng)
    x, y, z = seen.positions.astype(float).T
    f, base = camera.focal_px, camera.baseline_m
    d = f * base / z
    c, r = f * x / z, -f * y / z
    xx, xy, xz, yy, yz, zz = seen.covariances.T
    np.testing.assert_allclose(xx, base**2 * (9 / d**2 + c**2 * 0.16 / d**4), rtol=1e-5)
    np.testing.assert_allclose(yy, base**2 * (9 / d**2 + r**2 * 0.16 / d**4), rtol=1e-5)
    np.testing.assert_allclose(zz, f**2 * base**2 * 0.16 / d**4, rtol=1e-5)
    assert not np.any([xy, xz, yz])


def test_measurement_noise_is_that_of_15_at_the_true_point(built, rng):
    scenario = Scenario()
    frames = look(built, scenario, rng, frames=300)
    rows = np.concatenate([truth.landmarks for _, truth in frames])
    measured = np.concatenate([seen.positions for seen, _ in frames])
    camera = scenario.camera
    true = stereo.camera_from_map(built.landmarks.positions[rows].astype(float), POSE, camera.mount)
    sigma = np.sqrt(stereo.variances(stereo.project(true, camera), camera))
    standard = (measured - true) / sigma
    count = len(standard)
    assert count == 300 * 15
    np.testing.assert_allclose(standard.mean(0), 0, atol=5 / np.sqrt(count))
    np.testing.assert_allclose(np.cov(standard.T), np.eye(3), atol=5 * np.sqrt(2 / count))


def test_descriptor_noise_is_independent_and_not_normalised(built, rng):
    frames = look(built, Scenario(descriptor_noise=0.03), rng, frames=30)
    rows = np.concatenate([truth.landmarks for _, truth in frames])
    noise = np.concatenate([seen.descriptors for seen, _ in frames])
    noise -= built.landmarks.descriptors[rows]
    assert noise.std() == pytest.approx(0.03, rel=0.02)
    assert abs(noise.mean()) < 5 * 0.03 / np.sqrt(noise.size)
    lengths = (noise**2).sum(1) / 0.03**2
    assert lengths.mean() == pytest.approx(128, abs=5 * np.sqrt(2 * 128 / len(lengths)))


def test_of_more_than_b_landmarks_the_strongest_are_observed(built, rng):
    scenario = Scenario(observations=5)
    visible = built.visible(POSE, scenario.camera, scenario.d_max_m)
    for _, truth in look(built, scenario, rng, frames=3):
        assert truth.landmarks.tolist() == sorted(visible)[:5]


def test_fewer_than_b_landmarks_are_all_observed(built, rng):
    scenario = Scenario(observations=1000)
    ((_, truth),) = look(built, scenario, rng)
    visible = built.visible(POSE, scenario.camera, scenario.d_max_m)
    np.testing.assert_array_equal(np.sort(truth.landmarks), visible)


@pytest.mark.parametrize("b", [0, 15])
def test_arrays_have_the_declared_types(built, rng, b):
    ((seen, truth),) = look(built, Scenario(observations=b), rng)
    assert (seen.robot, seen.stamp_ns) == (truth.robot, truth.stamp_ns) == ("r", 7)
    assert [seen.positions.shape, seen.covariances.shape] == [(b, 3), (b, 6)]
    assert seen.descriptors.shape == (b, 128)
    dtypes = {seen.positions.dtype, seen.covariances.dtype, seen.descriptors.dtype}
    assert dtypes == {np.dtype(np.float32)}
    assert truth.landmarks.shape == (b,)
    assert truth.landmarks.dtype == np.uint32


def test_points_measured_behind_or_in_the_camera_are_discarded(built, rng):
    blurred = StereoCamera(sigma_disparity_px=20.0)
    frames = look(built, Scenario(camera=blurred), rng, frames=300)
    assert sum(len(seen.positions) for seen, _ in frames) < 300 * 15
    for seen, truth in frames:
        assert len(truth.landmarks) == len(seen.positions) == len(seen.descriptors)
        assert (seen.positions[:, 2] > 0.1).all()


def test_odometry_is_more_frequent_than_frames_where_it_is_wanted():
    every = Scenario(robots=2, movements=40)
    often = replace(every, odometry_per_frame=4)
    sparse, dense = ([*Simulation(s, 5).steps()] for s in (every, often))
    assert len(dense) == 4 * (len(sparse) - 1) + 1
    for i, instant in enumerate(dense):
        assert all((step.observations is None) == bool(i % 4) for step in instant)
        assert [len(step.events) for step in instant] == [1 if i % 4 else 2] * 2
    for frame, same in zip(sparse, dense[::4], strict=True):
        for one, other in zip(frame, same, strict=True):
            assert one.truth.stamp_ns == other.truth.stamp_ns
            np.testing.assert_allclose(one.truth.pose, other.truth.pose, atol=1e-9)
            np.testing.assert_allclose(
                one.observations.positions, other.observations.positions, atol=1e-5
            )
            np.testing.assert_array_equal(
                one.observation_truth.landmarks, other.observation_truth.landmarks
            )
    path = Simulation(often, 5).truth_path("robot_1")
    assert path.stamps_ns.tolist() == [step[0].odometry.stamp_ns for step in dense]


def test_between_frames_a_robot_says_its_odometry_alone():
    simulation = Simulation(Scenario(robots=1, movements=4, odometry_per_frame=2), 0)
    said = [[topic.name for topic, _ in messages.of_step(step)] for (step,) in simulation.steps()]
    assert [len(names) for names in said] == [4, 2] * 4 + [4]
    assert said[1] == [said[0][0], said[0][2]]
    assert [len(messages.reported(step)) for (step,) in simulation.steps()] == [2, 1] * 4 + [2]
