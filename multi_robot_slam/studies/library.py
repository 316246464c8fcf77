"""A stereo camera that was carried round a library and ended where it began.

It comes with the examples of BoofCV (stereo_params.xml is its calibration):

    library/left/left1.jpg, library/right/right1.jpg, ...      no stamps
    library/stereo_params.xml

There is no truth but that the frame `CLOSING` was taken beside `FIRST`: both see the same shelves.
"""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from msg_defs.errors import InputError
from multi_robot_slam.datasets.stereo_recording import (
    StereoCalibration,
    StereoPairs,
    calibrate,
)

PERIOD_NS = 100_000_000
"""Of the stamps, which stand for those that are missing."""

FIRST, CLOSING = 1, 337
"""Numbers of two images of one place."""


def read(folder: Path) -> StereoPairs:
    """The pairs in `folder`, in their order."""
    root = folder / "library" if (folder / "library").is_dir() else folder
    numbers = sorted(
        int(path.stem.removeprefix("left")) for path in (root / "left").glob("left*.jpg")
    )
    if not numbers:
        raise InputError(f"{folder}: no left/left1.jpg in it; name the folder of the library")
    stamps = np.array(numbers, np.int64) * PERIOD_NS
    return StereoPairs(
        stamps_ns=stamps,
        left=[root / "left" / f"left{number}.jpg" for number in numbers],
        right=[root / "right" / f"right{number}.jpg" for number in numbers],
        calibration=_calibration(root / "stereo_params.xml"),
        is_rectified=False,
    )


def row_of(pairs: StereoPairs, number: int) -> int:
    """The row of the pair with this number."""
    return int(np.searchsorted(pairs.stamps_ns, number * PERIOD_NS))


def _calibration(path: Path) -> StereoCalibration:
    try:
        root = ET.parse(path).getroot()
        cameras = [root.find(side) for side in ("left", "right")]
        turned = np.array([float(v.text or "") for v in root.iterfind("rightToLeft/r/data/double")])
        shift = np.array([_number(root, f"rightToLeft/t/{axis}") for axis in "xyz"])
        left, right = (_camera(camera) for camera in cameras if camera is not None)
        size = (int(_number(root, "left/width")), int(_number(root, "left/height")))
        rotation = turned.reshape(3, 3).T
    except (OSError, ET.ParseError, ValueError) as error:
        raise InputError(f"{path} is no calibration by BoofCV ({error}); unpack it again") from None
    return calibrate((left[0], right[0]), (left[1], right[1]), size, (rotation, -rotation @ shift))


def _camera(camera: ET.Element) -> tuple[np.ndarray, np.ndarray]:
    """K (3, 3) and D (5,)."""
    fx, fy, cx, cy = (_number(camera, name) for name in ("fx", "fy", "cx", "cy"))
    radial = [float(value.text or "") for value in camera.iterfind("radial/double")]
    distortion = np.array([*radial, 0.0, 0.0, 0.0])
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), distortion


def _number(element: ET.Element, path: str) -> float:
    return float(element.findtext(path, ""))
