"""A stereo pair in, observations out."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from multi_robot_slam.front_end import kernels, tags
from multi_robot_slam.front_end.covariance import pixel_sigmas, propagated
from multi_robot_slam.front_end.disparity import Search, refined, searched
from multi_robot_slam.front_end.features import Keypoints, distinct, spread
from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.front_end.settings import CameraSettings, FeatureSettings
from multi_robot_slam.front_end.tags import Tags

WORST_DISPARITY = 0.1
"""Standard deviation of a disparity over itself, at most: farther points are not Gaussian in (14).
One standard deviation either way moves the depth by 9 % or by 11 %."""

CANDIDATES = 3
"""So many times as many points as are kept are looked at closely."""


@dataclass(frozen=True)
class Counts:
    """What became of the keypoints of a pair."""

    keypoints: int
    outside: int
    """Too near the border of an image."""
    weak: int
    """Correlation of left and right too low, or best at the end of what was searched."""
    ambiguous: int
    """Another place on the row fits as well."""
    one_way: int
    """The right image's point fits another point of the left one better."""
    on_tag: int
    """On a tag, which is seen as a whole: its pattern resembles that of others, and may move."""
    unsteady: int
    """The disparity depends on the window that is compared: an edge in depth, or no texture."""
    far: int
    """Farther than `farthest_m`, or too far for the disparity to tell the depth."""
    repeated: int
    """Looks like another point of the image."""
    surplus: int
    """More than `observations`."""
    kept: int


@dataclass(frozen=True, eq=False)
class Seen:
    """What one stereo pair shows: B points, the last of which are tags."""

    positions: np.ndarray
    """(B, 3) float32: X right, Y up, Z forward, of the rectified left camera [m]."""
    covariances: np.ndarray
    """(B, 6) float32: of each position, `xx xy xz yy yz zz` [m^2]."""
    descriptors: np.ndarray
    """(B, 128) float32, unit norm."""
    pixels: np.ndarray
    """(B, 3) float64: column and row in the rectified left image, and disparity [px]."""
    sizes: np.ndarray
    """(B,) float64: diameter of the keypoint in that image [px]."""
    counts: Counts
    tags: Tags
    """The tags among them, robots that carry others, and what became of all."""


class FrontEnd:
    """Finds points with position, covariance and descriptor in the pairs of one rig."""

    def __init__(self, rig: StereoRig, settings: CameraSettings) -> None:
        self.rig = rig
        self.settings = settings

    def observe(self, left: np.ndarray, right: np.ndarray) -> Seen:
        """What a pair of grey images (H, W) uint8 shows: nothing, where they show nothing.

        The result depends on the images, the rig and the settings alone. InputError where an image
        does not have the calibration's size.
        """
        left, right = self.rig.rectified(left, right)
        settings = self.settings.features
        known = tags.find(left, right, self.rig, self.settings.tags)
        found, points = _keypoints(left, settings)
        search = Search(int(np.ceil(self._disparity(settings.nearest_m))), settings.correlation)
        coarse, fates = searched(left, right, points, search)
        matched = np.flatnonzero((fates == kernels.FOUND) & ~known.cover(points))
        tried = matched[spread(points[matched], left.shape, CANDIDATES * settings.observations)]
        disparities, information = refined(left, right, points[tried], coarse[tried])
        is_steady = information > 0
        steady = tried[is_steady]
        pixels = np.column_stack([points[steady], disparities[is_steady]])
        sizes = found.sizes[steady] / settings.scale
        sigmas = pixel_sigmas(sizes, information[is_steady], settings)
        near = np.flatnonzero(self._is_near(pixels, sigmas))
        alone = near[distinct(found, steady[near], settings.distinct)]
        kept = alone[spread(pixels[alone, :2], left.shape, settings.observations)]
        places = self.rig.point(*pixels[kept].T).astype(np.float32)
        covariances = propagated(self.rig, pixels[kept], sigmas[kept]).astype(np.float32)
        return Seen(
            positions=np.concatenate([places, known.positions]),
            covariances=np.concatenate([covariances, known.covariances]),
            descriptors=np.concatenate([found.descriptors[steady[kept]], known.descriptors]),
            pixels=np.concatenate([pixels[kept], known.pixels]),
            sizes=np.concatenate([sizes[kept], known.sides_px]),
            counts=Counts(
                keypoints=len(points),
                **_lost(fates),
                on_tag=int((fates == kernels.FOUND).sum()) - len(matched),
                unsteady=len(tried) - len(steady),
                far=len(steady) - len(near),
                repeated=len(near) - len(alone),
                surplus=len(matched) - len(tried) + len(alone) - len(kept),
                kept=len(kept),
            ),
            tags=known,
        )

    def _disparity(self, depth_m: float) -> float:
        """Of a point so far away [px]."""
        return self.rig.focal_px * self.rig.baseline_m / depth_m

    def _is_near(self, pixels: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
        """(n,) bool: disparities of `pixels` (n, 3), exact to `sigmas` (n, 3), tell the depth."""
        least = np.maximum(
            self._disparity(self.settings.features.farthest_m), sigmas[:, 2] / WORST_DISPARITY
        )
        return pixels[:, 2] > least


def _lost(fates: np.ndarray) -> dict[str, int]:
    """How many points the search lost, by cause, as `Counts` names them."""
    causes = {
        "outside": kernels.OUTSIDE,
        "weak": kernels.WEAK,
        "ambiguous": kernels.AMBIGUOUS,
        "one_way": kernels.ONE_WAY,
    }
    return {name: int((fates == fate).sum()) for name, fate in causes.items()}


def _keypoints(image: np.ndarray, settings: FeatureSettings) -> tuple[Keypoints, np.ndarray]:
    """Keypoints of `image` at the scale that is searched, and where they are in it (n, 2) [px]."""
    if settings.scale == 1:
        found = Keypoints.of(image, settings)
        return found, found.pixels
    scale = settings.scale
    size = [max(1, round(pixels * scale)) for pixels in image.shape[::-1]]
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    found = Keypoints.of(small, settings)
    ratio = np.divide(image.shape[::-1], small.shape[::-1])
    return found, (found.pixels + 0.5) * ratio - 0.5
