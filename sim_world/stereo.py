"""The simulated stereo camera: projection, field of view and noise (14), (15)."""

from collections.abc import Sequence

import numpy as np

from msg_defs.types import CameraMount, StereoCamera


def axes(mount: CameraMount) -> np.ndarray:
    """(3, 3): rows are the camera's forward, left and up in `base_link`."""
    cy, sy = np.cos(mount.yaw_rad), np.sin(mount.yaw_rad)
    cp, sp = np.cos(mount.pitch_rad), np.sin(mount.pitch_rad)
    cr, sr = np.cos(mount.roll_rad), np.sin(mount.roll_rad)
    ahead, left, up = np.array([[cy, sy, 0.0], [-sy, cy, 0.0], [0.0, 0.0, 1.0]])
    ahead, up = cp * ahead - sp * up, sp * ahead + cp * up
    return np.array([ahead, cr * left + sr * up, cr * up - sr * left])


def eyes(pose: np.ndarray, camera: StereoCamera) -> np.ndarray:
    """(2, 3) places of the left and the right camera in `map` [m] of a robot at `pose`."""
    mount = camera.mount
    left = np.array([mount.forward_m, mount.left_m, mount.up_m])
    forward_m, left_m, up_m = np.array([left, left - camera.baseline_m * axes(mount)[1]]).T
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x = pose[0] + c * forward_m - s * left_m
    y = pose[1] + s * forward_m + c * left_m
    return np.column_stack([x, y, up_m])


def camera_from_map(points: np.ndarray, pose: np.ndarray, mount: CameraMount) -> np.ndarray:
    """(N, 3) `points` in `map` as (X, Y, Z) in the left camera [m] of a robot at `pose`."""
    dx, dy = points[:, 0] - pose[0], points[:, 1] - pose[1]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    forward, left = c * dx + s * dy, c * dy - s * dx
    from_camera = np.column_stack(
        [forward - mount.forward_m, left - mount.left_m, points[:, 2] - mount.up_m]
    )
    ahead, left, up = axes(mount) @ from_camera.T
    return np.column_stack([-left, up, ahead])


def optical_in_base(mount: CameraMount) -> tuple[float, ...]:
    """The optical frame (x right, y down, z forward) in `base_link`: x, y, z [m], then x, y, z, w.

    The quaternion is that of the yaw, then the pitch, then the roll, then of the optical axes.
    """
    turn: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    for angle, axis in ((mount.yaw_rad, 2), (mount.pitch_rad, 1), (mount.roll_rad, 0)):
        about = [0.0, 0.0, 0.0, np.cos(angle / 2)]
        about[axis] = np.sin(angle / 2)
        turn = _turned(turn, about)
    return mount.forward_m, mount.left_m, mount.up_m, *_turned(turn, (-0.5, 0.5, -0.5, 0.5))


def _turned(first: Sequence[float], second: Sequence[float]) -> tuple[float, ...]:
    """The product of two quaternions x, y, z, w."""
    v, w = np.array(first[:3]), np.array(second[:3])
    vector = first[3] * w + second[3] * v + np.cross(v, w)
    return *vector.tolist(), float(first[3] * second[3] - v @ w)


def project(points: np.ndarray, camera: StereoCamera) -> np.ndarray:
    """Row, column and disparity (r, c, d) [px] of (N, 3) points (X, Y, Z) in the left camera.

    The inverse of (14). The right camera sees the point in column c - d.
    """
    x, y, z = points.T
    centre_column, centre_row = camera.centre_px
    row = centre_row - camera.focal_px * y / z
    column = centre_column + camera.focal_px * x / z
    return np.column_stack([row, column, camera.focal_px * camera.baseline_m / z])


def in_view(points: np.ndarray, camera: StereoCamera) -> np.ndarray:
    """(N,) bool: the point (X, Y, Z) falls into the images of both cameras."""
    inside = points[:, 2] > 0
    row, column, disparity = project(points[inside], camera).T
    inside[inside] = (
        (row >= 0)
        & (row < camera.height_px)
        & (column - disparity >= 0)
        & (column < camera.width_px)
    )
    return inside


def variances(pixels: np.ndarray, camera: StereoCamera) -> np.ndarray:
    """(N, 3) variances of X, Y, Z [m^2] at the (N, 3) pixels (r, c, d) (15)."""
    row, column, disparity = pixels.T
    centre_column, centre_row = camera.centre_px
    across = (camera.baseline_m * camera.sigma_rc_px / disparity) ** 2
    along = (camera.baseline_m * camera.sigma_disparity_px / disparity**2) ** 2
    return np.column_stack(
        [
            across + along * (column - centre_column) ** 2,
            across + along * (centre_row - row) ** 2,
            along * camera.focal_px**2,
        ]
    )
