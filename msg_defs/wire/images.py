"""Pictures of cameras, raw and compressed, and the cameras' calibration."""

from typing import Any, Literal, NamedTuple

import numpy as np

from msg_defs.errors import InputError
from msg_defs.types import CameraInfo, Image
from msg_defs.wire import messages
from msg_defs.wire.messages import decode, encode, header_of, require_finite, stamp_of


class PixelFormat(NamedTuple):
    """How the pixels of one encoding are stored."""

    dtype: np.dtype
    channels: int


_BYTE, _WORD = np.dtype(np.uint8), np.dtype(np.uint16)
_COLOURS = {"mono": 1, "rgb": 3, "bgr": 3, "rgba": 4, "bgra": 4}
_COLOURS |= {f"bayer_{order}": 1 for order in ("rggb", "bggr", "gbrg", "grbg")}

ENCODINGS = {
    **{f"{colours}8": PixelFormat(_BYTE, count) for colours, count in _COLOURS.items()},
    **{f"{colours}16": PixelFormat(_WORD, count) for colours, count in _COLOURS.items()},
    **{f"8UC{count}": PixelFormat(_BYTE, count) for count in (1, 3, 4)},
    "16UC1": PixelFormat(_WORD, 1),
    **{name: PixelFormat(_BYTE, 2) for name in ("yuv422", "uyvy", "yuv422_yuy2", "yuyv")},
}
"""Encodings that are read, by their names in sensor_msgs/image_encodings."""

_UNPACKED = {PixelFormat(_BYTE, 1): "mono8", PixelFormat(_WORD, 1): "mono16"} | {
    PixelFormat(dtype, count): f"{'bgra'[:count]}{dtype.itemsize * 8}"
    for dtype in (_BYTE, _WORD)
    for count in (3, 4)
}
"""The encoding of what OpenCV makes of a compressed picture."""

MOST_PIXELS = 1 << 26
"""Larger compressed pictures are taken for damaged: they would fill the memory."""

_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_JPEG_START, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
"""Markers of the segments that hold a picture's size."""


def encode_image(image: Image) -> bytes:
    """sensor_msgs/Image, its rows without padding.

    `InputError` where the pixels are not what the encoding says.
    """
    kind = _checked_format(image)
    height, width = image.pixels.shape[:2]
    return encode(
        messages.Image(
            header=header_of(image.stamp_ns, image.frame),
            height=height,
            width=width,
            encoding=image.encoding,
            is_bigendian=0,
            step=width * kind.channels * kind.dtype.itemsize,
            data=_bytes_of(np.ascontiguousarray(image.pixels, kind.dtype.newbyteorder("<"))),
        )
    )


def decode_image(data: bytes, what: str) -> Image:
    """The picture in a sensor_msgs/Image; `what` it is begins the complaint when it is none.

    Where rows are padded, pixels are a view with a stride; nothing is copied but for a swap of
    bytes.
    """
    message = decode(messages.Image, memoryview(data), what)
    kind = _format(message.encoding, what)
    pixels = _rows(message, kind, what).view(
        kind.dtype.newbyteorder(">" if message.is_bigendian else "<")
    )
    if kind.channels > 1:
        pixels = pixels.reshape(message.height, message.width, kind.channels)
    return Image(
        stamp_of(message.header, what),
        message.header.frame_id,
        message.encoding,
        pixels.astype(kind.dtype, copy=False),
    )


def _rows(message: Any, kind: PixelFormat, what: str) -> np.ndarray:
    """(H, bytes of a row) uint8, without padding."""
    used = message.width * kind.channels * kind.dtype.itemsize
    if message.height == 0 or message.width == 0:
        raise InputError(
            f"{what}: a picture of {message.width} x {message.height} pixels; publish one with some"
        )
    if message.step < used or message.data.size != message.height * message.step:
        raise InputError(
            f"{what}: width {message.width}, height {message.height}, encoding "
            f"{message.encoding}, step {message.step} and {message.data.size} bytes of data "
            f"disagree; step is at least {used}, data is height * step"
        )
    return message.data.reshape(message.height, message.step)[:, :used]


def encode_compressed(
    image: Image, format: Literal["jpeg", "png"] = "jpeg", quality: int = 95
) -> bytes:
    """sensor_msgs/CompressedImage of one value a pixel, or of blue, green and red in this order.

    `quality` 0 to 100 is that of JPEG. `InputError` for pixels that the format does not hold.
    """
    import cv2  # 18 MB that only compressed pictures need

    kind = _checked_format(image)
    is_stored = kind.channels == 1 or image.encoding in _UNPACKED.values()
    if not is_stored or (format == "jpeg" and (kind.dtype != _BYTE or kind.channels == 4)):
        raise InputError(
            f"image: {image.encoding} cannot be written as {format}; use mono8 or bgr8, and png "
            "for 16 bits and transparency"
        )
    parameters = [cv2.IMWRITE_JPEG_QUALITY, quality] if format == "jpeg" else []
    _, packed = cv2.imencode("." + format, image.pixels, parameters)
    return encode(
        messages.CompressedImage(
            header=header_of(image.stamp_ns, image.frame),
            format=f"{image.encoding}; {format} compressed ",
            data=packed.ravel(),
        )
    )


def encode_packed(packed: bytes, format: str, stamp_ns: int, frame: str) -> bytes:
    """sensor_msgs/CompressedImage of a grey picture as a file of this `format` holds it."""
    return encode(
        messages.CompressedImage(
            header=header_of(stamp_ns, frame),
            format=f"mono8; {format} compressed ",
            data=np.frombuffer(packed, np.uint8),
        )
    )


def decode_compressed(data: bytes, what: str) -> Image:
    """The picture in a sensor_msgs/CompressedImage of JPEG or PNG, of 8 or 16 bits.

    Its encoding is the one that the message states where this has one value a pixel, as a Bayer
    pattern has, and else mono8, bgr8, bgra8, mono16, ...
    """
    import cv2

    message = decode(messages.CompressedImage, memoryview(data), what)
    _require_whole(message.data.tobytes(), message.format, what)
    try:
        pixels = cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise _damaged(message, what) from error
    if pixels is None:
        raise _damaged(message, what)
    kind = _pixel_format(pixels)
    if kind not in _UNPACKED:
        raise _damaged(message, what)
    stated = message.format.partition(";")[0].strip()
    is_stated = kind.channels == 1 and ENCODINGS.get(stated) == kind
    encoding = stated if is_stated else _UNPACKED[kind]
    return Image(stamp_of(message.header, what), message.header.frame_id, encoding, pixels)


def packed_image(data: bytes, what: str) -> bytes:
    """The JPEG or PNG in a sensor_msgs/CompressedImage as it was sent: a whole file."""
    message = decode(messages.CompressedImage, data, what)
    packed = message.data.tobytes()
    _require_whole(packed, message.format, what)
    return packed


def _damaged(message: Any, what: str) -> InputError:
    return InputError(
        f"{what}: {message.data.size} bytes of format {message.format!r} are no picture; publish "
        "JPEG or PNG"
    )


def _require_whole(packed: bytes, format: str, what: str) -> None:
    """Complain of a picture that is not JPEG or PNG, was cut off, or would fill the memory."""
    if packed.startswith(_PNG_START):
        is_whole, size = packed.endswith(_PNG_END), _png_size(packed)
    elif packed.startswith(_JPEG_START):
        is_whole, size = packed.rstrip(b"\0").endswith(_JPEG_END), _jpeg_size(packed)
    else:
        raise InputError(
            f"{what}: {len(packed)} bytes of format {format!r} that begin with "
            f"{packed[:4].hex(' ')} are no JPEG or PNG; publish one of these"
        )
    if not is_whole:
        raise InputError(
            f"{what}: the {len(packed)} bytes of format {format!r} lack their end; publish the "
            "whole picture"
        )
    width, height = size
    if not 0 < width * height <= MOST_PIXELS:
        raise InputError(
            f"{what}: a compressed picture of {width} x {height} pixels; publish one of 1 to "
            f"{MOST_PIXELS}"
        )


def _png_size(packed: bytes) -> tuple[int, int]:
    return int.from_bytes(packed[16:20], "big"), int.from_bytes(packed[20:24], "big")


def _jpeg_size(packed: bytes) -> tuple[int, int]:
    """Width and height in the first segment that tells them; zeros without one."""
    at = 2
    while at + 9 <= len(packed) and packed[at] == 0xFF:
        marker, length = packed[at + 1], int.from_bytes(packed[at + 2 : at + 4], "big")
        if marker in _JPEG_FRAMES:
            height, width = packed[at + 5 : at + 7], packed[at + 7 : at + 9]
            return int.from_bytes(width, "big"), int.from_bytes(height, "big")
        at += 1 if marker == 0xFF else 2 + length
    return 0, 0


def encode_camera_info(info: CameraInfo) -> bytes:
    """sensor_msgs/CameraInfo of the whole image, without binning."""
    return encode(
        messages.CameraInfo(
            header=header_of(info.stamp_ns, info.frame),
            height=info.height_px,
            width=info.width_px,
            distortion_model=info.distortion_model,
            d=np.asarray(info.distortion, np.float64),
            k=np.asarray(info.intrinsics, np.float64).ravel(),
            r=np.asarray(info.rotation, np.float64).ravel(),
            p=np.asarray(info.projection, np.float64).ravel(),
            binning_x=0,
            binning_y=0,
            roi=messages.RegionOfInterest(0, 0, 0, 0, False),
        )
    )


def decode_camera_info(data: bytes, what: str) -> CameraInfo:
    """The calibration in a sensor_msgs/CameraInfo; an unknown one has zeros in K and P."""
    message = decode(messages.CameraInfo, data, what)
    _require_whole_image(message, what)
    for name in "dkrp":
        require_finite(getattr(message, name), what, name.upper())
    return CameraInfo(
        stamp_of(message.header, what),
        message.header.frame_id,
        message.width,
        message.height,
        message.distortion_model,
        message.d.astype(np.float64),
        message.k.reshape(3, 3).astype(np.float64),
        message.r.reshape(3, 3).astype(np.float64),
        message.p.reshape(3, 4).astype(np.float64),
    )


def _require_whole_image(message: Any, what: str) -> None:
    """Complain of binning and of a region of interest: K and P would be those of another image."""
    if message.binning_x > 1 or message.binning_y > 1:
        raise InputError(
            f"{what}: binning {message.binning_x} x {message.binning_y}; publish the calibration "
            "of the images as they are sent, without binning"
        )
    roi = message.roi
    region = roi.x_offset, roi.y_offset, roi.width, roi.height
    if region not in ((0, 0, 0, 0), (0, 0, message.width, message.height)):
        raise InputError(
            f"{what}: region of interest {roi.width} x {roi.height} at {roi.x_offset}, "
            f"{roi.y_offset}; publish the calibration of the images as they are sent, without one"
        )


def _format(encoding: str, what: str) -> PixelFormat:
    try:
        return ENCODINGS[encoding]
    except KeyError:
        raise InputError(
            f"{what}: encoding {encoding!r} is not read; publish {', '.join(ENCODINGS)}"
        ) from None


def _checked_format(image: Image) -> PixelFormat:
    kind = _format(image.encoding, "image")
    if _pixel_format(image.pixels) != kind or image.pixels.ndim != 2 + (kind.channels > 1):
        raise InputError(
            f"image: pixels {image.pixels.dtype} {image.pixels.shape} are not {image.encoding}; "
            f"that is {kind.dtype}, {kind.channels} to a pixel"
        )
    return kind


def _pixel_format(pixels: np.ndarray) -> PixelFormat:
    return PixelFormat(pixels.dtype, pixels.shape[2] if pixels.ndim == 3 else 1)


def _bytes_of(pixels: np.ndarray) -> np.ndarray:
    return pixels.reshape(-1).view(np.uint8)
