"""A stereo pair in, observations out."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from multi_robot_slam.front_end import kernels
from multi_robot_slam.front_end.covariance import propagated
from multi_robot_slam.front_end.disparity import disparities
from multi_robot_slam.front_end.features import keypoints, spread
from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.front_end.settings import CameraSettings


@dataclass(frozen=True, eq=False)
class Counts:
    """What became of the keypoints of a pair."""

    keypoints: int
    outside: int
    """Too near the border of an image, or too near the camera."""
    weak: int
    """Correlation too low."""
    ambiguous: int
    """A second place on the row that fits as well."""
    one_way: int
    """The right image's point fits another point of the left one better."""
    far: int
    """Farther than `farthest_m`."""
    matched: int
    """Points with a disparity, before they were spread."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What one stereo pair shows: B points."""

    positions: np.ndarray
    """(B, 3) float32: X right, Y up, Z forward in the left rectified camera's frame [m]."""
    covariances: np.ndarray
    """(B, 6) float32: of each position, `xx xy xz yy yz zz` [m^2]."""
    descriptors: np.ndarray
    """(B, 128) float32, unit norm."""
    pixels: np.ndarray
    """(B, 3) float64: column, row, disparity in the rectified left image [px]."""
    counts: Counts


class FrontEnd:
    """Finds points with position, covariance and descriptor in pairs of one rig."""

    def __init__(self, rig: StereoRig, settings: CameraSettings) -> None:
        self.rig = rig
        self.settings = settings

    def observe(self, left: np.ndarray, right: np.ndarray) -> Seen:
        """What a pair of grey images (H, W) uint8 shows; nothing, where they show nothing.

        Depends on the images, the rig and the settings alone. InputError where an image does not
        have the calibration's size.
        """
        settings = self.settings.features
        left, right = self.rig.rectified(left, right)
        small = _shrunk(left, settings.scale)
        scales = np.array(left.shape[::-1]) / small.shape[::-1]
        found = keypoints(small, settings)
        points = (found.pixels + 0.5) * scales - 0.5
        shifts, fates = disparities(left, right, points, settings, self.rig)
        nearest_px = self.rig.focal_px * self.rig.baseline_m / settings.farthest_m
        matched = fates == kernels.FOUND
        usable = np.flatnonzero(matched & (shifts >= nearest_px))
        kept = usable[spread(points[usable], left.shape, settings.observations)]
        pixels = np.column_stack([points[kept], shifts[kept]])
        sigmas = np.tile(
            [settings.sigma_px, settings.sigma_px, settings.sigma_disparity_px], (len(kept), 1)
        )
        return Seen(
            positions=self.rig.point(*pixels.T).astype(np.float32),
            covariances=propagated(self.rig, pixels, sigmas).astype(np.float32),
            descriptors=found.descriptors[kept],
            pixels=pixels,
            counts=Counts(
                len(points),
                *(int((fates == fate).sum()) for fate in range(kernels.FOUND)),
                far=int(matched.sum()) - len(usable),
                matched=len(usable),
            ),
        )


def _shrunk(image: np.ndarray, scale: float) -> np.ndarray:
    if scale == 1:
        return image
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
