"""The state estimation course's recordings: `convert utias`, and landmarks along a known path."""

import json

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from msg_defs.types import CameraMount, ObservationSet
from multi_robot_slam.datasets import utias
from multi_robot_slam.filter import rbpf
from multi_robot_slam.filter.settings import NO_REJUVENATION, FilterSettings
from multi_robot_slam.models import stereo
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.models.motion import MotionSettings
from multi_robot_slam.models.symmetric import pack, unpack

FOLDER = "utias_state_estimation"


def made_up():
    """A robot that drives straight on past two landmarks; one is seen now and then."""
    count = 40
    t = np.arange(count)[:, None] * 0.1
    seen = np.ones((count, 2))
    seen[::2, 1] = 0
    ahead = np.array([6.0, 7.0]) - 0.2 - 0.5 * t
    return {
        "t": t,
        "v": np.full((count, 1), 0.5),
        "om": np.zeros((count, 1)),
        "r": seen * np.hypot(ahead, 1.0),
        "b": seen * np.arctan2([1.0, -1.0], ahead),
        "l": np.array([[6.0, 1.0], [7.0, -1.0]]),
        "x_true": 0.5 * t,
        "y_true": np.zeros((count, 1)),
        "th_true": np.zeros((count, 1)),
        "true_valid": (np.arange(count) != 7)[:, None].astype(np.uint8),
        **{name: np.array([[value]]) for name, value in (("d", 0.2), ("r_var", 1e-3))},
        **{name: np.array([[1e-4]]) for name in ("b_var", "v_var", "om_var")},
    }


def refused(result):
    code, _, err = result
    assert (code, err.count("\n")) == (2, 1), err
    return err


def test_what_is_not_seen_or_not_true_is_left_out(tmp_path):
    savemat(tmp_path / "file.mat", made_up())
    log = utias.read(tmp_path / "file.mat").robots["robot_1"]
    assert np.bincount(log.landmarks.targets).tolist() == [40, 20]
    assert len(log.truth.stamps_ns) == 39
    assert (np.diff(log.landmarks.stamps_ns) >= 0).all()


def test_run_of_the_bag_finds_path_and_landmarks(command, tmp_path):
    savemat(tmp_path / "file.mat", made_up())
    bag, out = tmp_path / "bag", tmp_path / "out"
    assert command("convert", "utias", tmp_path / "file.mat", "--out", bag, "--rate", "5")[0] == 0
    assert command("run", bag, "--out", out, "--particles", "50")[0] == 0
    result = json.loads((out / "result.json").read_text())
    assert (result["dropped"], result["landmarks"]) == ({}, 2)
    assert result["odometry_path_rmse_m"] < 1e-6
    assert result["path_rmse_m"] < 0.05


def test_what_is_missing_or_of_another_shape_is_named(command, tmp_path):
    path = tmp_path / "file.mat"
    words = ("convert", "utias", path, "--out", tmp_path / "bag")
    assert "file.mat" in refused(command(*words))
    path.write_text("no MATLAB")
    assert "MATLAB" in refused(command(*words))
    savemat(path, {name: value for name, value in made_up().items() if name not in ("d", "om")})
    assert "no om, d in it" in refused(command(*words))
    savemat(path, made_up() | {"l": np.zeros((3, 2))})
    assert "shape" in refused(command(*words))


def test_six_degrees_of_freedom_are_refused(command, shared_data, tmp_path):
    path = shared_data / FOLDER / "starry_night_dataset.mat"
    assert "plane" in refused(command("convert", "utias", path, "--out", tmp_path / "bag"))


def test_the_real_recording_is_estimated_far_better_than_odometry(command, shared_data, tmp_path):
    bag, out = tmp_path / "bag", tmp_path / "out"
    path = shared_data / FOLDER / "dataset2.mat"
    assert command("convert", "utias", path, "--out", bag, "--rate", "0.25")[0] == 0
    assert command("run", bag, "--out", out, "--particles", "100")[0] == 0
    result = json.loads((out / "result.json").read_text())
    assert result["dropped"] == {}
    assert result["odometry_path_rmse_m"] == pytest.approx(2.83, abs=0.1)
    assert result["path_rmse_m"] < 0.5
    assert result["association_precision"] == 1


def test_landmarks_of_a_real_stereo_camera_along_its_true_path(shared_data):
    """The filter's EKFs, with the camera's true poses in space, err as much as they say.

    The camera's full rotation is put into the observations: they are turned until their axes are
    those of the map, so that what is left to the filter's planar pose is where the camera is.
    Pixel errors of one landmark are alike for a while, as with any feature tracker, so
    observations count once in two seconds.
    """
    data = loadmat(shared_data / FOLDER / "starry_night_dataset.mat")
    settings = FilterSettings(
        particles=1,
        gate=1e6,
        rejuvenation=NO_REJUVENATION,
        descriptor_gate=0.5,
        motion=MotionSettings(0.0, 0.0, 0.0, 0.0),
    )
    mount = CameraMount(forward_m=0.0, left_m=0.0, up_m=0.0)
    state, place = rbpf.init(np.zeros((1, 3)), settings), np.zeros(3)
    names = []
    for k in range(0, data["t"].size, 42):
        centre, seen, points, covariances = starry_view(data, k)
        motion = np.array([*(centre[:2] - place[:2]), 0.0])
        place = centre
        points[:, 2] += centre[2]
        seen_now = as_camera(points, covariances, seen, k)
        frame = RobotFrame.from_camera(0, motion, 0.0, seen_now, mount)
        rbpf.step(state, [frame], settings, np.random.default_rng(0))
        names += [number for number in seen if number not in names]
    columns, values = state.landmarks.of_particle(0)
    identities = state.landmarks.descriptors[columns].argmax(axis=1)
    assert sorted(identities) == sorted(names)
    assert len(names) == 20
    errors = values[:, :3] - data["rho_i_pj_i"].T[identities]
    covariances = unpack(values[:, 3:])
    nees = np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[:, :, None])[:, :, 0])
    assert np.sqrt(np.mean(np.square(errors))) < 0.05
    assert 0.3 < nees.mean() / 3 < 3


def starry_view(data, k):
    """What the camera sees at step k.

    Returns its place (3,) [m]; the numbers (n,) of the landmarks; points (n, 3) [m] from the camera
    along the axes of the map, and their covariances (n, 3, 3) [m^2].
    """
    to_map = _rotation(data["theta_vk_i"][:, k])
    centre = data["r_i_vk_i"][:, k] + to_map @ data["rho_v_c_v"][:, 0]
    seen = np.flatnonzero(data["y_k_j"][0, k] >= 0)
    u_left, v_left, u_right, v_right = data["y_k_j"][:, k, seen]
    focal, base = float(data["fu"].squeeze()), float(data["b"].squeeze())
    column, row = u_left - data["cu"].squeeze(), (v_left + v_right) / 2 - data["cv"].squeeze()
    disparity = u_left - u_right
    points = base / disparity * np.array([column, row, np.full(len(seen), focal)])
    variance = data["y_var"].ravel()
    noise = np.diag([variance[0], (variance[1] + variance[3]) / 4, variance[2]])
    turn = to_map @ data["C_c_v"].T
    covariances = []
    for c, r, d in zip(column, row, disparity, strict=True):
        jacobian = base / d * np.array([[1 - c / d, 0, c / d], [-r / d, 1, r / d],
                                        [-focal / d, 0, focal / d]])  # fmt: skip
        covariances.append(turn @ jacobian @ noise @ jacobian.T @ turn.T)
    return centre, seen, (turn @ points).T, np.array(covariances).reshape(-1, 3, 3)


def _rotation(axis_angle):
    """Vehicle axes -> map axes, with the sign of the recording's angles."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(axis_angle).as_matrix()


def as_camera(points, covariances, seen, stamp_ns):
    """Points along the map's axes as the filter's camera would see them, looking along x."""
    turn = stereo.CAMERA_TO_BODY
    return ObservationSet(
        "robot",
        stamp_ns,
        (points @ turn).astype(np.float32),
        pack(turn.T @ covariances @ turn).astype(np.float32),
        np.eye(128, dtype=np.float32)[seen],
    )
