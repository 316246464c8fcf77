"""The compiled search for a point of the left image along its row in the right one.

Whole pixels first (`match_rows`), by normalised cross-correlation, whose sums are of integers:
their order does not matter, and the loops become SIMD code. Then fractions of a pixel
(`refine_rows`).
"""

import numpy as np

from multi_robot_slam.models.compiled import kernel

RADIUS = 5
"""Of the window that is searched for: 11 x 11 px."""

SIDE = 2 * RADIUS + 1
AREA = SIDE * SIDE

REFINED_RADIUS = 7
"""Of the window that is compared below a pixel: 15 x 15 px."""

MARGIN = REFINED_RADIUS + 2
"""Pixels that must be there around a point of either image."""

STEPS = 10
"""Gauss-Newton steps at most; three suffice nearly always."""

CONVERGED_PX = 1e-3

FARTHEST_PX = 1.0
"""A refined disparity is so near to the one searched."""

LEAST_NOISE = 1.0
"""Smallest variance of a grey value: a byte is rounded, and neighbours are alike."""

OUTSIDE, WEAK, AMBIGUOUS, ONE_WAY, FOUND = range(5)
"""What became of a point.

OUTSIDE: too near the border of an image. WEAK: correlation too low, or highest at the end of the
search. AMBIGUOUS: another place is nearly as good. ONE_WAY: what was found fits another point of
the left image better.
"""


@kernel
def correlate(template_image, u, v, image, first, scores):
    """Normalised cross-correlation of the window around (u, v) with those around (first + i, v).

    Parameters
    ----------
    template_image, image : (H, W) uint8, with all windows inside.
    scores : (n,) float32, filled; -1 where a window is flat.

    """
    count = len(scores)
    width = count + SIDE - 1
    cross = np.zeros(count, np.int32)
    column_sum = np.zeros(width, np.int32)
    column_sq = np.zeros(width, np.int32)
    row = np.empty(width, np.int32)
    total, total_sq = 0, 0
    for j in range(v - RADIUS, v + RADIUS + 1):
        for i in range(width):
            value = np.int32(image[j, first - RADIUS + i])
            row[i] = value
            column_sum[i] += value
            column_sq[i] += value * value
        for k in range(SIDE):
            value = np.int32(template_image[j, u - RADIUS + k])
            total += value
            total_sq += value * value
            for i in range(count):
                cross[i] += value * row[i + k]
    own = np.float64(AREA * total_sq - total * total)
    window, window_sq = 0, 0
    for k in range(SIDE - 1):
        window += column_sum[k]
        window_sq += column_sq[k]
    for i in range(count):
        window += column_sum[i + SIDE - 1]
        window_sq += column_sq[i + SIDE - 1]
        both = own * np.float64(AREA * window_sq - window * window)
        covariance = np.float64(AREA * np.int64(cross[i]) - total * window)
        scores[i] = covariance / np.sqrt(both) if both > 0 else -1.0
        window -= column_sum[i]
        window_sq -= column_sq[i]


@kernel
def second_peak(scores, best):
    """Highest local maximum of `scores` (n,), but for `best` and its neighbours; -1: none."""
    second = np.float32(-1.0)
    for i in range(1, len(scores) - 1):
        is_peak = scores[i] >= scores[i - 1] and scores[i] >= scores[i + 1]
        if is_peak and abs(i - best) > 1 and scores[i] > second:
            second = scores[i]
    return second


@kernel
def match_row(left, right, u, v, least_px, most_px, least_score, uniqueness):
    """(disparity [px], fate) of the pixel (u, v) of the left image, to a parabola's vertex."""
    height, width = left.shape
    if not (MARGIN <= u < width - MARGIN and MARGIN <= v < height - MARGIN):
        return 0.0, OUTSIDE
    first, last = max(u - most_px, MARGIN), u - least_px
    if last - first < 2:
        return 0.0, OUTSIDE
    scores = np.empty(last - first + 1, np.float32)
    correlate(left, u, v, right, first, scores)
    best = np.argmax(scores)
    if scores[best] < least_score or best == 0 or best == len(scores) - 1:
        return 0.0, WEAK
    if 1 - scores[best] > uniqueness * (1 - second_peak(scores, best)):
        return 0.0, AMBIGUOUS
    place = first + best
    back = np.empty(min(place + most_px, width - 1 - MARGIN) - place - least_px + 1, np.float32)
    correlate(right, place, v, left, place + least_px, back)
    if abs(place + least_px + np.argmax(back) - u) > 1:
        return 0.0, ONE_WAY
    before, here, after = scores[best - 1], scores[best], scores[best + 1]
    return u - place - 0.5 * (before - after) / (before - 2 * here + after), FOUND


@kernel
def match_rows(left, right, points, least_px, most_px, least_score, uniqueness, disparities, fates):
    """`match_row` of each of `points` (n, 2): `disparities` (n,) and `fates` (n,) are filled."""
    for n in range(len(points)):
        u, v = int(np.floor(points[n, 0] + 0.5)), int(np.floor(points[n, 1] + 0.5))
        disparities[n], fates[n] = match_row(
            left, right, u, v, least_px, most_px, least_score, uniqueness
        )


@kernel
def moments(values):
    """Subtract the mean from `values` (n, m), in place; the sum of squares that is left."""
    mean = values.sum() / values.size
    squares = 0.0
    for j in range(values.shape[0]):
        for k in range(values.shape[1]):
            values[j, k] -= mean
            squares += values[j, k] * values[j, k]
    return squares


@kernel
def sample(image, x, v, values, slopes):
    """Windows (m, m) around column x, not whole, and row v: grey values, and their slope in x."""
    corner = int(np.floor(x))
    part = x - corner
    for j in range(values.shape[0]):
        for k in range(values.shape[1]):
            row, column = v - REFINED_RADIUS + j, corner - REFINED_RADIUS + k
            one, two = np.float64(image[row, column]), np.float64(image[row, column + 1])
            before, after = np.float64(image[row, column - 1]), np.float64(image[row, column + 2])
            values[j, k] = (1 - part) * one + part * two
            slopes[j, k] = 0.5 * ((1 - part) * (two - before) + part * (after - one))


@kernel
def refine_row(left, right, u, v, disparity):
    """(disparity [px], information [1 / px^2]) by Gauss-Newton on the two windows' difference.

    Contrast and brightness of the right window are free. The information is the step's curvature
    over the variance that is left; 0 where it comes to no end near `disparity`.
    """
    side = 2 * REFINED_RADIUS + 1
    target, values, slopes = np.empty((3, side, side))
    for j in range(side):
        for k in range(side):
            target[j, k] = left[v - REFINED_RADIUS + j, u - REFINED_RADIUS + k]
    moments(target)
    refined, information = disparity, 0.0
    for _ in range(STEPS):
        x = u - refined
        is_near = abs(refined - disparity) <= FARTHEST_PX
        if not (is_near and MARGIN - 1 <= x < right.shape[1] - MARGIN):
            return disparity, 0.0
        sample(right, x, v, values, slopes)
        moments(slopes)
        squares = moments(values)
        gain, tilt = 0.0, 0.0
        for j in range(side):
            for k in range(side):
                gain += target[j, k] * values[j, k]
                tilt += slopes[j, k] * values[j, k]
        gain, tilt = gain / squares, tilt / squares
        curvature, gradient, left_over = 0.0, 0.0, 0.0
        for j in range(side):
            for k in range(side):
                error = target[j, k] - gain * values[j, k]
                slope = gain * (slopes[j, k] - tilt * values[j, k])
                curvature += slope * slope
                gradient += slope * error
                left_over += error * error
        information = curvature / max(left_over / (side * side), LEAST_NOISE)
        step = gradient / curvature
        if not abs(step) < FARTHEST_PX:
            return disparity, 0.0
        refined -= step
        if abs(step) < CONVERGED_PX:
            return refined, information
    return disparity, 0.0


@kernel
def refine_rows(left, right, points, disparities, refined, information):
    """`refine_row` of each of `points` (n, 2): `refined` (n,) and `information` (n,) are filled."""
    for n in range(len(points)):
        u, v = int(np.floor(points[n, 0] + 0.5)), int(np.floor(points[n, 1] + 0.5))
        refined[n], information[n] = refine_row(left, right, u, v, disparities[n])
