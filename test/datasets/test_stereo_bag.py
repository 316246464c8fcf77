"""Stereo recordings as bags: robots, odometry, levelled clouds, and what is one landmark."""

import json

import numpy as np
import pytest
import stereo_folders
from scipy.spatial.transform import Rotation

from msg_defs import topics, wire
from msg_defs.errors import InputError
from msg_defs.types import Trajectory
from multi_robot_slam.bags import BagReader
from multi_robot_slam.datasets import euroc, kitti, stereo_bag, wheels
from multi_robot_slam.datasets.identities import Identities
from multi_robot_slam.datasets.levelling import Cloud, in_map, levelled, levelling_noise
from multi_robot_slam.front_end.settings import CameraSettings
from multi_robot_slam.models import stereo
from multi_robot_slam.models.motion import MotionSettings, increment, standard_deviations
from multi_robot_slam.models.symmetric import pack, unpack
from multi_robot_slam.pipeline import offline


def unit(rng, count):
    looks = rng.standard_normal((count, 128)).astype(np.float32)
    return looks / np.linalg.norm(looks, axis=1, keepdims=True)


def tilted_view(points, place, rotation, rng):
    """The cloud of `points` (n, 3) in `map`, without noise, from a camera that is tilted."""
    seen = (points - place) @ rotation @ np.diag([1.0, -1.0, 1.0])
    covariances = np.tile(pack(np.diag([1e-4, 2e-4, 9e-4])), (len(points), 1))
    return Cloud(seen, covariances, unit(rng, len(points)))


def test_a_levelled_cloud_is_where_the_landmarks_are_as_a_planar_robot_sees_them():
    rng = np.random.default_rng(0)
    place = np.array([1.0, -2.0, 1.4])
    ahead = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    rotation = Rotation.from_euler("zyx", [0.7, 0.3, -0.2]).as_matrix() @ ahead
    points = place + Rotation.from_euler("z", 0.7).apply(
        rng.uniform([1, -1, -1], [4, 1, 1], (20, 3))
    )
    cloud = in_map(tilted_view(points, place, rotation, rng), place, rotation)
    np.testing.assert_allclose(cloud.positions, points, atol=1e-12)
    pose = np.array([1.0, -2.0, np.arctan2(*rotation[[1, 0], 2])])
    level, is_ahead = levelled(cloud, pose, 1.2)
    assert is_ahead.all()
    mount = stereo_bag.CameraMount(forward_m=0.0, left_m=0.0, up_m=1.2)
    body, noise = stereo.to_body(level.positions, level.covariances, mount)
    np.testing.assert_allclose(stereo.to_map(pose, body), points, atol=1e-5)
    # What the camera measured is turned, and the errors of levelling are added.
    own = unpack(noise) - stereo_body_noise(level)
    np.testing.assert_allclose(
        np.linalg.eigvalsh(own), np.tile([1e-4, 2e-4, 9e-4], (20, 1)), rtol=1e-3, atol=1e-8
    )


def stereo_body_noise(level):
    turned = stereo.CAMERA_TO_BODY
    return turned @ levelling_noise(level.positions.astype(float)) @ turned.T


def test_errors_of_levelling_are_those_of_small_turns():
    rng = np.random.default_rng(1)
    points, tilt, height = rng.uniform(-2, 3, (4, 3)), 0.01, 0.02
    angles = rng.normal(0, tilt, (200_000, 2))
    up = rng.normal(0, height, 200_000)
    found = levelling_noise(points, tilt, height)
    for point, covariance in zip(points, found, strict=True):
        turns = np.column_stack([angles[:, 0], np.zeros(len(angles)), angles[:, 1]])
        moved = Rotation.from_rotvec(turns).apply(point) + np.outer(up, [0, 1, 0])
        np.testing.assert_allclose(covariance, np.cov(moved.T), atol=2e-5)


def test_points_behind_a_level_camera_are_left_out():
    cloud = Cloud(np.array([[2.0, 0, 1], [-0.5, 0, 1]]), np.ones((2, 6)), np.zeros((2, 128)))
    level, is_ahead = levelled(cloud, np.zeros(3), 1.0)
    assert is_ahead.tolist() == [True, False]
    assert len(level.positions) == 1


def test_odometry_has_the_errors_that_the_filter_is_told():
    noise = MotionSettings()
    path = np.cumsum(np.tile([0.4, 0.1, 0.05], (4001, 1)), axis=0)
    truth = Trajectory(np.arange(4001) * 10**9, path)
    samples = [*wheels.noisy_odometry("r", truth, noise, np.random.default_rng(0))]
    assert [s.stamp_ns for s in samples] == truth.stamps_ns.tolist()
    errors = []
    for k in range(4000):
        true = increment(path[k], path[k + 1])
        measured = increment(samples[k].pose, samples[k + 1].pose)
        errors.append((measured - true) / standard_deviations(true, 1.0, noise))
    np.testing.assert_allclose(np.std(errors, axis=0), 1, atol=0.04)
    again = [*wheels.noisy_odometry("r", truth, noise, np.random.default_rng(0))]
    assert (again[-1].pose == samples[-1].pose).all()


def test_parts_of_a_recording_start_together_and_hold_every_pair(tmp_path):
    stereo_folders.write_keyframes(tmp_path)
    recording = euroc.read(tmp_path)
    first, second = stereo_bag.parts(recording, 2)
    assert [len(first.recording), len(second.recording)] == [3, 2]
    assert first.planar().stamps_ns[0] == second.planar().stamps_ns[0]
    where = np.concatenate([first.planar().poses, second.planar().poses])
    whole = recording.truth.at(recording.stamps_ns).planar()
    np.testing.assert_allclose(where, whole.poses)
    with pytest.raises(InputError, match="robots"):
        stereo_bag.parts(recording, 5)
    assert len(stereo_bag.spaced(recording, 5.0)) == 3


def test_one_landmark_keeps_its_number_from_wherever_it_is_seen():
    rng = np.random.default_rng(2)
    points, looks = rng.uniform(-3, 3, (30, 3)), unit(rng, 30)
    identities = Identities()
    small = np.tile(pack(np.eye(3) * 1e-4), (30, 1))
    first = identities.of(Cloud(points, small, looks), np.zeros(3))
    assert first.tolist() == [*range(30)]
    order = rng.permutation(30)
    again = Cloud(points[order] + rng.normal(0, 0.01, (30, 3)), small, looks[order])
    assert identities.of(again, np.ones(3)).tolist() == order.tolist()
    elsewhere = Cloud(points + np.array([0, 0, 1.0]), small, looks)
    assert (identities.of(elsewhere, np.ones(3)) >= 30).all()


def test_looks_decide_between_points_in_one_place():
    rng = np.random.default_rng(3)
    looks, small = unit(rng, 2), np.tile(pack(np.eye(3) * 1e-4), (2, 1))
    places = np.zeros((2, 3))
    identities = Identities()
    identities.of(Cloud(places, small, looks), np.ones(3))
    assert identities.of(Cloud(places, small, looks[::-1]), np.ones(3)).tolist() == [1, 0]
    strangers = Cloud(places, small, unit(rng, 2))
    assert identities.of(strangers, np.ones(3)).tolist() == [2, 3]


def test_images_go_into_the_bag_as_they_are(command, tmp_path):
    own = stereo_folders.write_kitti(tmp_path)
    bag = tmp_path / "bag"
    code, out, _ = command("convert", "kitti", own, "--out", bag, "--images", "--seed", "3")
    assert code == 0
    assert "seed 3" in out
    left = topics.compressed_image("robot_1", "left")
    info = topics.camera_info("robot_1", "right")
    found = BagReader(bag).by_topic([left, info])
    pictures = [wire.decode_compressed(data, "left") for data in found[left]]
    for picture, (image, _) in zip(pictures, stereo_folders.images(), strict=True):
        np.testing.assert_array_equal(picture.pixels, image)
    assert [p.stamp_ns for p in pictures] == kitti.read(own).stamps_ns.tolist()
    calibration = wire.decode_camera_info(found[info][0], "right")
    assert calibration.projection[0, 3] == -5
    config = offline.recorded_config(bag)
    assert config.camera.image_transport == "compressed"
    assert config.camera.image == "image_rect"


def test_run_finds_two_robots_of_a_real_flight_and_beats_its_odometry(
    command, shared_data, tmp_path
):
    bag, out = tmp_path / "bag", tmp_path / "out"
    folder = shared_data / "stereo" / "euroc_v101_keyframes"
    words = ("--robots", "2", "--rate", "1", "--scale", "0.5")
    code, told, _ = command("convert", "euroc", folder, "--out", bag, *words)
    assert code == 0
    assert "level" in told
    assert command("run", bag, "--out", out, "--particles", "20")[0] == 0
    result = json.loads((out / "result.json").read_text())
    assert [*result["robots"]] == ["robot_1", "robot_2"]
    assert result["dropped"] == {}
    assert result["online_path_rmse_m"] < 0.5 * result["odometry_path_rmse_m"]
    assert result["association_precision"] > 0.8


def test_the_camera_settings_tell_how_images_are_named(tmp_path):
    stereo_folders.write_keyframes(tmp_path)
    settings = stereo_bag.camera_settings(euroc.read(tmp_path), 0.5)
    assert (settings.image, settings.features.scale) == ("image_raw", 0.5)
    assert isinstance(settings, CameraSettings)
