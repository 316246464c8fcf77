"""Keypoints of one image, and their descriptors."""

from dataclasses import dataclass

import cv2
import numpy as np

from multi_robot_slam.front_end.settings import FeatureSettings


@dataclass(frozen=True, eq=False)
class Keypoints:
    """SIFT keypoints of one image, strongest first."""

    pixels: np.ndarray
    """(n, 2) float64: column and row [px]."""
    sizes: np.ndarray
    """(n,) float64: diameter [px]."""
    strengths: np.ndarray
    """(n,) float64: contrast."""
    descriptors: np.ndarray
    """(n, 128) float32, unit norm."""


def keypoints(image: np.ndarray, settings: FeatureSettings) -> Keypoints:
    """SIFT keypoints of a grey image (H, W) uint8; none in a flat one."""
    sift = cv2.SIFT_create(
        nfeatures=settings.features,
        contrastThreshold=settings.contrast_threshold,
        enable_precise_upscale=True,
    )
    found, descriptors = sift.detectAndCompute(image, None)
    if not found:
        return Keypoints(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty((0, 128), np.float32))
    raw = np.array([(*point.pt, point.size, point.response) for point in found])
    order = np.lexsort((raw[:, 0], raw[:, 1], -raw[:, 3]))
    raw, descriptors = raw[order], descriptors[order]
    norms = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return Keypoints(raw[:, :2], raw[:, 2], raw[:, 3], descriptors / norms)


def spread(pixels: np.ndarray, shape: tuple[int, int], most: int) -> np.ndarray:
    """Rows of `pixels` (n, 2), strongest first, that are kept: at most `most`, all over the image.

    The image of `shape` (H, W) is cut into about `most` square cells. Of each the strongest is kept
    before the second of any is.
    """
    side = np.sqrt(shape[0] * shape[1] / most)
    columns = int(np.ceil(shape[1] / side))
    cells = (pixels[:, 1] // side).astype(int) * columns + (pixels[:, 0] // side).astype(int)
    order = np.argsort(cells, kind="stable")
    starts = np.flatnonzero(np.diff(cells[order], prepend=-1))
    ranks = np.empty(len(pixels), int)
    ranks[order] = np.arange(len(pixels)) - np.repeat(starts, np.diff(starts, append=len(pixels)))
    return np.sort(np.lexsort((np.arange(len(pixels)), ranks))[:most])
