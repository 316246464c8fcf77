"""Meshes, and how poses and covariances turn and stretch them."""

import numpy as np

from msg_defs.types import CameraMount, Walls
from multi_robot_slam.models import stereo

SIGMAS = 2.0
"""Half axes of every ellipse and ellipsoid, in standard deviations."""

_UP_OF_OPTICAL = np.diag([1.0, -1.0, 1.0])
"""Optical frame (y down) -> camera frame (Y up)."""


def sphere(rows: int = 4, columns: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Corners (V, 3) and faces (F, 3) of a ball of radius 1."""
    polar = np.linspace(0, np.pi, rows + 1)[:, None]
    around = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    grid = np.broadcast_arrays(
        np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)
    )
    corner = np.arange((rows + 1) * columns).reshape(rows + 1, columns)
    here, right = corner, np.roll(corner, -1, axis=1)
    quads = here[:-1], here[1:], right[1:], right[:-1]
    first, second = np.stack(quads[:3], -1), np.stack((quads[0], *quads[2:]), -1)
    return np.stack(grid, -1).reshape(-1, 3), np.concatenate([first, second]).reshape(-1, 3)


def disc(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Corners and faces of a flat disc of radius 1."""
    around = np.linspace(0, 2 * np.pi, count, endpoint=False)
    rim = np.column_stack([np.cos(around), np.sin(around), np.zeros(count)])
    edge = np.arange(count)
    faces = np.column_stack([edge + 1, (edge + 1) % count + 1, np.zeros(count)])
    return np.vstack([np.zeros(3), rim]), faces.astype(np.uint32)


def arrow_head(length_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners and faces of a robot: a flat arrow-head that points along x from its middle."""
    outline = np.array([[0.6, 0.0], [-0.4, 0.35], [-0.2, 0.0], [-0.4, -0.35]]) * length_m
    heights = np.repeat([0.0, 0.25 * length_m], 4)[:, None]
    corners = np.hstack([np.vstack([outline, outline]), heights])
    sides = [(a, b, 4 + a) for a, b in ((0, 1), (1, 2), (2, 3), (3, 0))]
    sides += [(b, 4 + b, 4 + a) for a, b in ((0, 1), (1, 2), (2, 3), (3, 0))]
    faces = [(0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7), *sides]
    return corners, np.array(faces, np.uint32)


def wall_faces(walls: Walls) -> tuple[np.ndarray, np.ndarray]:
    """Corners (4 W, 3) and faces (2 W, 3) of upright walls."""
    ends = walls.segments.reshape(-1, 2, 2)[:, [0, 1, 1, 0]]
    heights = np.broadcast_to([0.0, 0.0, walls.height_m, walls.height_m], ends.shape[:2])
    corners = np.concatenate([ends, heights[..., None]], axis=2).reshape(-1, 3)
    first = 4 * np.arange(len(ends))[:, None, None] + [[0, 1, 2], [0, 2, 3]]
    return corners, first.reshape(-1, 3).astype(np.uint32)


def outline(corners: np.ndarray) -> np.ndarray:
    """(n, 2, 3) the sides of quadrangles whose `corners` (4 m, 3) follow each other."""
    quads = corners.reshape(-1, 4, 3)
    return np.stack([quads, np.roll(quads, -1, axis=1)], axis=2).reshape(-1, 2, 3)


def joined(points: np.ndarray) -> np.ndarray:
    """(n - 1, 2, 3) lines from each of `points` (n, 3) to the next."""
    return np.stack([points[:-1], points[1:]], axis=1)


def ellipsoids(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Turns (n, 4) and half axes (n, d) of `covariances` (n, d, d) in two or three dimensions.

    A turn is a quaternion w, x, y, z that brings the unit ball's axes where the ellipsoid's are.
    """
    variances, axes = np.linalg.eigh(covariances)
    count, size = variances.shape
    turns = np.broadcast_to(np.eye(3), (count, 3, 3)).copy()
    turns[:, :size, :size] = axes
    turns[:, :, 0] *= np.linalg.det(turns)[:, None]
    return quaternions(turns), SIGMAS * np.sqrt(variances.clip(min=0))


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """(n, 4) w, x, y, z of `rotations` (n, 3, 3): the eigenvectors of their largest eigenvalues."""
    r = rotations
    trace = np.trace(r, axis1=1, axis2=2)
    bilinear = np.empty((len(r), 4, 4))
    bilinear[:, 0, 0] = trace
    odd = np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], 1)
    bilinear[:, 0, 1:] = bilinear[:, 1:, 0] = odd
    bilinear[:, 1:, 1:] = r + r.transpose(0, 2, 1) - trace[:, None, None] * np.eye(3)
    return np.linalg.eigh(bilinear)[1][:, :, -1]


def about_z(yaw: float) -> np.ndarray:
    """(4,) w, x, y, z of a turn by `yaw` [rad] about the vertical."""
    return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def camera(pose: np.ndarray, mount: CameraMount) -> tuple[np.ndarray, np.ndarray]:
    """Where the optical frame of a camera is in `map`: turn (4,) w, x, y, z, and place (3,) [m]."""
    offset = np.array([[mount.forward_m, mount.left_m, mount.up_m]])
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    optical = turn @ stereo.rotation(mount) @ stereo.CAMERA_TO_BODY @ _UP_OF_OPTICAL
    return quaternions(optical[None])[0], stereo.to_map(pose, offset)[0]
