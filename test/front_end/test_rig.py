"""Calibrations: rectification puts points where (14) expects them, and bad ones are named."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from msg_defs.errors import InputError
from msg_defs.types import CameraInfo
from multi_robot_slam.front_end.rig import StereoRig

WIDTH, HEIGHT, FOCAL, BASELINE = 320, 240, 200.0, 0.12
K = np.array([[210.0, 0, 163], [0, 205.0, 118], [0, 0, 1]])
P = np.array([[FOCAL, 0, 160.0, 0], [0, FOCAL, 120.0, 0], [0, 0, 1, 0]])
LENSES = {
    "plumb_bob": [-0.2, 0.05, 0.001, -0.002, 0.0],
    "rational_polynomial": [0.1, -0.05, 0.001, 0.001, 0.01, 0.3, -0.05, 0.02],
    "equidistant": [-0.02, 0.01, -0.003, 0.001],
}


def info(side, model="plumb_bob", **changes):
    """A camera that is turned a little, by its side."""
    sign = 1 if side == "left" else -1
    projection = P.copy()
    projection[0, 3] = 0 if side == "left" else -FOCAL * BASELINE
    turn = cv2.Rodrigues(np.array([[0.01], [0.02 * sign], [0.015 * sign]]))[0]
    made = CameraInfo(0, side, WIDTH, HEIGHT, model, np.array(LENSES[model]), K, turn, projection)
    return replace(made, **changes)


def photographed(camera, points):
    """Pixels (n, 2) of `points` (n, 3) of the rectified frame (x right, y down) by the lens."""
    shift = np.array([camera.projection[0, 3] / FOCAL, 0, 0])
    seen = (points + shift) @ camera.rotation  # its inverse is its transpose
    zero = np.zeros((3, 1))
    project = (
        cv2.fisheye.projectPoints if camera.distortion_model == "equidistant" else cv2.projectPoints
    )
    pixels = project(seen[:, None], zero, zero, camera.intrinsics, camera.distortion)[0]
    return pixels.reshape(-1, 2)


def spot(pixel):
    """An image with one bright spot at `pixel`."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    distance_sq = (columns - pixel[0]) ** 2 + (rows - pixel[1]) ** 2
    return np.rint(250 * np.exp(-distance_sq / (2 * 3.0**2))).astype(np.uint8)


def centre(image):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return np.array([(columns * image).sum(), (rows * image).sum()]) / image.sum()


@pytest.mark.parametrize("model", LENSES)
def test_a_rectified_pair_shows_a_point_where_its_position_says(model):
    left, right = info("left", model), info("right", model)
    rig = StereoRig.of(left, right, rectify=True)
    assert (rig.focal_px, rig.baseline_m) == (FOCAL, pytest.approx(BASELINE))
    for point in np.array([[0.1, -0.2, 1.5], [-0.4, 0.3, 2.0], [0.5, 0.1, 1.4]]):
        raw = [spot(photographed(camera, point[None])[0]) for camera in (left, right)]
        (u, v), (u_right, v_right) = (centre(image) for image in rig.rectified(*raw))
        assert v == pytest.approx(v_right, abs=0.1)
        found = rig.point(np.array([u]), np.array([v]), np.array([u - u_right]))[0]
        np.testing.assert_allclose(found, point * [1, -1, 1], atol=0.012)


def test_rectified_images_stay_as_they_are():
    rig = StereoRig.of(info("left"), info("right"), rectify=False)
    images = np.random.default_rng(0).integers(0, 255, (2, HEIGHT, WIDTH), np.uint8)
    left, right = rig.rectified(*images)
    assert left is images[0] or (left == images[0]).all()
    np.testing.assert_array_equal(right, images[1])


def test_a_right_camera_with_another_centre_is_shifted_to_the_left_ones():
    """Where the two P differ in C_x, a disparity has a part that is no depth."""
    right = info("right")
    moved = right.projection.copy()
    moved[0, 2] += 10
    rig = StereoRig.of(info("left"), replace(right, projection=moved), rectify=False)
    _, image = rig.rectified(spot((150, 100)), spot((150, 100)))
    np.testing.assert_allclose(centre(image), [140, 100], atol=0.05)


def test_pixels_that_are_not_square_become_so():
    wide = info("left").projection.copy()
    wide[1, 1] = 1.2 * FOCAL
    left = info("left", projection=wide)
    right = info(
        "right",
        projection=wide
        - [[FOCAL * BASELINE * (i == 0 and j == 3) for j in range(4)] for i in range(3)],
    )
    rig = StereoRig.of(left, right, rectify=False)
    image, _ = rig.rectified(spot((160, 180)), spot((140, 180)))
    np.testing.assert_allclose(centre(image), [160, 170], atol=0.1)  # 60 px below C_y / 1.2


def test_a_left_camera_that_is_not_the_reference_counts():
    both = [info(side) for side in ("left", "right")]
    moved = [replace(one, projection=one.projection + np.eye(3, 4, 3) * 0) for one in both]
    for one in moved:
        one.projection[0, 3] += 30.0
    assert StereoRig.of(*moved, rectify=False).baseline_m == pytest.approx(BASELINE)


def without_baseline():
    return info("right", projection=P.copy())


def test_a_baseline_can_be_given_where_the_calibration_has_none():
    assert StereoRig.of(info("left"), without_baseline(), False, 0.2).baseline_m == 0.2
    assert StereoRig.of(info("left"), info("right"), False, 0.2).baseline_m == pytest.approx(
        BASELINE
    )


@pytest.mark.parametrize(
    ("left", "right", "rectify", "words"),
    [
        (info("left"), without_baseline(), False, ["0 m", "baseline_m"]),
        (info("right"), info("left"), False, ["0.12", "swap"]),
        (
            info("left", projection=np.zeros((3, 4))),
            info("right"),
            False,
            ["left", "P", "[0.0, 0.0]"],
        ),
        (info("left"), info("right", projection=np.full((3, 4), np.nan)), True, ["right", "P"]),
        (info("left"), info("right", width_px=321), False, ["320 x 240", "321 x 240"]),
        (
            info("left", distortion_model="pinhole_ish"),
            info("right"),
            True,
            ["pinhole_ish", "plumb_bob"],
        ),
        (
            info("left"),
            info("right", distortion=np.zeros(3)),
            True,
            ["right", "3 numbers", "4 or 5"],
        ),
        (info("left", width_px=0), info("right", width_px=0), False, ["0 x 240", "size"]),
        (
            info("left", width_px=10**6),
            info("right", width_px=10**6),
            True,
            ["1000000 x 240", "32766"],
        ),
        (info("left", intrinsics=np.zeros((3, 3))), info("right"), True, ["left", "K"]),
        (info("left"), info("right", rotation=np.zeros((3, 3))), True, ["right", "R", "rotation"]),
        (info("left", rotation=np.diag([1.0, 1, -1])), info("right"), True, ["left", "rotation"]),
    ],
)
def test_a_calibration_that_cannot_be_used_is_named_with_its_remedy(left, right, rectify, words):
    with pytest.raises(InputError) as told:
        StereoRig.of(left, right, rectify)
    assert all(word in str(told.value) for word in words), told.value
    assert "\n" not in str(told.value)


def test_a_lens_that_is_not_needed_is_not_asked_for():
    StereoRig.of(info("left", distortion_model="", distortion=np.empty(0)), info("right"), False)


@pytest.mark.parametrize("which", [0, 1])
def test_an_image_of_another_size_is_told(which):
    rig = StereoRig.of(info("left"), info("right"), rectify=True)
    images = [np.zeros((HEIGHT, WIDTH), np.uint8)] * 2
    images[which] = np.zeros((HEIGHT // 2, WIDTH // 2), np.uint8)
    with pytest.raises(InputError, match=r"160 x 120.*320 x 240"):
        rig.rectified(*images)
