"""The EuRoC recordings of a drone with a stereo camera, in ASL's layout or as lone keyframes.

Burri et al.: The EuRoC micro aerial vehicle datasets, IJRR 35(10), 2016. The folder of a recording

    mav0/cam0/data.csv, mav0/cam1/data.csv       stamp [ns], file in data/
    mav0/cam0/sensor.yaml, mav0/cam1/sensor.yaml pin-hole, radial-tangential; T_BS: camera to body
    mav0/state_groundtruth_estimate0/data.csv    stamp [ns], p (3) [m], q (w x y z), and more

or a folder of a few pairs of it

    <stamp [ns]>_0.jpg, <stamp>_1.jpg            left and right
    cam0.yaml, cam1.yaml                         as sensor.yaml
    groundtruth_imu.txt                          stamp [s], p (3) [m], q (x y z w)

The truth is that of the body in the world, whose z axis is up.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from msg_defs.errors import InputError
from multi_robot_slam.datasets.stereo_recording import (
    SpacePath,
    StereoCalibration,
    StereoRecording,
    calibrate,
)
from multi_robot_slam.datasets.text_tables import read_lines, read_table

TRUTH_COLUMNS = 17
"""Of ASL's estimate: stamp, position, quaternion, velocity, two biases."""

Camera = Mapping[str, Any]
"""What sensor.yaml says."""


def read(folder: Path) -> StereoRecording:
    """The recording in `folder`, in either layout; pairs without a truth are left out."""
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; name that of one EuRoC recording")
    if (folder / "groundtruth_imu.txt").exists():
        return _keyframes(folder)
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    if not (root / "cam0").is_dir():
        raise InputError(
            f"{folder}: no mav0/cam0 in it; name the folder of one recording, such as V1_01_easy"
        )
    left, right = (_listed(root / name) for name in ("cam0", "cam1"))
    cameras = [_camera(root / name / "sensor.yaml") for name in ("cam0", "cam1")]
    table = read_table(root / "state_groundtruth_estimate0" / "data.csv", TRUTH_COLUMNS, ",")
    stamps = table[:, 0].astype(np.int64)
    return _recording(folder, left, right, cameras, stamps, table[:, 1:4], table[:, [5, 6, 7, 4]])


def _keyframes(folder: Path) -> StereoRecording:
    left, right = (
        {int(path.name.partition("_")[0]): path for path in folder.glob(f"[0-9]*_{side}.*")}
        for side in (0, 1)
    )
    cameras = [_camera(folder / name) for name in ("cam0.yaml", "cam1.yaml")]
    table = read_table(folder / "groundtruth_imu.txt", 8)
    stamps = np.rint(table[:, 0] * 1e6).astype(np.int64) * 1000
    return _recording(folder, left, right, cameras, stamps, table[:, 1:4], table[:, 4:])


def _listed(camera: Path) -> dict[int, Path]:
    """The images of one camera by stamp."""
    found = {}
    for number, line in read_lines(camera / "data.csv"):
        stamp, _, name = line.partition(",")
        if not stamp.strip().isdigit() or not name.strip():
            raise InputError(
                f"{camera / 'data.csv'}, line {number}: {line!r} is no stamp and file name; "
                "correct or remove the line"
            )
        found[int(stamp)] = camera / "data" / name.strip()
    return found


def _recording(
    folder: Path,
    left: dict[int, Path],
    right: dict[int, Path],
    cameras: list[Camera],
    stamps_ns: np.ndarray,
    places: np.ndarray,
    quaternions: np.ndarray,
) -> StereoRecording:
    """Join what was read; the truth is that of the body at `stamps_ns`, `quaternions` x y z w."""
    body = SpacePath(stamps_ns, places, Rotation.from_quat(quaternions).as_matrix())
    pairs = np.array(sorted(left.keys() & right.keys()), np.int64)
    pairs = pairs[body.covers(pairs)] if len(pairs) else pairs
    if not len(pairs):
        raise InputError(f"{folder}: no pair of images has a ground truth; unpack all of it")
    calibration = _calibration(cameras)
    return StereoRecording(
        stamps_ns=pairs,
        left=[left[stamp] for stamp in pairs.tolist()],
        right=[right[stamp] for stamp in pairs.tolist()],
        calibration=calibration,
        is_rectified=False,
        truth=_of_camera(body, cameras[0]["T_BS"], calibration),
    )


def _of_camera(body: SpacePath, mount: np.ndarray, calibration: StereoCalibration) -> SpacePath:
    """The path of the rectified left camera, whose unrectified one sits at `mount` (4, 4)."""
    turn = mount[:3, :3] @ calibration.left.rotation.T
    places = body.places + body.rotations @ mount[:3, 3]
    return SpacePath(body.stamps_ns, places, body.rotations @ turn)


def _calibration(cameras: list[Camera]) -> StereoCalibration:
    left, right = cameras
    motion = np.linalg.inv(right["T_BS"]) @ left["T_BS"]
    return calibrate(
        (_matrix(left), _matrix(right)),
        (np.append(left["distortion"], 0.0), np.append(right["distortion"], 0.0)),
        left["size"],
        (motion[:3, :3], motion[:3, 3]),
    )


def _matrix(camera: Camera) -> np.ndarray:
    fx, fy, cx, cy = camera["intrinsics"]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _camera(path: Path) -> Camera:
    """Intrinsics (4,), distortion (4,), size (width, height) and T_BS (4, 4) of a sensor.yaml."""
    try:
        text = path.read_text()
    except OSError as error:
        raise InputError(
            f"{path}: {error.strerror}; name the folder of a whole recording"
        ) from None
    # OpenCV writes a directive that YAML does not know.
    lines = [line for line in text.splitlines() if not line.startswith("%")]
    try:
        found = yaml.safe_load("\n".join(lines))
        width, height = (int(value) for value in found["resolution"])
        camera = {
            "size": (width, height),
            "intrinsics": np.array(found["intrinsics"], float).reshape(4),
            "distortion": np.array(found["distortion_coefficients"], float).reshape(4),
            "T_BS": np.array(found["T_BS"]["data"], float).reshape(4, 4),
        }
    except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} is no calibration of a EuRoC camera ({error}); it must have resolution, "
            "intrinsics, distortion_coefficients and T_BS"
        ) from None
    return camera
