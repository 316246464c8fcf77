"""The planar recording of the University of Toronto's state estimation course, `dataset2.mat`.

Barfoot: State Estimation for Robotics, 2017; distributed with the pysteam tutorials. MATLAB 5:

    t (T, 1) time [s]; v, om (T, 1) velocities from the wheels [m/s, rad/s]
    r, b (T, N) range [m] and bearing [rad] of each landmark from a sensor d [m] ahead of the
        robot's centre; 0: not seen
    l (N, 2) landmarks; x_true, y_true, th_true (T, 1) poses, right where true_valid is 1
    r_var, b_var, v_var, om_var (1, 1) variances of r, b, v, om
"""

from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from msg_defs.errors import InputError
from msg_defs.topics import robot_name
from msg_defs.types import CameraMount, Trajectory
from multi_robot_slam.datasets.recording import Commands, Noise, Readings, Recording, RobotLog

START_S = 1.0
"""Stamp of the recording's time 0; 0 on a ROS stamp would mean that there is none."""

SERIES = ("t", "v", "om", "x_true", "y_true", "th_true", "true_valid")
SCALARS = ("d", "r_var", "b_var", "v_var", "om_var")


def read(path: Path) -> Recording:
    """The recording in the file `path`; `InputError` that names what is missing."""
    values = _load(path)
    series = {name: values[name].ravel() for name in SERIES}
    scalars = {name: float(values[name].squeeze()) for name in SCALARS}
    stamps = np.rint((series["t"] + START_S) * 1e9).astype(np.int64)
    valid = series["true_valid"] == 1
    poses = np.column_stack([series["x_true"], series["y_true"], series["th_true"]])
    log = RobotLog(
        commands=Commands(stamps, series["v"], series["om"]),
        truth=Trajectory(stamps[valid], poses[valid]),
        landmarks=_readings(stamps, values["r"], values["b"]),
        robots=_readings(stamps[:0], values["r"][:0], values["b"][:0]),
    )
    step_s = float(np.median(np.diff(series["t"])))
    return Recording(
        robots={robot_name(0): log},
        landmarks=values["l"],
        landmark_ids=np.arange(len(values["l"]), dtype=np.uint32),
        noise=_noise(scalars, step_s),
        mount=CameraMount(forward_m=scalars["d"], left_m=0.0, up_m=0.0),
    )


def _noise(scalars: dict[str, float], step_s: float) -> Noise:
    """Velocities err anew in each of the steps of `step_s`, so their variances add up."""
    return Noise(
        range_m=scalars["r_var"] ** 0.5,
        range_per_m=0.0,
        bearing_rad=scalars["b_var"] ** 0.5,
        range_memory_s=0.0,
        forward_per_sqrt_s=(scalars["v_var"] * step_s) ** 0.5,
        left_per_sqrt_s=0.0,
        yaw_per_sqrt_s=(scalars["om_var"] * step_s) ** 0.5,
    )


def _readings(stamps_ns: np.ndarray, ranges: np.ndarray, bearings: np.ndarray) -> Readings:
    """Readings of `ranges`, `bearings` (T, N); a range of 0 is none."""
    rows, targets = np.nonzero(ranges > 0)
    return Readings(stamps_ns[rows], targets, ranges[rows, targets], bearings[rows, targets])


def _load(path: Path) -> dict[str, np.ndarray]:
    try:
        values = loadmat(path, appendmat=False)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}; name a .mat file") from None
    except (MatReadError, ValueError, TypeError, NotImplementedError):
        raise InputError(f"{path} is no MATLAB 5 file; download it again") from None
    if "y_k_j" in values:
        raise InputError(
            f"{path}: its stereo camera moves in six degrees of freedom, and the filter's robots "
            "drive in a plane; convert dataset2.mat"
        )
    missing = [name for name in (*SERIES, *SCALARS, "r", "b", "l") if name not in values]
    if missing:
        raise InputError(f"{path}: no {', '.join(missing)} in it; convert dataset2.mat")
    _require_shapes(path, values)
    return values


def _require_shapes(path: Path, values: dict[str, np.ndarray]) -> None:
    count, landmarks = values["t"].size, len(values["l"])
    wanted = dict.fromkeys(SERIES, (count, 1)) | dict.fromkeys(SCALARS, (1, 1))
    wanted |= dict.fromkeys(("r", "b"), (count, landmarks)) | {"l": (landmarks, 2)}
    for name, shape in wanted.items():
        if values[name].shape != shape or not np.isfinite(values[name]).all():
            raise InputError(
                f"{path}: {name} has the shape {values[name].shape}; it must be {shape}, all "
                "numbers finite"
            )
