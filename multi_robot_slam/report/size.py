"""How large the scene is, and how large uncertainty is drawn in it."""

import numpy as np

from msg_defs.types import LandmarkMap
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.runs import Run

SIGMAS = 2.0
"""Half axes of every ellipse and ellipsoid, in standard deviations."""
SCALES = (1, 5, 10, 30)
"""How many times larger ellipses and ellipsoids can be drawn."""
LEGIBLE = 1 / 40
"""Share of the scene's width that most ellipsoids should not exceed at first."""
MARGIN = 0.03


def extent(run: Run) -> np.ndarray:
    """(2, 3): lowest and highest corner of the scene [m].

    It holds live, later and true paths, walls, and all landmarks but the outermost hundredth.
    """
    flat = [path.poses[:, :2] for r in run.robots.values() for path in (r.online, r.path)]
    flat += [r.truth.poses[:, :2] for r in run.robots.values() if r.truth is not None]
    flat += [r.start_pose[None, :2] for r in run.robots.values()]
    cameras = [run.config.mount_of(robot).up_m for robot in range(len(run.config.robots))]
    heights = [0.0, 2 * max(cameras)]
    if run.walls is not None:
        flat.append(run.walls.segments.reshape(-1, 2))
        heights.append(run.walls.height_m)
    if len(run.landmarks.ids):
        inner = np.quantile(run.landmarks.positions, [0.01, 0.99], axis=0)
        flat.append(inner[:, :2])
        heights += inner[:, 2].tolist()
    places = np.concatenate(flat)
    low = np.array([*places.min(axis=0), min(heights)])
    high = np.array([*places.max(axis=0), max(heights)])
    margin = MARGIN * max((high - low)[:2].max(), 1.0)
    return np.array([low, high]) + np.outer([-margin, margin], [1.0, 1.0, 0.0])


def first_scale(run: Run) -> int:
    """The largest of `SCALES` at which nine in ten ellipsoids are legible, else the smallest."""
    if not len(run.landmarks.ids):
        return SCALES[0]
    largest = np.linalg.norm(full_roots(run.landmarks), ord=2, axis=(1, 2))
    room = LEGIBLE * np.ptp(extent(run), axis=0)[:2].max()
    legible = [scale for scale in SCALES if scale * np.quantile(largest, 0.9) <= room]
    return max(legible, default=SCALES[0])


def roots(covariances: np.ndarray) -> np.ndarray:
    """Symmetric square roots (n, d, d) of positive semi-definite (n, d, d), times `SIGMAS`."""
    values, vectors = np.linalg.eigh(covariances)
    scaled = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return SIGMAS * scaled @ vectors.transpose(0, 2, 1)


def full_roots(landmarks: LandmarkMap) -> np.ndarray:
    """(N, 3, 3) `roots` of the landmarks' covariances [m]."""
    return roots(unpack(landmarks.covariances))
