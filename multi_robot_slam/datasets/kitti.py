"""Sequences of the KITTI odometry benchmark, in its own layout or as an excerpt.

Geiger, Lenz, Urtasun: Are we ready for autonomous driving? CVPR 2012. Rectified grey pairs:

    sequences/05/image_0/000000.png, image_1/    left and right
    sequences/05/calib.txt                       P0: ... P1: ..., 3 x 4, row by row
    sequences/05/times.txt                       seconds since the first pair
    poses/05.txt                                 3 x 4, row by row: left camera -> that of frame 0

or an excerpt of one of the sequences 04 to 12

    left/000100.png, right/                      the number is the row of the pose
    pose_gt.txt                                  as poses/05.txt

The first camera is taken for level: `map` is its frame turned so that z is up and x ahead.
"""

from pathlib import Path

import numpy as np

from msg_defs.errors import InputError
from multi_robot_slam.datasets.stereo_recording import (
    SpacePath,
    StereoCalibration,
    StereoRecording,
    camera_info,
    read_grey,
)
from multi_robot_slam.datasets.text_tables import read_lines, read_table

START_S = 1.0
"""Stamp of the sequence's time 0; 0 on a ROS stamp would mean that there is none."""

EXCERPT_HZ = 10.0
EXCERPT_PROJECTION = np.array(
    [[707.0912, 0.0, 601.8873, 0.0], [0.0, 707.0912, 183.1104, 0.0], [0.0, 0.0, 1.0, 0.0]]
)
"""Of the left camera of sequences 04 to 12 [px]."""
EXCERPT_RIGHT = -379.8145
"""P[0, 3] of the right one [px m]."""

OPTICAL_TO_MAP = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""From x right, y down, z ahead to x ahead, y left, z up."""


def read(folder: Path) -> StereoRecording:
    """The sequence in `folder`, in either layout."""
    if (folder / "image_0").is_dir():
        return _sequence(folder)
    if (folder / "left").is_dir() and (folder / "pose_gt.txt").exists():
        return _excerpt(folder)
    raise InputError(
        f"{folder}: no image_0 in it; name the folder of one sequence, such as sequences/05"
    )


def _sequence(folder: Path) -> StereoRecording:
    left, right = _images(folder / "image_0"), _images(folder / "image_1")
    seconds = read_table(folder / "times.txt", 1)[:, 0]
    poses = _poses(folder.resolve().parents[1] / "poses" / f"{folder.resolve().name}.txt")
    projections = _projections(folder / "calib.txt")
    rows = sorted(row for row in left.keys() & right.keys() if row < min(len(seconds), len(poses)))
    stamps = np.rint((seconds + START_S) * 1e9).astype(np.int64)
    return _recording(folder, left, right, rows, stamps[rows], poses[rows], projections)


def _excerpt(folder: Path) -> StereoRecording:
    left, right = _images(folder / "left"), _images(folder / "right")
    poses = _poses(folder / "pose_gt.txt")
    rows = sorted(row for row in left.keys() & right.keys() if row < len(poses))
    stamps = np.rint((np.array(rows) / EXCERPT_HZ + START_S) * 1e9).astype(np.int64)
    of_right = EXCERPT_PROJECTION.copy()
    of_right[0, 3] = EXCERPT_RIGHT
    projections = EXCERPT_PROJECTION, of_right
    return _recording(folder, left, right, rows, stamps, poses[rows], projections)


def _recording(
    folder: Path,
    left: dict[int, Path],
    right: dict[int, Path],
    rows: list[int],
    stamps_ns: np.ndarray,
    poses: np.ndarray,
    projections: tuple[np.ndarray, np.ndarray],
) -> StereoRecording:
    if not rows:
        raise InputError(f"{folder}: no pair of images has a pose; unpack all of it")
    height, width = read_grey(left[rows[0]]).shape
    infos = [camera_info((width, height), p[:, :3], p) for p in projections]
    turned = OPTICAL_TO_MAP @ poses
    return StereoRecording(
        stamps_ns=stamps_ns,
        left=[left[row] for row in rows],
        right=[right[row] for row in rows],
        calibration=StereoCalibration(*infos),
        is_rectified=True,
        truth=SpacePath(stamps_ns, turned[:, :, 3], turned[:, :, :3]),
    )


def _images(folder: Path) -> dict[int, Path]:
    """By the number of the frame."""
    return {int(path.stem): path for path in folder.glob("*.png") if path.stem.isdigit()}


def _poses(path: Path) -> np.ndarray:
    """(T, 3, 4) from the left optical frame to that of frame 0."""
    return read_table(path, 12).reshape(-1, 3, 4)


def _projections(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """P (3, 4) of the left and the right grey camera [px]."""
    found = {}
    for _, line in read_lines(path):
        name, _, values = line.partition(":")
        found[name.strip()] = values.split()
    try:
        left, right = (np.array(found[name], float).reshape(3, 4) for name in ("P0", "P1"))
    except (KeyError, ValueError):
        raise InputError(
            f"{path} has no lines P0: and P1: of twelve numbers each; unpack the sequence again"
        ) from None
    return left, right
