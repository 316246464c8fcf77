"""A stereo pair's geometry: what it is after rectification, and how to get there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from msg_defs.errors import InputError
from msg_defs.types import CameraInfo

SAME_PX = 0.01
"""Intrinsics that differ by less are the same: a tenth of the disparity's error [px]."""


MOST_PX = 32_766
"""Width and height of the largest image that OpenCV rectifies [px]."""


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Two pin-hole cameras with parallel axes, equal intrinsics and square pixels."""

    focal_px: float
    """f of the rectified pair."""
    centre_px: tuple[float, float]
    """(C_x, C_y): column and row of the optical axis, of both rectified images."""
    baseline_m: float
    """I: the right camera is so far to the right of the left one."""
    width_px: int
    height_px: int
    maps: tuple[Remapping | None, Remapping | None] = (None, None)
    """What turns the left and the right image into the rectified ones; None where one is so."""

    @classmethod
    def of(
        cls, left: CameraInfo, right: CameraInfo, rectify: bool, baseline_m: float = 0.0
    ) -> StereoRig:
        """The rig that two calibrations describe.

        Parameters
        ----------
        left, right : calibrations of the two cameras.
        rectify : the images are as the cameras take them, and K, D, R and P rectify them; else they
            are rectified, and only P counts.
        baseline_m : where P of the right camera holds none.

        Raises
        ------
        InputError
            No calibration, no baseline, no size, cameras swapped, sizes that differ, an unknown
            distortion.

        """
        sizes = [(info.width_px, info.height_px) for info in (left, right)]
        if sizes[0] != sizes[1]:
            raise InputError(
                f"camera_info: the left image is {_size(sizes[0])} pixels, the right one "
                f"{_size(sizes[1])}; calibrate the pair at one size"
            )
        if not all(0 < pixels <= MOST_PX for pixels in sizes[0]):
            raise InputError(
                f"camera_info: images of {_size(sizes[0])} pixels; calibrate the pair and send "
                f"the size of its images, {MOST_PX} each way at most"
            )
        for side, info in (("left", left), ("right", right)):
            _require_projection(side, info)
        focal, centre = left.projection[0, 0], left.projection[:2, 2]
        target = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
        return cls(
            focal_px=float(focal),
            centre_px=(float(centre[0]), float(centre[1])),
            baseline_m=_baseline(left, right, baseline_m),
            width_px=left.width_px,
            height_px=left.height_px,
            maps=(
                _remapping("left", left, rectify, target),
                _remapping("right", right, rectify, target),
            ),
        )

    def rectified(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The two grey images (H, W) uint8 with rows that correspond; the same where they do.

        InputError where a size is not the calibration's.
        """
        for side, image in (("left", left), ("right", right)):
            if image.shape != (self.height_px, self.width_px):
                raise InputError(
                    f"{side} image: {_size(image.shape[::-1])} pixels, but camera_info says "
                    f"{self.width_px} x {self.height_px}; send the calibration of this size"
                )
        return _remapped(left, self.maps[0]), _remapped(right, self.maps[1])

    def point(self, u: np.ndarray, v: np.ndarray, disparity: np.ndarray) -> np.ndarray:
        """(14): pixels (n,) of the left image and disparities [px] -> (n, 3) X, Y, Z [m]."""
        scale = self.baseline_m / disparity
        return np.stack(
            [
                (u - self.centre_px[0]) * scale,
                (self.centre_px[1] - v) * scale,
                self.focal_px * scale,
            ],
            axis=-1,
        )

    def pixel(self, points: np.ndarray) -> np.ndarray:
        """The inverse of (14): points (..., 3) [m] -> (..., 3) column, row, disparity [px]."""
        x, y, z = np.moveaxis(points, -1, 0)
        scale = self.focal_px / z
        return np.stack(
            [
                self.centre_px[0] + x * scale,
                self.centre_px[1] - y * scale,
                self.baseline_m * scale,
            ],
            axis=-1,
        )


Remapping = tuple[np.ndarray, np.ndarray]
"""OpenCV's fixed-point maps: where each pixel of the result is taken from."""


def _size(size: tuple[int, ...]) -> str:
    return " x ".join(str(n) for n in size)


def _require_projection(side: str, info: CameraInfo) -> None:
    """InputError where P is not one of a rectified camera."""
    focal = info.projection[[0, 1], [0, 1]]
    if not (np.isfinite(info.projection).all() and (focal > 0).all()):
        raise InputError(
            f"camera_info of the {side} camera: P has focal lengths {focal.tolist()}; "
            "calibrate the pair and send its P"
        )


def _baseline(left: CameraInfo, right: CameraInfo, otherwise_m: float) -> float:
    """Distance of the cameras [m]: -P[0, 3] / f of the right one, against the left one's."""
    shifts = [info.projection[0, 3] / info.projection[0, 0] for info in (left, right)]
    baseline = float(shifts[0] - shifts[1])
    if baseline < 0:
        raise InputError(
            f"camera_info: the right camera is {-baseline:.4g} m to the left of the left one; "
            "swap the two cameras' topics"
        )
    if baseline == 0 and otherwise_m == 0:
        raise InputError(
            "camera_info: P[0, 3] = 0 of the right camera, so the baseline is 0 m; send "
            "P[0, 3] = -f * baseline, or set `baseline_m`"
        )
    return baseline or otherwise_m


def _remapping(side: str, info: CameraInfo, rectify: bool, target: np.ndarray) -> Remapping | None:
    """From the image as it comes to the rectified one with intrinsics `target` (3, 3)."""
    size = (info.width_px, info.height_px)
    fixed = cv2.CV_16SC2
    if not rectify:
        source = info.projection[:, :3]
        if np.allclose(source, target, rtol=0, atol=SAME_PX):
            return None
        return cv2.initUndistortRectifyMap(source, None, np.eye(3), target, size, fixed)
    _require_lens(side, info)
    model = (info.intrinsics, info.distortion, info.rotation, target, size, fixed)
    if info.distortion_model == "equidistant":
        return cv2.fisheye.initUndistortRectifyMap(*model)
    return cv2.initUndistortRectifyMap(*model)


COEFFICIENTS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (0, 8, 12, 14), "equidistant": (4,)}
"""Distortion models of sensor_msgs, and how many numbers each has in D."""


def _require_lens(side: str, info: CameraInfo) -> None:
    """InputError where K, D and R do not tell how to rectify."""
    where = f"camera_info of the {side} camera"
    if info.distortion_model not in COEFFICIENTS:
        raise InputError(
            f"{where}: distortion model {info.distortion_model!r}; known are "
            f"{', '.join(COEFFICIENTS)}. Or send rectified images"
        )
    if info.distortion.size not in COEFFICIENTS[info.distortion_model]:
        raise InputError(
            f"{where}: D has {info.distortion.size} numbers, {info.distortion_model} has "
            f"{' or '.join(str(n) for n in COEFFICIENTS[info.distortion_model])}; calibrate anew"
        )
    if not (info.intrinsics[[0, 1], [0, 1]] > 0).all():
        raise InputError(f"{where}: K is {info.intrinsics.tolist()}; calibrate it and send its K")
    is_rotation = np.allclose(info.rotation @ info.rotation.T, np.eye(3), atol=1e-3)
    if not is_rotation or np.linalg.det(info.rotation) < 0:
        raise InputError(
            f"{where}: R is {info.rotation.tolist()}, no rotation; calibrate the pair and send R"
        )


def _remapped(image: np.ndarray, maps: Remapping | None) -> np.ndarray:
    if maps is None:
        return image
    return cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR)
