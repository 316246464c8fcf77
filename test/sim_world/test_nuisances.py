"""What spoils rendered pictures: each does what its setting says, and nothing else."""

import numpy as np
import pytest
from rendered import PERFECT, ROOM, at, changed, checkered, grey, renderer, walls

from msg_defs.types import StereoCamera

EMPTY = walls(ROOM)
HERE = (3, 3, 0.0)
WALL = np.s_[180:300, 100:540]
"""Where the pictures show a wall alone from `HERE`."""


def pair(light=None, images=PERFECT, seed=0, pose=HERE, **truth):
    painted = checkered(EMPTY) if light is None else grey(EMPTY, light)
    return renderer(EMPTY, painted, images, seed=seed).pair(at(*pose, **truth))


@pytest.mark.parametrize("light", [20, 120, 220])
@pytest.mark.parametrize(("photon", "read"), [(3.0, 0.0), (0.0, 2.0), (4.0, 3.0)])
def test_noise_has_the_stated_variance(light, photon, read):
    noisy = pair(light, changed(photon_noise=photon, read_noise=read))
    expected = photon**2 * light / 255 + read**2 + 1 / 12
    for eye in noisy:
        values = eye[WALL].astype(float)
        assert values.mean() == pytest.approx(light, abs=0.1)
        assert values.var() == pytest.approx(expected, rel=0.04)
        neighbours = np.mean((values[:, 1:] - light) * (values[:, :-1] - light))
        assert abs(neighbours) < 0.03 * expected


def test_eyes_instants_robots_and_seeds_have_noise_of_their_own():
    images = changed(read_noise=2.0)
    pairs = [
        pair(120, images),
        pair(120, images, stamp_ns=2 * 10**9),
        pair(120, images, robot="robot_2"),
        pair(120, images, seed=1),
    ]
    noises = [eye[WALL].astype(float).ravel() - 120 for one in pairs for eye in one]
    correlations = np.corrcoef(noises) - np.eye(len(noises))
    assert np.abs(correlations).max() < 0.02


def test_the_same_seed_gives_the_same_bytes_in_any_order():
    images = changed(
        photon_noise=2.0, exposure_drift=0.2, gain_difference=0.1, people=5, exposure_s=0.02
    )
    truths = [at(3, 3, 0.1 * i, (0.5, 0.3), i * 10**9) for i in range(1, 5)]
    one, other = (renderer(EMPTY, checkered(EMPTY), images, seed=4) for _ in range(2))
    first = [np.stack(one.pair(true)) for true in truths]
    again = [np.stack(other.pair(true)) for true in reversed(truths)]
    np.testing.assert_array_equal(first, again[::-1])


def gains(images, light=100):
    """(T, 2) mean grey value of both eyes over two minutes, relative to the light."""
    shot = renderer(EMPTY, grey(EMPTY, light), images)
    pairs = [shot.pair(at(*HERE, stamp_ns=i * 10**9)) for i in range(0, 120, 3)]
    return np.array([[eye[WALL].mean() / light for eye in one] for one in pairs])


def test_exposure_drifts_in_both_cameras_alike():
    left, right = np.log(gains(changed(exposure_drift=0.3))).T
    np.testing.assert_array_equal(left, right)
    assert np.abs(left).max() == pytest.approx(0.3, abs=0.02)
    assert np.ptp(left) > 0.15
    assert np.abs(np.diff(left)).max() < 0.1


def test_the_right_gain_differs_from_the_left_and_drifts():
    left, right = np.log(gains(changed(gain_difference=0.2))).T
    assert not left.any()
    assert np.abs(right).max() == pytest.approx(0.2, abs=0.02)
    assert np.ptp(right) > 0.1


def test_vignetting_takes_the_stated_share_from_the_corners():
    dark = pair(200, changed(vignetting=0.4)).left.astype(float)
    bright = pair(200).left.astype(float)
    ratio = dark / bright
    assert ratio[240, 320] == pytest.approx(1, abs=0.01)
    for corner in (ratio[0, 0], ratio[0, -1], ratio[-1, 0], ratio[-1, -1]):
        assert corner == pytest.approx(0.6, abs=0.01)
    assert ratio[240, 0] == pytest.approx(1 - 0.4 * 320**2 / (320**2 + 240**2), abs=0.01)


def edge_spread(rows):
    """Standard deviation [px] of what has blurred an edge along the second axis."""
    slope = np.abs(np.diff(rows.astype(float), axis=1)).sum(0)
    slope[slope < 0.02 * slope.max()] = 0
    place = np.arange(len(slope))
    mean = np.average(place, weights=slope)
    return np.sqrt(np.average((place - mean) ** 2, weights=slope))


def test_the_lens_blurs_by_the_stated_deviation():
    """An upright edge 5 m ahead, at y = 3; the left camera is at 3.06.

    Pixels, and differences between them, each blur it by a square of one pixel as well.
    """
    for sigma in (1.0, 2.5):
        eye = pair(images=changed(blur_px=sigma)).left
        spread = edge_spread(eye[244:256, 320 + 6 - 12 : 320 + 6 + 13])
        assert spread == pytest.approx(np.sqrt(sigma**2 + 2 / 12), rel=0.05)


TURN = 1.0
"""Radians a second: 10 px in 20 ms."""


def test_motion_blur_spreads_along_the_movement_alone():
    turning = changed(exposure_s=0.02)
    sharp, blurred = pair(), pair(images=turning, twist=(0.0, TURN))
    upright = np.s_[244:256, 320 + 6 - 12 : 320 + 6 + 13]
    level = np.s_[250:280, 310:322]
    assert edge_spread(blurred.left[upright]) == pytest.approx(10 / 12**0.5, rel=0.1)
    # A row further down the wall has an edge between squares at 0.75 m, 25 px below the axis.
    for eye in (sharp.left, blurred.left):
        rows = eye[level].astype(float).mean(1)
        assert np.abs(np.diff(rows)).argmax() == np.abs(np.diff(sharp.left[level].mean(1))).argmax()
    assert edge_spread(blurred.left[level].T) < 0.6


def test_motion_blur_is_centred_on_the_stamp():
    """So that the blurred edge is where the pose has it."""
    blurred = pair(images=changed(exposure_s=0.02), twist=(0.0, TURN)).left
    sharp = pair().left
    around_one_edge = np.s_[244:256, 320 + 6 - 12 : 320 + 6 + 13]
    assert blurred[around_one_edge].mean() == pytest.approx(sharp[around_one_edge].mean(), abs=2)


def test_a_robot_at_rest_takes_sharp_pictures():
    np.testing.assert_array_equal(np.stack(pair(images=changed(exposure_s=0.05))), np.stack(pair()))


def test_driving_ahead_blurs_away_from_where_it_goes():
    moving = pair(images=changed(exposure_s=0.05), twist=(2.0, 0.0)).left.astype(int)
    change = np.abs(moving - pair().left)
    centre, outside = change[220:260, 300:340], change[100:380, 20:60]
    assert outside.mean() > 3 * centre.mean()


@pytest.mark.parametrize("off", [(0.5, 0.0), (0.0, -0.75), (3.0, 2.0)])
def test_the_right_picture_is_off_by_as_much_as_stated(off):
    """Half and quarter pixels are shifts of a picture twice and four times as large."""
    calibrated, off_by = pair(), pair(images=changed(right_off_px=off))
    np.testing.assert_array_equal(calibrated.left, off_by.left)
    fine = StereoCamera(focal_px=2000, width_px=2560, height_px=1920)
    large = renderer(EMPTY, checkered(EMPTY), PERFECT, fine).pair(at(*HERE)).right.astype(float)
    dx, dy = (int(4 * px) for px in off)
    # A pixel covers 4 x 4 of the large picture: pixel (0, 0) of both has its centre at (0, 0).
    shifted = np.roll(large, (dy, dx), (0, 1))
    sums = sum(
        weight_y * weight_x * np.roll(shifted, (-y, -x), (0, 1))
        for y, weight_y in zip(range(-2, 3), (0.5, 1, 1, 1, 0.5), strict=True)
        for x, weight_x in zip(range(-2, 3), (0.5, 1, 1, 1, 0.5), strict=True)
    )
    error = np.abs(off_by.right[WALL] - (sums / 16)[::4, ::4][WALL])
    assert error.max() < 15
    assert error.mean() < 1.5


def test_nothing_but_the_setting_differs():
    """Each defect leaves the others' random numbers as they are."""
    noise = changed(read_noise=2.0)
    plain, gained = pair(100, noise), pair(100, changed(noise, gain_difference=0.1))
    np.testing.assert_array_equal(plain.left, gained.left)
    crowded = pair(100, changed(noise, people=3))
    change = np.mean(crowded.left != plain.left)
    assert change < 0.5
