"""The observation model g: from the camera to the robot, from the robot to the map (8), (9).

The camera is fixed on a robot that moves in a plane, so

    v_hat = g(x, l) = C^T (Rz(yaw)^T (l - p) - c)

is a rotation and a shift of the landmark, and its Jacobian (9) the orthogonal G = C^T Rz(yaw)^T.
C holds how the camera is mounted, c where.
D (18), |Z| (16) and the update (10)-(13) do not change under a rotation of the measurement, so
everything is computed with the measurement turned into the map frame, where the Jacobian is the
identity: innovation G^T (v - v_hat) = g^-1(x, v) - mu, and noise G^T R G.
"""

import numpy as np

from msg_defs.types import CameraMount
from multi_robot_slam.models.symmetric import pack, unpack

CAMERA_TO_BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""C: camera axes X right, Y up, Z forward -> body axes x forward, y left, z up."""


def to_body(
    positions: np.ndarray, covariances: np.ndarray, mount: CameraMount
) -> tuple[np.ndarray, np.ndarray]:
    """Turn observations from the camera frame into `base_link`.

    Parameters
    ----------
    positions : (B, 3), metres; covariances : (B, 6), m^2, `xx xy xz yy yz zz`.

    Returns
    -------
    The same two arrays in `base_link`, float64.

    """
    offset = np.array([mount.forward_m, mount.left_m, mount.up_m])
    turned = rotation(mount) @ CAMERA_TO_BODY
    full = turned @ unpack(covariances) @ turned.T
    return positions @ turned.T + offset, pack(full)


def rotation(mount: CameraMount) -> np.ndarray:
    """(3, 3): Rz(yaw) Ry(pitch) Rx(roll), from a camera that looks straight ahead to this one."""
    angles = np.array([mount.roll_rad, mount.pitch_rad, mount.yaw_rad])
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return yaw @ pitch @ roll


def to_map(pose: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """g^-1: points (B, 3) of `base_link` seen from `pose` (3,) -> (B, 3) in `map` [m]."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return positions @ rotation.T + [pose[0], pose[1], 0.0]
