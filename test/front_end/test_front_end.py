"""The front end as a whole, on planes whose points are known."""

from dataclasses import asdict

import numpy as np
import pytest
from front_end import planes

from msg_defs.errors import InputError
from multi_robot_slam.front_end.front_end import FrontEnd
from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.front_end.settings import CameraSettings, FeatureSettings
from multi_robot_slam.models.symmetric import unpack

RIG = planes.RIG


def front_end(**features):
    return FrontEnd(RIG, CameraSettings(features=FeatureSettings(**features)))


def arrays(seen):
    return seen.positions, seen.covariances, seen.descriptors, seen.pixels, seen.sizes


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_points_lie_on_the_planes(scale):
    seen = front_end(scale=scale, observations=150).observe(*planes.pair())
    assert len(seen.positions) > 40
    column, row, d = seen.pixels.T
    away = np.abs(row - planes.HEIGHT / 2) > 10
    error = (d - planes.disparity(column, row))[away]
    assert np.sqrt(np.mean(error**2)) < 0.08
    np.testing.assert_allclose(seen.positions, RIG.point(column, row, d), rtol=1e-6)


def test_half_the_size_shifts_no_point():
    """The centre of a pixel of the small image is a corner of four of the large one."""
    left, right = planes.pair(noise=0.0)
    whole, half = (front_end(scale=s, observations=400).observe(left, right) for s in (1.0, 0.5))
    apart = half.pixels[:, None, :2] - whole.pixels[None, :, :2]
    nearest = np.linalg.norm(apart, axis=2).argmin(axis=1)
    shift = apart[np.arange(len(nearest)), nearest]
    shift = shift[np.abs(shift).max(axis=1) < 1.5]
    assert len(shift) > 30
    np.testing.assert_allclose(np.median(shift, axis=0), 0, atol=0.15)


def test_depth_errors_are_as_large_as_the_covariances_say_or_smaller():
    """The defaults are those of real cameras, whose calibration is not exact."""
    values = []
    for seed in range(3):
        seen = front_end().observe(*planes.pair(seed=seed))
        column, row, _ = seen.pixels.T
        away = np.abs(row - planes.HEIGHT / 2) > 10
        truth = RIG.point(column, row, planes.disparity(column, row))
        error = (seen.positions - truth)[away]
        information = np.linalg.inv(unpack(seen.covariances)[away])
        values.append(np.einsum("ni,nij,nj->n", error, information, error))
    values = np.concatenate(values)
    assert (values < 6.63).mean() > 0.98  # 99 % of one degree of freedom: only depth is in error
    assert values.mean() > 0.05


def test_types_and_shapes_are_those_of_an_observation_set():
    seen = front_end(observations=30).observe(*planes.pair())
    assert [array.dtype for array in arrays(seen)[:3]] == [np.float32] * 3
    assert seen.positions.shape == (30, 3)
    assert seen.covariances.shape == (30, 6)
    assert seen.descriptors.shape == (30, 128)
    assert (np.linalg.eigvalsh(unpack(seen.covariances)) > 0).all()


def test_every_keypoint_is_counted_once():
    for images in (planes.pair(), planes.pair(noise=12.0)):
        counts = asdict(front_end(observations=40).observe(*images).counts)
        assert counts.pop("keypoints") == sum(counts.values())
        assert counts["kept"] > 0


def test_the_same_images_give_the_same_bytes():
    left, right = planes.pair()
    padded = [np.pad(image, 3)[3:-3, 3:-3] for image in (left, right)]
    first, again = front_end().observe(left, right), front_end().observe(*padded)
    assert all(
        one.tobytes() == two.tobytes()
        for one, two in zip(arrays(first), arrays(again), strict=True)
    )


@pytest.mark.parametrize("grey", [0, 255])
def test_black_and_overexposed_images_show_nothing(grey):
    flat = np.full((planes.HEIGHT, planes.WIDTH), grey, np.uint8)
    left, right = planes.pair()
    for images in ((flat, flat), (left, flat), (flat, right)):
        seen = front_end().observe(*images)
        assert [len(array) for array in arrays(seen)] == [0] * 5


def test_points_beyond_the_farthest_are_left_out():
    """17.3 px are 1.73 m."""
    seen = front_end(farthest_m=1.5).observe(*planes.pair())
    assert seen.counts.far > 0
    assert len(seen.positions) > 0
    assert seen.positions[:, 2].max() <= 1.5
    assert front_end(farthest_m=0.5).observe(*planes.pair()).counts.kept == 0


def test_points_nearer_than_the_nearest_are_not_found_there():
    seen = front_end(nearest_m=1.4).observe(*planes.pair())
    assert len(seen.positions) > 0
    assert seen.positions[:, 2].min() >= 1.4 - 0.05


def test_depths_that_a_disparity_does_not_tell_are_left_out():
    """At a tenth of the disparity depth is no longer Gaussian."""
    seen = front_end(sigma_disparity_px=1.8).observe(*planes.pair())
    assert len(seen.positions) > 0
    assert seen.pixels[:, 2].min() > 18.0


def test_an_image_of_another_size_is_an_input_error():
    left, right = planes.pair()
    with pytest.raises(InputError, match="480 x 320"):
        front_end().observe(left, right[:, 10:])


def test_an_odd_image_at_half_scale_has_its_points_where_they_are():
    """641 columns become 320: the last are further from where twice the column says."""
    right = np.random.default_rng(0).integers(60, 70, (161, 641)).astype(np.uint8)
    row, column = np.mgrid[:161, :641]
    blob = np.exp(-((column - 600.0) ** 2 + (row - 80.0) ** 2) / (2 * 5.0**2))
    left = (right + 150 * blob).astype(np.uint8)
    right = (right + 150 * np.roll(blob, -12, axis=1)).astype(np.uint8)
    rig = StereoRig(500.0, (320.0, 80.0), 0.1, 641, 161)
    settings = CameraSettings(features=FeatureSettings(scale=0.5, distinct=0.0))
    pixels = FrontEnd(rig, settings).observe(left, right).pixels
    nearest = np.linalg.norm(pixels[:, :2] - [600, 80], axis=1).min()
    assert nearest < 0.3


def test_an_image_too_small_for_the_scale_shows_nothing():
    settings = CameraSettings(features=FeatureSettings(scale=1e-4))
    assert len(FrontEnd(RIG, settings).observe(*planes.pair()).positions) == 0
