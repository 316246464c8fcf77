"""Any picture -> brightness in eight bits, which is all the front end looks at."""

import cv2
import numpy as np

from msg_defs import wire
from msg_defs.errors import InputError
from msg_defs.types import Image

_BRIGHT = {"mono", "UC1"}
_CONVERSIONS = {
    "rgb": cv2.COLOR_RGB2GRAY,
    "rgba": cv2.COLOR_RGBA2GRAY,
    "bgr": cv2.COLOR_BGR2GRAY,
    "UC3": cv2.COLOR_BGR2GRAY,
    "bgra": cv2.COLOR_BGRA2GRAY,
    "UC4": cv2.COLOR_BGRA2GRAY,
    # ROS names the first two pixels of the first two rows, OpenCV's short names the next ones.
    "bayer_rggb": cv2.COLOR_BayerRGGB2GRAY,
    "bayer_bggr": cv2.COLOR_BayerBGGR2GRAY,
    "bayer_gbrg": cv2.COLOR_BayerGBRG2GRAY,
    "bayer_grbg": cv2.COLOR_BayerGRBG2GRAY,
}
_BRIGHTNESS_AT = {"yuv422": 1, "uyvy": 1, "yuv422_yuy2": 0, "yuyv": 0}
"""Which of a pixel's two bytes is its brightness; the other is colour."""


def grey(image: Image) -> np.ndarray:
    """Brightness (H, W) uint8 of a picture of any of `msg_defs.wire.ENCODINGS`.

    Sixteen bits become eight by the smallest shift with which the brightest value fits. A camera
    of 12 bits in 16 so keeps its upper eight, without being told, and the result depends on
    nothing but this picture. `InputError` for another encoding.
    """
    if image.encoding not in wire.ENCODINGS:
        raise InputError(
            f"image: encoding {image.encoding!r} is not read; publish {', '.join(wire.ENCODINGS)}"
        )
    if image.encoding in _BRIGHTNESS_AT:
        return np.ascontiguousarray(image.pixels[:, :, _BRIGHTNESS_AT[image.encoding]])
    pixels = _eight_bits(image.pixels)
    colours = image.encoding.removesuffix("16").removesuffix("8").lstrip("0123456789")
    if colours in _BRIGHT:
        return np.ascontiguousarray(pixels)
    return cv2.cvtColor(pixels, _CONVERSIONS[colours])


def _eight_bits(pixels: np.ndarray) -> np.ndarray:
    if pixels.dtype == np.uint8:
        return pixels
    shift = max(int(pixels.max()).bit_length() - 8, 0)
    return (pixels >> shift).astype(np.uint8)
