"""Readers of stereo recordings: pairs, calibration, and where the camera truly was."""

import numpy as np
import pytest
import stereo_folders
from scipy.spatial.transform import Rotation

from msg_defs.errors import InputError
from multi_robot_slam.datasets import euroc, kitti
from multi_robot_slam.datasets.stereo_recording import SpacePath
from multi_robot_slam.studies import library

EUROC, KITTI, LIBRARY = "euroc_v101_keyframes", "kitti_05_100-159", "blindfind_library"


def require_euroc(recording, rows):
    """It holds these `rows` of what `stereo_folders` wrote."""
    np.testing.assert_array_equal(recording.stamps_ns, stereo_folders.stamps()[rows])
    left, right = recording.calibration
    focal, baseline = left.projection[0, 0], -right.projection[0, 3] / right.projection[0, 0]
    assert baseline == pytest.approx(0.11)
    assert 40 < focal < 60
    truth = recording.truth.at(recording.stamps_ns)
    body = stereo_folders.BODY[rows].as_matrix()
    mount = stereo_folders.LEFT_MOUNT
    places = stereo_folders.PLACES[rows] + body @ mount[:3, 3]
    np.testing.assert_allclose(truth.places, places, atol=1e-4)
    ahead = body @ mount[:3, :3] @ left.rotation.T
    np.testing.assert_allclose(truth.rotations, ahead, atol=1e-4)
    np.testing.assert_allclose(truth.planar().poses[:, 2], 0.1 * rows, atol=0.01)


def test_euroc_in_its_own_layout_keeps_pairs_with_a_truth(tmp_path):
    stereo_folders.write_euroc(tmp_path)
    for folder in (tmp_path, tmp_path / "mav0"):
        recording = euroc.read(folder)
        require_euroc(recording, np.arange(1, 4))
        left, right = recording.images(0)
        np.testing.assert_array_equal(left, stereo_folders.images()[1, 0])
        np.testing.assert_array_equal(right, stereo_folders.images()[1, 1])


def test_euroc_as_lone_keyframes(tmp_path):
    stereo_folders.write_keyframes(tmp_path)
    recording = euroc.read(tmp_path)
    require_euroc(recording, np.arange(5))
    assert recording.images(0)[0].shape == (48, 64)
    assert [path.name for path in recording.of([2]).left] == [f"{stereo_folders.stamps()[2]}_0.jpg"]


def test_a_rectified_pair_sees_a_point_in_one_row(tmp_path):
    """R and P of both cameras agree with where they are."""
    stereo_folders.write_euroc(tmp_path)
    left, right = euroc.read(tmp_path).calibration
    point = np.array([0.3, -0.2, 2.0])
    moved = point - np.array([0.11, 0, 0])
    seen = []
    for camera, place in ((left, point), (right, moved)):
        u, v, w = camera.projection[:, :3] @ (camera.rotation @ place)
        seen.append((u / w, v / w))
    (u, v), (u_right, v_right) = seen
    assert v == pytest.approx(v_right)
    depth = (left.rotation @ point)[2]
    assert u - u_right == pytest.approx(-right.projection[0, 3] / depth)


def test_kitti_in_its_own_layout(tmp_path):
    recording = kitti.read(stereo_folders.write_kitti(tmp_path))
    assert recording.stamps_ns.tolist() == [1_000_000_000 + 100_000_000 * k for k in range(5)]
    assert recording.is_rectified
    assert recording.calibration.right.projection[0, 3] == -5
    planar = recording.truth.planar().poses
    np.testing.assert_allclose(planar[:, 0], np.arange(5))
    np.testing.assert_allclose(planar[:, 1], -0.05 * np.arange(5), atol=1e-9)
    np.testing.assert_allclose(planar[:, 2], -0.1 * np.arange(5), atol=1e-9)
    np.testing.assert_allclose(recording.truth.places[:, 2], -0.01 * np.arange(5))
    np.testing.assert_array_equal(recording.images(3)[1], stereo_folders.images()[3, 1])


def test_an_excerpt_of_kitti_takes_the_poses_of_its_frames(tmp_path):
    stereo_folders.write_excerpt(tmp_path)
    recording = kitti.read(tmp_path)
    assert recording.stamps_ns.tolist() == [1_200_000_000, 1_300_000_000, 1_400_000_000]
    np.testing.assert_allclose(recording.truth.planar().poses[:, 0], [2, 3, 4])


def test_a_path_in_space_is_interpolated_and_held_at_its_ends():
    turns = Rotation.from_rotvec([[0, 0, 0.0], [0, 0, 1.0]]).as_matrix()
    path = SpacePath(np.array([10**9, 2 * 10**9]), np.array([[0.0, 0, 0], [2, 4, 6]]), turns)
    found = path.at(np.array([10**9 - 500, 1_250_000_000, 2 * 10**9 + 500]))
    np.testing.assert_allclose(found.places, [[0, 0, 0], [0.5, 1, 1.5], [2, 4, 6]])
    yaw = Rotation.from_matrix(found.rotations).as_rotvec()[:, 2]
    np.testing.assert_allclose(yaw, [0, 0.25, 1])
    assert path.covers(np.array([9 * 10**8, 10**9 - 500, 2 * 10**9])).tolist() == [
        False,
        True,
        True,
    ]


def test_what_is_no_recording_is_refused_by_name(tmp_path):
    for module, hint in ((euroc, "V1_01_easy"), (kitti, "sequences/05"), (library, "left1.jpg")):
        with pytest.raises(InputError, match=hint):
            module.read(tmp_path)
    stereo_folders.write_euroc(tmp_path)
    for name, text, hint in (
        ("cam0/data.csv", "12x,a.png\n", "line 1"),
        ("cam1/sensor.yaml", "resolution: [64, 48]\n", "intrinsics"),
        ("state_groundtruth_estimate0/data.csv", "1,2\n", "17 finite numbers"),
    ):
        path = tmp_path / "mav0" / name
        kept = path.read_text()
        path.write_text(text)
        with pytest.raises(InputError, match=hint) as refused:
            euroc.read(tmp_path)
        assert path.name in str(refused.value)
        path.write_text(kept)


def test_a_missing_image_is_named(tmp_path):
    stereo_folders.write_euroc(tmp_path)
    recording = euroc.read(tmp_path)
    recording.left[0].write_text("no image")
    with pytest.raises(InputError, match=recording.left[0].name):
        recording.images(0)


def test_kitti_without_its_parts_is_refused(tmp_path):
    own = stereo_folders.write_kitti(tmp_path)
    (own / "calib.txt").write_text("P0: 1 2 3\n")
    with pytest.raises(InputError, match="P0: and P1:"):
        kitti.read(own)
    (tmp_path / "poses" / "05.txt").unlink()
    with pytest.raises(InputError, match=r"05\.txt"):
        kitti.read(own)


def test_the_real_recordings(shared_data):
    """What their READMEs say of them."""
    stereo = shared_data / "stereo"
    for module, name, pairs, baseline, focal in (
        (euroc, EUROC, 100, 0.1101, 436.24),
        (kitti, KITTI, 60, 0.5372, 707.0912),
        (library, LIBRARY, 346, 0.120, 247.2),
    ):
        recording = module.read(stereo / name)
        assert len(recording) == pairs
        left, right = recording.calibration
        assert left.projection[0, 0] == pytest.approx(focal, abs=0.1)
        assert -right.projection[0, 3] / focal == pytest.approx(baseline, abs=2e-4)
        shapes = {image.shape for image in recording.images(pairs - 1)}
        assert shapes == {(left.height_px, left.width_px)}
    flight = euroc.read(stereo / EUROC)
    truth = flight.truth.at(flight.stamps_ns)
    down = np.degrees(np.arcsin(-truth.rotations[:, 2, 2]))
    assert 14 < down.min() < down.max() < 25
    assert 0.9 < truth.places[:, 2].min() < truth.places[:, 2].max() < 1.9
    drive = kitti.read(stereo / KITTI)
    steps = np.linalg.norm(np.diff(drive.truth.places, axis=0), axis=1)
    assert steps.sum() == pytest.approx(28.1, abs=0.1)
