"""Disparities: against slow twins, and against planes whose disparity is known."""

import numpy as np
import pytest
from front_end import planes
from scipy.ndimage import map_coordinates
from scipy.optimize import brentq

from multi_robot_slam.front_end import kernels
from multi_robot_slam.front_end.disparity import (
    LEAST_PX,
    STEADY_PX,
    UNIQUENESS,
    Search,
    refined,
    searched,
)

SEARCH = Search(most_px=60, correlation=0.8)


def window(image, column, row, radius):
    return image[row - radius : row + radius + 1, column - radius : column + radius + 1].astype(
        float
    )


def correlation(one, two):
    one, two = one - one.mean(), two - two.mean()
    scale = np.sqrt((one**2).sum() * (two**2).sum())
    return (one * two).sum() / scale if scale else -1.0


def slow_scores(template, image, column, row, columns):
    own = window(template, column, row, kernels.RADIUS)
    return np.array([correlation(own, window(image, x, row, kernels.RADIUS)) for x in columns])


def slow_match(left, right, column, row, search):
    """`match_row`, one sentence of its docstring after the other."""
    margin, width = kernels.MARGIN, left.shape[1]
    if not (margin <= column < width - margin and margin <= row < left.shape[0] - margin):
        return 0.0, kernels.OUTSIDE
    places = np.arange(max(column - search.most_px, margin), column - LEAST_PX + 1)
    if len(places) < 3:
        return 0.0, kernels.OUTSIDE
    scores = slow_scores(left, right, column, row, places)
    best = int(scores.argmax())
    if scores[best] < search.correlation or best in (0, len(scores) - 1):
        return 0.0, kernels.WEAK
    inner = scores[1:-1]
    is_peak = (inner >= scores[:-2]) & (inner >= scores[2:])
    is_peak[max(best - 2, 0) : best + 1] = False
    second = inner[is_peak].max(initial=-1.0)
    if 1 - scores[best] > UNIQUENESS * (1 - second):
        return 0.0, kernels.AMBIGUOUS
    back = np.arange(
        places[best] + LEAST_PX, min(places[best] + search.most_px, width - 1 - margin) + 1
    )
    if abs(back[slow_scores(right, left, places[best], row, back).argmax()] - column) > 1:
        return 0.0, kernels.ONE_WAY
    parabola = np.polyfit([-1, 0, 1], scores[best - 1 : best + 2], 2)
    return column - places[best] + parabola[1] / (2 * parabola[0]), kernels.FOUND


def slow_refine(left, right, column, row, disparity):
    """Where the gradient of the two windows' difference vanishes, contrast and brightness free."""
    radius = kernels.REFINED_RADIUS
    target = window(left, column, row, radius)
    target = target - target.mean()
    slopes = np.gradient(right.astype(float), axis=1)
    rows, columns = np.mgrid[-radius : radius + 1, -radius : radius + 1].astype(float)

    def parts(d):
        place = [rows + row, columns + column - d]
        values, slope = (map_coordinates(g, place, order=1) for g in (right.astype(float), slopes))
        values, slope = values - values.mean(), slope - slope.mean()
        gain = (target * values).sum() / (values**2).sum()
        slope = gain * (slope - values * (slope * values).sum() / (values**2).sum())
        return slope, target - gain * values

    d = brentq(lambda d: np.multiply(*parts(d)).sum(), disparity - 0.5, disparity + 0.5)
    slope, error = parts(d)
    return d, (slope**2).sum() / max((error**2).mean(), kernels.LEAST_NOISE)


def some_points(count, seed=0):
    random = np.random.default_rng(seed)
    return random.uniform([0, 0], [planes.WIDTH - 1, planes.HEIGHT - 1], (count, 2))


def repeated(period=16):
    """A pair in which everything comes again every `period` columns."""
    left, right = planes.pair()
    return tuple(np.tile(image[:, :period], (1, planes.WIDTH // period)) for image in (left, right))


@pytest.mark.parametrize("images", [planes.pair(), planes.pair(noise=25.0), repeated()])
def test_the_compiled_search_is_the_slow_one(images):
    points = some_points(120)
    disparities, fates = searched(*images, points, SEARCH)
    slow = [slow_match(*images, *np.rint(point).astype(int), SEARCH) for point in points]
    np.testing.assert_array_equal(fates, [fate for _, fate in slow])
    np.testing.assert_allclose(disparities, [d for d, _ in slow], atol=1e-3)


def test_every_fate_is_met():
    """So that the twins above say something."""
    fates = [
        searched(*images, some_points(400), SEARCH)[1]
        for images in (planes.pair(), planes.pair(noise=25.0), repeated())
    ]
    assert {kernels.OUTSIDE, kernels.WEAK, kernels.AMBIGUOUS, kernels.FOUND} <= set(
        np.concatenate(fates).tolist()
    )


def test_what_fits_another_point_better_is_no_match():
    """A patch that the left image has twice, the second time without noise."""
    left, right = (image.copy() for image in planes.pair(noise=0.0))
    random = np.random.default_rng(3)
    patch = window(left, 200, 80, 20)
    right[60:101, 165:206] = patch
    left[60:101, 180:221] = np.clip(patch + random.normal(0, 12, patch.shape), 0, 255)
    left[60:101, 221:262] = patch
    _, fates = searched(left, right, np.array([[199.0, 80.0]]), SEARCH)
    assert fates.tolist() == [kernels.ONE_WAY]


def test_the_compiled_refinement_is_the_slow_one():
    left, right = planes.pair()
    points = some_points(150)
    disparities, fates = searched(left, right, points, SEARCH)
    points, disparities = points[fates == kernels.FOUND], disparities[fates == kernels.FOUND]
    result, information = refined(left, right, points, disparities)
    good = information > 0
    assert good.mean() > 0.9
    for point, start, d, known in zip(
        points[good], disparities[good], result[good], information[good], strict=True
    ):
        slow, slow_known = slow_refine(left, right, *np.rint(point).astype(int), start)
        assert d == pytest.approx(slow, abs=2e-3)
        assert known == pytest.approx(slow_known, rel=0.02)


def errors(seed, noise=2.0):
    """Of the disparity [px] at points of both planes, and each one's standard deviation."""
    left, right = planes.pair(noise, seed)
    points = some_points(400, seed)
    points = np.rint(points[np.abs(points[:, 1] - planes.HEIGHT / 2) > kernels.MARGIN])
    disparities, fates = searched(left, right, points, SEARCH)
    points, disparities = points[fates == kernels.FOUND], disparities[fates == kernels.FOUND]
    result, information = refined(left, right, points, disparities)
    good = information > 0
    return (result - planes.disparity(*points.T))[good], information[good] ** -0.5


@pytest.mark.parametrize(("noise", "largest"), [(1.0, 0.06), (4.0, 0.08)])
def test_disparities_of_planes_are_exact_and_lean_to_no_side(noise, largest):
    found = [errors(seed, noise) for seed in range(3)]
    error = np.concatenate([e for e, _ in found])
    assert len(error) > 700
    assert abs(np.mean(error)) < 0.01
    assert np.sqrt(np.mean(error**2)) < largest
    assert np.abs(error).max() < STEADY_PX


def test_the_information_tells_how_exact_a_disparity_is():
    """With noise that dominates interpolation, errors are as large as it says."""
    found = [errors(seed, 8.0) for seed in range(4)]
    ratio = np.concatenate([e / sigma for e, sigma in found])
    assert 0.7 < np.sqrt(np.mean(ratio**2)) < 1.6


def test_a_disparity_on_which_two_windows_disagree_is_left_out():
    left, right = planes.pair()
    points = np.array([[x, 80.0] for x in range(60, 420, 9)])
    truth = planes.disparity(*points.T)
    for off, is_good in ((0.1, True), (0.5, False), (-0.5, False)):
        result, information = refined(left, right, points, truth + off)
        np.testing.assert_allclose(result, truth, atol=0.2)  # it comes to the same end
        np.testing.assert_array_equal(information > 0, is_good)


def test_where_there_is_no_texture_nothing_is_known():
    flat = np.full((planes.HEIGHT, planes.WIDTH), 90, np.uint8)
    points = np.array([[100.0, 100.0], [200.0, 100.0]])
    assert (searched(flat, flat, points, SEARCH)[1] == kernels.WEAK).all()
    result, information = refined(flat, flat, points, np.array([10.0, 20.0]))
    np.testing.assert_array_equal(result, [10.0, 20.0])
    np.testing.assert_array_equal(information, 0.0)
