"""The UTIAS Multi-Robot Cooperative Localization and Mapping recordings.

Leung, Halpern, Barfoot, Liu: The UTIAS multi-robot cooperative localization and mapping dataset,
International Journal of Robotics Research 30(8), 2011. A folder holds text files whose lines
starting with # are comments:

    Barcodes.dat               subject, barcode; the robots are the subjects that have logs
    Landmark_Groundtruth.dat   subject, x, y, standard deviations of x and y [m]
    Robot<n>_Groundtruth.dat   time [s], x, y [m], heading [rad]
    Robot<n>_Odometry.dat      time [s], commanded velocity [m/s], yaw rate [rad/s]
    Robot<n>_Measurement.dat   time [s], barcode, range [m], bearing [rad]
"""

import re
from pathlib import Path

import numpy as np

from msg_defs.errors import InputError
from msg_defs.topics import robot_name
from msg_defs.types import CameraMount, Trajectory
from multi_robot_slam.datasets.recording import Commands, Noise, Readings, Recording, RobotLog
from multi_robot_slam.datasets.text_tables import read_table

NOISE = Noise(
    range_m=0.05,
    range_per_m=0.04,
    bearing_rad=0.015,
    range_memory_s=3.5,
    forward_per_sqrt_s=0.013,
    left_per_sqrt_s=0.004,
    yaw_per_sqrt_s=0.067,
    scale_sigma=0.1,
)
"""Of the iRobot Creates and their cameras, residuals of set 7.

Range errors of one target keep a correlation of 0.93 from one image to the next, 0.25 s later:
0.25 / -log(0.93) = 3.5 s. Odometry: the upper ends of what the robots show in 1 s, since tails
are heavy. They also drive and turn about a tenth less than they are told, each its own share.
"""


def read(folder: Path) -> Recording:
    """The recording in `folder`; `InputError` with file and line for what is missing or bad."""
    subjects = _subjects(folder / "Barcodes.dat")
    numbers = _robot_numbers(folder)
    landmarks = read_table(folder / "Landmark_Groundtruth.dat", 5)
    landmark_subjects = landmarks[:, 0].astype(np.int64)
    return Recording(
        robots={
            robot_name(index): _robot(folder, number, subjects, numbers, landmark_subjects)
            for index, number in enumerate(numbers)
        },
        landmarks=landmarks[:, 1:3],
        landmark_ids=landmark_subjects.astype(np.uint32),
        noise=NOISE,
        mount=CameraMount(forward_m=0.0, left_m=0.0, up_m=0.0),
    )


def _subjects(path: Path) -> dict[int, int]:
    """Barcode -> subject."""
    return {int(barcode): int(subject) for subject, barcode in read_table(path, 2)}


def _robot_numbers(folder: Path) -> list[int]:
    names = (re.fullmatch(r"Robot(\d+)_Odometry\.dat", path.name) for path in folder.iterdir())
    numbers = sorted(int(name[1]) for name in names if name)
    if not numbers:
        raise InputError(f"{folder}: no Robot<n>_Odometry.dat; name the folder of one recording")
    return numbers


def _robot(
    folder: Path,
    number: int,
    subjects: dict[int, int],
    robots: list[int],
    landmarks: np.ndarray,
) -> RobotLog:
    odometry = read_table(folder / f"Robot{number}_Odometry.dat", 3)
    truth = read_table(folder / f"Robot{number}_Groundtruth.dat", 4)
    measured = read_table(folder / f"Robot{number}_Measurement.dat", 4)
    stamps, last = _distinct(_nanoseconds(odometry[:, 0]))
    true_stamps, true_last = _distinct(_nanoseconds(truth[:, 0]))
    seen = np.array([subjects.get(int(barcode), -1) for barcode in measured[:, 1]], np.int64)
    of_landmarks = _readings(measured, seen, landmarks)
    of_robots = _readings(measured, seen, np.array([r if r != number else -2 for r in robots]))
    return RobotLog(
        commands=Commands(stamps, *odometry[last, 1:].T),
        truth=Trajectory(true_stamps, truth[true_last, 1:]),
        landmarks=of_landmarks,
        robots=of_robots,
        unknown=len(measured) - len(of_landmarks) - len(of_robots),
    )


def _readings(measured: np.ndarray, seen: np.ndarray, subjects: np.ndarray) -> Readings:
    """The readings `measured` (R, 4) of subjects `seen` (R,) that are among `subjects`."""
    row_of = {int(subject): row for row, subject in enumerate(subjects)}
    targets = np.array([row_of.get(int(subject), -1) for subject in seen], np.int64)
    known = targets >= 0
    times, _, ranges, bearings = measured[known].T
    readings = Readings(_nanoseconds(times), targets[known], ranges, bearings)
    return readings[np.argsort(readings.stamps_ns, kind="stable")]


def _nanoseconds(seconds: np.ndarray) -> np.ndarray:
    """Unix times, given to the millisecond."""
    return np.rint(seconds * 1e3).astype(np.int64) * 10**6


def _distinct(stamps_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each stamp once, ascending, and the last row that has it."""
    stamps, from_end = np.unique(stamps_ns[::-1], return_index=True)
    return stamps, len(stamps_ns) - 1 - from_end
