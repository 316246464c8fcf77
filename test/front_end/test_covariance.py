"""From pixels to metres: (14), its inverse, its slope and its noise."""

import numpy as np
import pytest
from front_end.planes import RIG

from multi_robot_slam.front_end.covariance import jacobian, pixel_sigmas, propagated
from multi_robot_slam.front_end.settings import FeatureSettings
from multi_robot_slam.models.symmetric import unpack

PIXELS = np.array([[10.0, 20.0, 3.0], [400.0, 300.0, 40.0], [239.5, 159.5, 12.0]])


def test_a_point_is_where_the_paper_puts_it():
    x, y, z = RIG.point(*PIXELS.T)[1]
    assert x == pytest.approx(RIG.baseline_m * (400 - RIG.centre_px[0]) / 40)
    assert y == pytest.approx(RIG.baseline_m * (RIG.centre_px[1] - 300) / 40)
    assert z == pytest.approx(RIG.focal_px * RIG.baseline_m / 40)
    assert x > 0 > y  # right of the axis, and below it


def test_pixels_and_points_are_inverse_to_each_other():
    np.testing.assert_allclose(RIG.pixel(RIG.point(*PIXELS.T)), PIXELS, rtol=1e-12)


def test_the_jacobian_is_the_finite_difference():
    step = 1e-4
    for column in range(3):
        delta = step * np.eye(3)[column]
        ends = RIG.point(*(PIXELS + delta).T), RIG.point(*(PIXELS - delta).T)
        numeric = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(jacobian(RIG, PIXELS)[:, :, column], numeric, atol=1e-7)


def test_the_covariance_is_that_of_many_noisy_measurements():
    sigmas = np.array([0.4, 0.3, 0.05])
    random = np.random.default_rng(0)
    for pixel in PIXELS:
        drawn = RIG.point(*(pixel + sigmas * random.normal(size=(200_000, 3))).T)
        exact = unpack(propagated(RIG, pixel[None], sigmas[None]))[0]
        scale = np.sqrt(np.outer(exact.diagonal(), exact.diagonal()))
        np.testing.assert_allclose(np.cov(drawn.T) / scale, exact / scale, atol=0.02)


def test_its_diagonal_is_the_papers():
    """(15)."""
    column, row, d = PIXELS[0]
    i, f = RIG.baseline_m, RIG.focal_px
    s_c, s_r, s_d = 0.4, 0.3, 0.1
    xx, _, _, yy, _, zz = propagated(RIG, PIXELS[:1], np.array([[s_c, s_r, s_d]]))[0]
    u, v = column - RIG.centre_px[0], RIG.centre_px[1] - row
    assert xx == pytest.approx(i**2 * s_c**2 / d**2 + i**2 * u**2 * s_d**2 / d**4)
    assert yy == pytest.approx(i**2 * s_r**2 / d**2 + i**2 * v**2 * s_d**2 / d**4)
    assert zz == pytest.approx(f**2 * i**2 * s_d**2 / d**4)


def test_large_keypoints_and_flat_windows_are_less_exact():
    settings = FeatureSettings()
    sigmas = pixel_sigmas(np.array([2.0, 30.0]), np.array([1e6, 50.0]), settings)
    assert sigmas[0] == pytest.approx(
        [settings.sigma_px, settings.sigma_px, settings.sigma_disparity_px], rel=0.02
    )
    assert (sigmas[1] > 2 * sigmas[0]).all()
    half = pixel_sigmas(np.array([2.0]), np.array([1e6]), FeatureSettings(scale=0.5))
    assert half[0, 0] == pytest.approx(2 * sigmas[0, 0], rel=0.02)
    assert half[0, 2] == sigmas[0, 2]
