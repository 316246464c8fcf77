"""The compiled search for the right image's point along a row, whole pixels and below.

Sums are of integers, so their order does not matter and the loops become SIMD code.
"""

import numpy as np

from multi_robot_slam.models.compiled import kernel

RADIUS = 5
"""Of the window that is compared: 11 x 11 px."""

SIDE = 2 * RADIUS + 1
AREA = SIDE * SIDE

OUTSIDE, WEAK, AMBIGUOUS, ONE_WAY, FOUND = range(5)
"""What became of a keypoint: window outside the image, correlation too low, a second place as good,
another point of the left image fits better, a match."""


@kernel
def correlate(template_image, u, v, image, first, scores):
    """Normalised cross-correlation of the window at (u, v) with those at (first + i, v).

    `scores` (n,) float32 is filled.
    """
    count = len(scores)
    width = count + SIDE - 1
    cross = np.zeros(count, np.int32)
    column_sum = np.zeros(width, np.int32)
    column_sq = np.zeros(width, np.int32)
    total, total_sq = 0, 0
    for j in range(-RADIUS, RADIUS + 1):
        row = image[v + j, first - RADIUS : first - RADIUS + width].astype(np.int32)
        for i in range(width):
            column_sum[i] += row[i]
            column_sq[i] += row[i] * row[i]
        for k in range(SIDE):
            value = np.int32(template_image[v + j, u - RADIUS + k])
            total += value
            total_sq += value * value
            for i in range(count):
                cross[i] += value * row[i + k]
    spread = AREA * total_sq - total * total
    window, window_sq = 0, 0
    for k in range(SIDE - 1):
        window += column_sum[k]
        window_sq += column_sq[k]
    for i in range(count):
        window += column_sum[i + SIDE - 1]
        window_sq += column_sq[i + SIDE - 1]
        both = np.float64(spread) * np.float64(AREA * window_sq - window * window)
        covariance = np.float64(AREA * np.int64(cross[i]) - total * window)
        scores[i] = covariance / np.sqrt(both) if both > 0 else -1.0
        window -= column_sum[i]
        window_sq -= column_sq[i]


@kernel
def match_rows(left, right, points, least_px, most_px, least_score, uniqueness, disparities, fates):
    """Disparity [px] of each of `points` (n, 2) column, row, by a search along its row.

    `disparities` (n,) float64 and `fates` (n,) int64 are filled.
    """
    height, width = left.shape
    for n in range(len(points)):
        u, v = int(np.floor(points[n, 0] + 0.5)), int(np.floor(points[n, 1] + 0.5))
        disparities[n] = 0.0
        fates[n] = OUTSIDE
        first, last = max(u - most_px, RADIUS), u - least_px
        inside = RADIUS <= u < width - RADIUS and RADIUS <= v < height - RADIUS
        if not inside or last - first < 2:
            continue
        scores = np.empty(last - first + 1, np.float32)
        correlate(left, u, v, right, first, scores)
        best = np.argmax(scores)
        if scores[best] < least_score or best == 0 or best == len(scores) - 1:
            fates[n] = WEAK
            continue
        second = -1.0
        for i in range(1, len(scores) - 1):
            peak = scores[i] >= scores[i - 1] and scores[i] >= scores[i + 1]
            if abs(i - best) > 1 and peak and scores[i] > second:
                second = scores[i]
        if 1 - scores[best] > uniqueness * (1 - second):
            fates[n] = AMBIGUOUS
            continue
        place = first + best
        first_back = place + least_px
        last_back = min(place + most_px, width - 1 - RADIUS)
        back = np.empty(last_back - first_back + 1, np.float32)
        correlate(right, place, v, left, first_back, back)
        if abs(first_back + np.argmax(back) - u) > 1:
            fates[n] = ONE_WAY
            continue
        before, here, after = scores[best - 1], scores[best], scores[best + 1]
        shift = 0.5 * (before - after) / (before - 2 * here + after)
        disparities[n] = u - place - shift
        fates[n] = FOUND
