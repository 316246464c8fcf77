"""Every encoding becomes the brightness that OpenCV makes of the same colours."""

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from msg_defs import wire
from msg_defs.errors import InputError
from msg_defs.types import Image
from multi_robot_slam.front_end.grey import grey

ORDERS = ("rggb", "bggr", "gbrg", "grbg")


def image(encoding, pixels):
    return Image(0, "camera", encoding, pixels)


def scene(height=40, width=60):
    """(H, W, 3) uint8, red green blue, smooth enough for mosaics and halved colours."""
    noise = np.random.default_rng(3).integers(0, 256, (height, width, 3), np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 5), None, 0, 255, cv2.NORM_MINMAX)


def mosaic(colours, order):
    """(H, W): of each pixel the colour that the pattern of ROS's `order` lets through."""
    channel = ["rgb".index(letter) for letter in order]
    pattern = np.zeros(colours.shape[:2], colours.dtype)
    for place, letter in enumerate(channel):
        row, column = divmod(place, 2)
        pattern[row::2, column::2] = colours[row::2, column::2, letter]
    return pattern


def brightness(colours):
    return cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY)


RGB = scene()
ALPHA = np.full(RGB.shape[:2], 17, np.uint8)
PACKED = {
    "mono8": brightness(RGB),
    "8UC1": brightness(RGB),
    "rgb8": RGB,
    "bgr8": RGB[:, :, ::-1],
    "8UC3": RGB[:, :, ::-1],
    "rgba8": np.dstack([RGB, ALPHA]),
    "bgra8": np.dstack([RGB[:, :, ::-1], ALPHA]),
    "8UC4": np.dstack([RGB[:, :, ::-1], ALPHA]),
}


@pytest.mark.parametrize("encoding", PACKED)
def test_eight_bits_are_as_opencv_has_them(encoding):
    found = grey(image(encoding, PACKED[encoding]))
    np.testing.assert_array_equal(found, brightness(RGB), strict=True)


@pytest.mark.parametrize("encoding", ["mono16", "16UC1", "rgb16", "bgr16", "rgba16", "bgra16"])
@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_sixteen_bits_keep_the_upper_eight_that_are_used(encoding, bits):
    pixels = PACKED[{"16UC1": "8UC1"}.get(encoding, encoding.replace("16", "8"))]
    finer = (pixels.astype(np.uint16) << (bits - 8)) + (1 << (bits - 8)) // 2
    np.testing.assert_array_equal(
        grey(image(encoding, finer)), grey(image("mono8", brightness(RGB))), strict=True
    )


@given(st.integers(1, 2**16 - 1))
def test_the_brightest_of_sixteen_bits_lands_in_the_upper_half(brightest):
    pixels = np.array([[0, brightest // 2, brightest]], np.uint16)
    found = grey(image("mono16", pixels))[0]
    assert found[0] == 0
    assert found[2] == brightest if brightest < 256 else found[2] >= 128
    assert abs(int(found[2]) - 2 * int(found[1])) <= 2


def test_black_stays_black():
    black = np.zeros((3, 4), np.uint16)
    np.testing.assert_array_equal(grey(image("mono16", black)), np.zeros((3, 4), np.uint8))


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("colour", [(250, 20, 60), (10, 240, 90), (30, 70, 255)])
def test_a_mosaic_of_one_colour_is_its_brightness(order, bits, colour):
    """Red, green and blue weigh differently: a pattern read in another order is seen at once."""
    colours = np.full((12, 16, 3), colour, np.uint8)
    pattern = mosaic(colours, order).astype(f"u{bits // 8}") << (bits - 8)
    if bits == 16:
        pattern[0, 0] |= 0x8000 if max(colour) < 128 else 0
    found = grey(image(f"bayer_{order}{bits}", pattern))[2:-2, 2:-2]
    np.testing.assert_allclose(found.astype(int), brightness(colours)[2:-2, 2:-2], atol=1)


@pytest.mark.parametrize("order", ORDERS)
def test_a_mosaic_is_nearly_the_picture_that_it_was_made_of(order):
    found = grey(image(f"bayer_{order}8", mosaic(RGB, order))).astype(int)
    assert np.abs(found - brightness(RGB))[2:-2, 2:-2].mean() < 2


@pytest.mark.parametrize(
    ("encoding", "code"),
    [
        ("yuv422", cv2.COLOR_YUV2GRAY_UYVY),
        ("uyvy", cv2.COLOR_YUV2GRAY_UYVY),
        ("yuv422_yuy2", cv2.COLOR_YUV2GRAY_YUY2),
        ("yuyv", cv2.COLOR_YUV2GRAY_YUY2),
    ],
)
def test_halved_colours_are_as_opencv_has_them(encoding, code):
    pixels = np.random.default_rng(4).integers(0, 256, (8, 10, 2), np.uint8)
    np.testing.assert_array_equal(
        grey(image(encoding, pixels)), cv2.cvtColor(pixels, code), strict=True
    )


def test_yuv_brightness_comes_first_in_yuyv_and_second_in_uyvy():
    pixels = np.zeros((2, 2, 2), np.uint8)
    pixels[:, :, 0] = 200
    assert (grey(image("yuyv", pixels)) == 200).all()
    assert (grey(image("uyvy", pixels)) == 0).all()


@pytest.mark.parametrize("encoding", wire.ENCODINGS)
def test_whatever_is_read_becomes_grey_padded_or_not(encoding):
    """The rows of a message may be padded: its pixels are a view that must not be written to."""
    kind = wire.ENCODINGS[encoding]
    shape = (6, 8, kind.channels)[: 2 + (kind.channels > 1)]
    whole = np.random.default_rng(5).integers(0, 200, (6, 11, *shape[2:]), kind.dtype)
    whole.flags.writeable = False
    found = grey(image(encoding, whole[:, :8]))
    assert (found.shape, found.dtype) == ((6, 8), np.uint8)
    assert found.flags.c_contiguous
    np.testing.assert_array_equal(found, grey(image(encoding, whole[:, :8].copy())))


def test_an_unknown_encoding_is_refused():
    with pytest.raises(InputError, match="encoding 'nv21' is not read; publish mono8, "):
        grey(image("nv21", RGB))
