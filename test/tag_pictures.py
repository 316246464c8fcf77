"""Synthetic pictures of tags: planes in space, seen by both cameras of a rig."""

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from multi_robot_slam.front_end.rig import StereoRig

RIG = StereoRig(450.0, (320.0, 240.0), 0.12, 640, 480)
SIZE_M = 0.16
FINER = 6
"""Rays through a pixel, in each direction; they are jittered, so that no edge falls on a grid."""


class Tag(NamedTuple):
    """A tag in space, as a camera sees it: X right, Y up, Z forward [m]."""

    number: int
    centre: tuple[float, float, float]
    turned: float = 0.0
    """About the vertical, to the right as seen from above: its right edge goes away [rad]."""
    pitched: float = 0.0
    """Its upper edge goes away [rad]."""
    rolled: float = 0.0
    """Clockwise as seen [rad]."""
    size_m: float = SIZE_M

    def axes(self) -> np.ndarray:
        """(3, 2): to the right and up on the printed tag."""
        (ct, cp, cr), (st, sp, sr) = (
            f([self.turned, self.pitched, self.rolled]) for f in (np.cos, np.sin)
        )
        turn = np.array([[ct, 0, -st], [0, 1, 0], [st, 0, ct]])
        pitch = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
        roll = np.array([[cr, sr, 0], [-sr, cr, 0], [0, 0, 1]])
        return (turn @ pitch @ roll)[:, :2]

    def corners(self, scale: float = 1.0) -> np.ndarray:
        """(4, 3): upper left, upper right, lower right, lower left of the black square."""
        half = scale * self.size_m / 2
        return self.centre + np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]]) * half @ self.axes().T


@cache
def backdrop(seed: int = 0, rig: StereoRig = RIG) -> np.ndarray:
    """(H, W) uint8: something that is no tag."""
    noise = np.random.default_rng(seed).normal(size=(rig.height_px, rig.width_px))
    smooth = cv2.GaussianBlur(noise, (0, 0), 12)
    return cv2.normalize(smooth, None, 60, 190, cv2.NORM_MINMAX).astype(np.uint8)


def pair(
    tags: list[Tag],
    family: int = cv2.aruco.DICT_APRILTAG_36h11,
    seed: int = 0,
    noise: float = 2.0,
    blur_px: float = 0.6,
    rig: StereoRig = RIG,
) -> tuple[np.ndarray, np.ndarray]:
    """Left and right picture (H, W) uint8; noise in grey levels, blur as a lens has it."""
    rng = np.random.default_rng(seed)
    dictionary = cv2.aruco.getPredefinedDictionary(family)
    pictures = []
    for eye in (0.0, rig.baseline_m):
        seen = backdrop(seed, rig).astype(float)
        for tag in tags:
            _draw(seen, tag, eye, dictionary, rig, rng)
        seen = cv2.GaussianBlur(seen, (0, 0), blur_px) + noise * rng.normal(size=seen.shape)
        pictures.append(np.clip(np.rint(seen), 0, 255).astype(np.uint8))
    return pictures[0], pictures[1]


def _draw(
    picture: np.ndarray,
    tag: Tag,
    eye: float,
    dictionary: cv2.aruco.Dictionary,
    rig: StereoRig,
    rng: np.random.Generator,
) -> None:
    """Paint a tag with a white margin of one cell, each pixel the mean of many rays through it."""
    cells = dictionary.markerSize + 2
    printed = cv2.aruco.generateImageMarker(dictionary, tag.number, cells)
    printed = 30 + np.pad(printed, 1, constant_values=255) * (200 / 255)
    seen = rig.pixel(tag.corners((cells + 2) / cells) - [eye, 0, 0])[:, :2]
    source = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32) * (cells + 2)
    to_cells = cv2.getPerspectiveTransform(seen.astype(np.float32), source)
    low = np.clip(np.floor(seen.min(axis=0)).astype(int) - 1, 0, None)
    high = np.clip(np.ceil(seen.max(axis=0)).astype(int) + 2, 0, picture.shape[::-1])
    if (low >= high).any():
        return
    shape = (high[1] - low[1], high[0] - low[0], FINER, FINER)
    column, row = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    steps = np.arange(FINER) / FINER - 0.5
    across = column[:, :, None, None] + steps + rng.uniform(0, 1 / FINER, shape)
    down = row[:, :, None, None] + steps[:, None] + rng.uniform(0, 1 / FINER, shape)
    rays = np.stack([across.ravel(), down.ravel(), np.ones(across.size)])
    x, y, w = to_cells @ rays
    x, y = np.floor(x / w).astype(int).reshape(shape), np.floor(y / w).astype(int).reshape(shape)
    is_tag = (x >= 0) & (y >= 0) & (x < cells + 2) & (y < cells + 2)
    behind = picture[low[1] : high[1], low[0] : high[0]]
    shades = np.where(
        is_tag, printed[np.where(is_tag, y, 0), np.where(is_tag, x, 0)], behind[:, :, None, None]
    )
    behind[:] = shades.mean(axis=(2, 3))
