"""Keypoints of one image, and which of them are kept."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from msg_defs.types import DESCRIPTOR_SIZE
from multi_robot_slam.front_end.settings import FeatureSettings
from multi_robot_slam.models.ranks import in_groups


@dataclass(frozen=True, eq=False)
class Keypoints:
    """SIFT keypoints of one image, the strongest first, no two at one place."""

    pixels: np.ndarray
    """(n, 2) float64: column and row [px]."""
    sizes: np.ndarray
    """(n,) float64: diameter [px]."""
    descriptors: np.ndarray
    """(n, 128) float32, unit norm: the roots of SIFT's histograms (Arandjelovic, Zisserman 2012).

    At equal false matches they find every tenth place more again than the histograms do.
    """

    @classmethod
    def of(cls, image: np.ndarray, settings: FeatureSettings) -> Keypoints:
        """Those of a grey image (H, W) uint8; none in a flat one.

        Where one has several orientations, the smallest angle counts: cameras on the ground stay
        upright. OpenCV's own keypoints lie a quarter of a pixel off; `enable_precise_upscale`
        mends that.
        """
        sift = cv2.SIFT.create(
            nfeatures=settings.features,
            contrastThreshold=settings.contrast_threshold,
            enable_precise_upscale=True,
        )
        found, descriptors = sift.detectAndCompute(image, None)
        if not found:
            return cls(np.empty((0, 2)), np.empty(0), np.empty((0, DESCRIPTOR_SIZE), np.float32))
        table = np.array([(*k.pt, k.size, k.angle, k.response) for k in found])
        order = np.lexsort((table[:, 3], table[:, 2], table[:, 1], table[:, 0], -table[:, 4]))
        places = table[order, :3]
        order = order[np.append(True, (places[1:] != places[:-1]).any(axis=1))]
        shares = descriptors / descriptors.sum(axis=1, keepdims=True)
        return cls(table[order, :2], table[order, 2], np.sqrt(shares)[order])


PER_CELL = 8
"""Points of a cell, if all have enough. More cells spread the points better, fewer choose the same
ones again: of 50 points in a rendered picture 42 % were kept in the next one with one to a cell,
50 % with eight, 56 % without cells."""


def spread(pixels: np.ndarray, shape: tuple[int, ...], most: int) -> np.ndarray:
    """Rows of `pixels` (n, 2), strongest first, that are kept: at most `most`, all over the image.

    The image of `shape` (H, W) is cut into square cells, one for each `PER_CELL` points. The
    strongest of every cell comes before the second of any.
    """
    side = np.sqrt(shape[0] * shape[1] * PER_CELL / most)
    columns = int(np.ceil(shape[1] / side))
    column, row = (pixels // side).astype(int).T
    cells = row * columns + column
    ranks = in_groups(cells, np.arange(len(cells)))
    return np.sort(np.argsort(ranks, kind="stable")[:most])


APART_PX = 5.0
"""Keypoints nearer to each other are one thing, in several sizes."""


def distinct(found: Keypoints, rows: np.ndarray, least: float) -> np.ndarray:
    """(len(rows),) bool: E (19) of the keypoint to any other of the image is `least` or more.

    What looks the same twice in one image, as repeated texture does, would be taken for each other
    in the map.
    """
    cosines = np.minimum(found.descriptors[rows] @ found.descriptors.T, 1)
    one, other = np.nonzero(cosines > 1 - least / 2)
    apart = found.pixels[rows[one]] - found.pixels[other]
    is_other = (apart**2).sum(axis=1) >= APART_PX**2
    result = np.ones(len(rows), bool)
    result[one[is_other]] = False
    return result
