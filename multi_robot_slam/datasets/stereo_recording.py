"""A recorded stereo camera: pairs of images, their calibration, and where the camera truly was."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, Self

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from msg_defs.errors import InputError
from msg_defs.types import CameraInfo, Trajectory

BESIDE_NS = 1_000_000
"""A stamp so far outside a path counts as its end: recordings round stamps."""


@dataclass(frozen=True, eq=False)
class SpacePath:
    """A camera's path in space, S poses; `map` has its z axis up."""

    stamps_ns: np.ndarray
    """(S,) int64, ascending."""
    places: np.ndarray
    """(S, 3) float64: the optical centre in `map` [m]."""
    rotations: np.ndarray
    """(S, 3, 3) float64: from the optical frame (x right, y down, z forward) to `map`."""

    def covers(self, stamps_ns: np.ndarray) -> np.ndarray:
        """(T,) bool: the path is known at `stamps_ns` (T,)."""
        first, last = self.stamps_ns[0] - BESIDE_NS, self.stamps_ns[-1] + BESIDE_NS
        return (stamps_ns >= first) & (stamps_ns <= last)

    def at(self, stamps_ns: np.ndarray) -> "SpacePath":
        """The path at `stamps_ns` (T,), interpolated, and held at its ends."""
        since = self.stamps_ns[0]  # absolute nanoseconds do not fit a float64
        known = (self.stamps_ns - since).astype(float)
        wanted = np.clip((stamps_ns - since).astype(float), 0.0, known[-1])
        places = np.column_stack([np.interp(wanted, known, axis) for axis in self.places.T])
        if len(known) == 1:
            return SpacePath(stamps_ns, places, np.repeat(self.rotations, len(wanted), axis=0))
        turned = Slerp(known, Rotation.from_matrix(self.rotations))(wanted)
        return SpacePath(stamps_ns, places, turned.as_matrix())

    def planar(self) -> Trajectory:
        """The path in the plane: x, y of the optical centre, yaw of the optical axis."""
        ahead = self.rotations[:, :, 2]
        yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
        return Trajectory(self.stamps_ns, np.column_stack([self.places[:, :2], yaw]))


class StereoCalibration(NamedTuple):
    """Of the left and the right camera, and how the left one was turned to be rectified."""

    left: CameraInfo
    right: CameraInfo
    """Stamps are 0 and frames empty."""


@dataclass(frozen=True, eq=False)
class StereoPairs:
    """T pairs of grey images of one camera, and its calibration."""

    stamps_ns: np.ndarray
    """(T,) int64, ascending."""
    left: Sequence[Path]
    right: Sequence[Path]
    """T files each, as they were recorded."""
    calibration: StereoCalibration
    is_rectified: bool
    """What is in the files; else they are to be rectified by the calibration."""

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def images(self, row: int) -> tuple[np.ndarray, np.ndarray]:
        """Left and right image of a pair, (H, W) uint8 each."""
        return read_grey(self.left[row]), read_grey(self.right[row])

    def of(self, rows: Iterable[int]) -> Self:
        """Some of the pairs."""
        chosen = list(rows)
        return replace(
            self,
            stamps_ns=self.stamps_ns[chosen],
            left=[self.left[row] for row in chosen],
            right=[self.right[row] for row in chosen],
        )


@dataclass(frozen=True, eq=False)
class StereoRecording(StereoPairs):
    """The same, and where the camera truly was."""

    truth: SpacePath
    """Of the rectified left camera, in whose frame observations are."""


def read_grey(path: Path) -> np.ndarray:
    """(H, W) uint8; `InputError` where the file is no image."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise InputError(f"{path} is missing or no image; unpack the recording again")
    return image


def calibrate(
    intrinsics: tuple[np.ndarray, np.ndarray],
    distortions: tuple[np.ndarray, np.ndarray],
    size: tuple[int, int],
    left_to_right: tuple[np.ndarray, np.ndarray],
) -> StereoCalibration:
    """Calibration of a pair that is not rectified, by Bouguet's method, without black borders.

    Parameters
    ----------
    intrinsics : K (3, 3) of the left and the right camera [px].
    distortions : D (5,) of each: k1 k2 p1 p2 k3.
    size : width and height [px].
    left_to_right : R (3, 3), t (3,) [m]: a point x of the left optical frame is R x + t in the
        right one.

    """
    rotation, shift = left_to_right
    turns = cv2.stereoRectify(
        intrinsics[0],
        distortions[0],
        intrinsics[1],
        distortions[1],
        size,
        rotation,
        shift.reshape(3, 1),
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0,
    )[:4]
    infos = [
        camera_info(size, intrinsics[side], turns[2 + side], distortions[side], turns[side])
        for side in (0, 1)
    ]
    return StereoCalibration(*infos)


def camera_info(
    size: tuple[int, int],
    intrinsics: np.ndarray,
    projection: np.ndarray,
    distortion: np.ndarray | None = None,
    rotation: np.ndarray | None = None,
) -> CameraInfo:
    """One camera's calibration; without `distortion` and `rotation` it is rectified already."""
    return CameraInfo(
        stamp_ns=0,
        frame="",
        width_px=size[0],
        height_px=size[1],
        distortion_model="plumb_bob",
        distortion=np.zeros(5) if distortion is None else distortion,
        intrinsics=intrinsics,
        rotation=np.eye(3) if rotation is None else rotation,
        projection=projection,
    )
