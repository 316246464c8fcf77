"""Paths in the format of the TUM benchmark, maps as CSV."""

import csv
from pathlib import Path

import numpy as np

from msg_defs.types import COVARIANCE_ORDER, LandmarkMap, Trajectory


def to_tum(path: Trajectory) -> str:
    """One line a pose: `stamp x y z qx qy qz qw`, stamp in seconds with 9 decimals, z = 0 [m]."""
    lines = (_tum_line(*row) for row in zip(path.stamps_ns.tolist(), path.poses, strict=True))
    return "".join(lines)


def _tum_line(stamp_ns: int, pose: np.ndarray) -> str:
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    x, y, yaw = pose
    qz, qw = np.sin(yaw / 2), np.cos(yaw / 2)
    return f"{seconds}.{nanoseconds:09d} {x:.9f} {y:.9f} 0 0 0 {qz:.9f} {qw:.9f}\n"


def write_map(landmarks: LandmarkMap, path: Path) -> None:
    """A row a landmark: id, place [m], covariance [m^2], observations, bits of the robots."""
    header = [
        "id",
        "x",
        "y",
        "z",
        *(f"cov_{e}" for e in COVARIANCE_ORDER),
        "observations",
        "robots",
    ]
    rows = zip(
        landmarks.ids,
        landmarks.positions,
        landmarks.covariances,
        landmarks.observations,
        landmarks.robots,
        strict=True,
    )
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for landmark, place, elements, observations, robots in rows:
            writer.writerow([landmark, *place, *elements, observations, robots])
