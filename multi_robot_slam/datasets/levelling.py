"""What a camera sees in space, as a robot in the plane would: without roll, pitch and height."""

from typing import NamedTuple

import numpy as np

from multi_robot_slam.models.stereo import CAMERA_TO_BODY
from multi_robot_slam.models.symmetric import pack, unpack

PAPER_TO_OPTICAL = np.diag([1.0, -1.0, 1.0])
"""From a frame with Y up to one with y down."""

TILT_SIGMA_RAD = 0.005
"""Error of a roll and of a pitch that a cloud is levelled with: 0.3 degrees, as of an IMU."""
HEIGHT_SIGMA_M = 0.01
"""Error of a height that a cloud is levelled with."""

LEAST_DEPTH_M = 0.05
"""Points nearer to the level camera's plane, or behind it, are left out."""


class Cloud(NamedTuple):
    """B observations from one frame."""

    positions: np.ndarray
    """(B, 3) [m]."""
    covariances: np.ndarray
    """(B, 6) [m^2]."""
    descriptors: np.ndarray
    """(B, 128) float32."""


def in_map(cloud: Cloud, place: np.ndarray, rotation: np.ndarray) -> Cloud:
    """Points in the camera frame, turned into `map`.

    The camera is at `place` (3,) with `rotation` (3, 3) from its optical frame to `map`.
    """
    turned = rotation @ PAPER_TO_OPTICAL
    positions = cloud.positions.astype(float) @ turned.T + place
    covariances = pack(turned @ unpack(cloud.covariances.astype(float)) @ turned.T)
    return Cloud(positions, covariances, cloud.descriptors)


def levelled(cloud: Cloud, pose: np.ndarray, height_m: float) -> tuple[Cloud, np.ndarray]:
    """Points in `map` in the frame of a level camera at the planar `pose` (3,) and this height.

    The frame is the paper's: X right, Y up, Z ahead. Covariances have the errors of levelling in
    them, which a planar robot's pose has no room for: a centimetre at two metres, where a camera
    errs by one and a half millimetres. Also returns which points (B,) were kept: those ahead.
    """
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    body_to_map = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    turned = CAMERA_TO_BODY.T @ body_to_map.T
    positions = (cloud.positions - [pose[0], pose[1], height_m]) @ turned.T
    covariances = turned @ unpack(cloud.covariances) @ turned.T
    covariances += levelling_noise(positions)
    is_ahead = positions[:, 2] > LEAST_DEPTH_M
    kept = Cloud(
        positions[is_ahead].astype(np.float32),
        pack(covariances[is_ahead]).astype(np.float32),
        cloud.descriptors[is_ahead],
    )
    return kept, is_ahead


def levelling_noise(
    positions: np.ndarray,
    tilt_sigma_rad: float = TILT_SIGMA_RAD,
    height_sigma_m: float = HEIGHT_SIGMA_M,
) -> np.ndarray:
    """(B, 3, 3) [m^2]: what errors of roll, pitch and height make of `positions` (B, 3)."""
    right, up, ahead = positions.T
    zero = np.zeros_like(up)
    by_pitch = np.stack([zero, ahead, -up], axis=1) * tilt_sigma_rad
    by_roll = np.stack([up, -right, zero], axis=1) * tilt_sigma_rad
    by_height = np.array([0.0, height_sigma_m, 0.0])
    return sum(np.einsum("...i,...j->...ij", by, by) for by in (by_pitch, by_roll, by_height))
