"""The compiled ray caster: walls and people -> the light on a sensor -> grey values.

Walls are vertical and the camera is level, so a column of pixels meets one wall, or a few beside
each other, and each of them at one depth. The wall's texels that a column covers are summed to a
strip, exactly by their shares; the strip's running sum then gives the mean over the texels that any
pixel of the column covers. No rays are sampled: a pixel is the integral over its square, but for
the change of depth within half a pixel.

Pixel i covers the columns i - 1/2 to i + 1/2 of the image: the centre of a pixel has the whole
number as its coordinate, as in OpenCV. Light is (width, height) here, so that a column is
contiguous.

All compiled functions are in this file, because Numba keys its cache on the file of the function
alone.
"""

from typing import NamedTuple

import numba
import numpy as np

NOTHING = -1
"""Where no wall is seen."""

NARROWEST_PX = 1e-9
"""Parts of a column narrower than this are not seen."""

NEAREST_M = 1e-6
"""Depth below which a place is beside the camera."""

BLOCK = 16
"""Rows that are turned from columns at once: a cache line of single precision."""


class View(NamedTuple):
    """One level pin-hole camera, and where it is."""

    eye: np.ndarray
    """(3,) float64: its place in `map` [m]."""
    ahead: np.ndarray
    """(2,) float64: unit vector of its optical axis in the ground plane of `map`."""
    focal_px: float
    centre: np.ndarray
    """(2,) float64: column and row of the optical axis [px]."""


class Surfaces(NamedTuple):
    """S upright rectangles with a picture on each, seen from their left side only.

    A picture is a number of columns of texels, from the second end of its rectangle to the first,
    which is from left to right for who looks at it; a column runs from the top down.
    """

    segments: np.ndarray
    """(S, 4) float64: x0, y0, x1, y1 in `map` [m]."""
    heights: np.ndarray
    """(S,) float64: they stand on the ground and are so high [m]."""
    firsts: np.ndarray
    """(S,) int64: first column of texels of each."""
    counts: np.ndarray
    """(S,) int64: columns of texels of each."""
    texels: np.ndarray
    """(C, R) uint8: columns of all pictures, light."""
    opacities: np.ndarray
    """(C, R) uint8, 255 where the texel hides what is behind; (0, R) where all do."""


class Sensor(NamedTuple):
    """How light becomes grey values."""

    gain: float
    vignetting: float
    """Light lost in the corners, 0..1."""
    photon_noise: float
    """Standard deviation of a white pixel [grey values]; it grows with the root of the light."""
    read_noise: float
    """Standard deviation in the dark [grey values]."""


def kernel(function):
    """Compile: plain arrays and numbers, without the interpreter's lock."""
    return numba.njit(cache=True, nogil=True, error_model="numpy")(function)


@kernel
def expose(light, weight, view, walls, people, backdrop):
    """Add `weight` times what `view` sees to `light` (width, height) float32, in place.

    `people` are surfaces, the farthest first; `backdrop` (height,) float32 is what rows show where
    no wall is.
    """
    width, height = light.shape
    ends, nearest = _spans(width, view, walls.segments)
    column = np.empty(height, np.float32)
    sums = np.empty(walls.texels.shape[1] + 1)
    people_sums = np.empty(people.texels.shape[1] + 1)
    opacity_sums = np.empty(people.texels.shape[1] + 1)
    k = 0
    for i in range(width):
        begin = i - 0.5
        while begin < i + 0.5:
            end = min(ends[k], i + 0.5)
            if end - begin > NARROWEST_PX:
                depth = _wall_column(column, sums, begin, end, view, walls, nearest[k], backdrop)
                for p in range(len(people.segments)):
                    _person_column(
                        column, people_sums, opacity_sums, begin, end, depth, view, people, p
                    )
                share = np.float32(weight * (end - begin))
                for j in range(height):
                    light[i, j] += share * column[j]
            if end == ends[k]:
                k += 1
            begin = end


@kernel
def _spans(width, view, segments):
    """Ends (n,) of the parts of the image's width, and the wall (n,) that is nearest in each.

    Walls do not cross, so the nearest one changes only where a wall ends.
    """
    ends = np.empty(2 * len(segments) + 1)
    count = 0
    for w in range(len(segments)):
        for end in range(2):
            x = _seen_at(view, segments[w, 2 * end], segments[w, 2 * end + 1])
            if -0.5 < x < width - 0.5:
                ends[count] = x
                count += 1
    ends[count] = width - 0.5
    ends = np.sort(ends[: count + 1])
    nearest = np.empty(count + 1, np.int64)
    begin = -0.5
    for k in range(count + 1):
        nearest[k] = _nearest(0.5 * (begin + ends[k]), view, segments)
        begin = ends[k]
    return ends, nearest


@kernel
def _nearest(x, view, segments):
    """The wall that is seen in column `x`."""
    best, found = np.inf, NOTHING
    for w in range(len(segments)):
        depth, share = _meet(x, view, segments[w])
        if 0 < depth < best and -1e-9 <= share <= 1 + 1e-9:
            best, found = depth, w
    return found


@kernel
def _meet(x, view, segment):
    """Depth [m] at which column `x` meets a wall's plane, and where: 0 and 1 are its ends.

    The depth is negative where the plane is not met, or is seen from its right side.
    """
    slope = (x - view.centre[0]) / view.focal_px
    ray_x = view.ahead[0] + slope * view.ahead[1]
    ray_y = view.ahead[1] - slope * view.ahead[0]
    to_x, to_y = segment[0] - view.eye[0], segment[1] - view.eye[1]
    along_x, along_y = segment[2] - segment[0], segment[3] - segment[1]
    facing = to_x * along_y - to_y * along_x
    crossing = ray_x * along_y - ray_y * along_x
    if facing <= 0 or crossing <= 0:
        return -1.0, 0.0
    return facing / crossing, (to_x * ray_y - to_y * ray_x) / crossing


@kernel
def _covered(begin, end, view, segment, count):
    """The columns of texels, as an interval, that the image's columns `begin` to `end` show."""
    left, from_second = 0.0, float(count)
    depth, share = _meet(begin, view, segment)
    if depth > 0:
        left = min(max((1 - share) * count, 0.0), float(count))
    depth, share = _meet(end, view, segment)
    if depth > 0:
        from_second = min(max((1 - share) * count, 0.0), float(count))
    return _widened(left, from_second, count)


@kernel
def _widened(low, high, count):
    """An interval of at least one texel around the same centre, within 0 and `count`.

    Nearer than one texel a pixel this interpolates between texels.
    """
    half = 0.5 * max(high - low, 1.0)
    centre = min(max(0.5 * (low + high), 0.0), float(count))
    return max(centre - half, 0.0), min(centre + half, float(count))


@kernel
def _running_sums(sums, texels, first, low, high):
    """Means over the columns of texels `low` to `high`, summed from the top down."""
    rows = texels.shape[1]
    strip = np.zeros(rows, np.float32)
    for k in range(int(low), int(np.ceil(high))):
        share = np.float32((min(k + 1.0, high) - max(float(k), low)) / (high - low))
        for v in range(rows):
            strip[v] += share * texels[first + k, v]
    sums[0] = 0.0
    for v in range(rows):
        sums[v + 1] = sums[v] + strip[v]


@kernel
def _at(sums, v):
    """The running sum down to `v`, between texels by their share."""
    k = min(int(v), len(sums) - 2)
    return sums[k] + (v - k) * (sums[k + 1] - sums[k])


@kernel
def _scale(depth, view, height, rows):
    """Texel `a + b j` is what the centre of row j shows."""
    per_m = rows / height
    b = depth / view.focal_px * per_m
    return (height - view.eye[2]) * per_m - b * view.centre[1], b


@kernel
def _inner_rows(a, b, rows, height):
    """Rows `first` to before `last` whose pixels, and a texel's width, lie within the picture."""
    half = 0.5 * max(b, 1.0)
    first = min(max(int(np.ceil((half - a) / b)), 0), height)
    last = min(max(int(np.floor((rows - half - a) / b)) + 1, first), height)
    return first, last


@kernel
def _share_and_mean(sums, a, b, j):
    """The share of row j's pixel that lies within the picture, and the mean of what it shows."""
    rows = len(sums) - 1
    middle = a + b * j
    top = min(max(middle - 0.5 * b, 0.0), float(rows))
    bottom = min(max(middle + 0.5 * b, 0.0), float(rows))
    if bottom <= top:
        return 0.0, 0.0
    low, high = _widened(top, bottom, rows)
    return (bottom - top) / b, (_at(sums, high) - _at(sums, low)) / (high - low)


@kernel
def _wall_column(column, sums, begin, end, view, walls, wall, backdrop):
    """Fill `column` (height,) with what the image's columns `begin` to `end` show; its depth."""
    height = len(column)
    column[:] = backdrop
    if wall == NOTHING:
        return np.inf
    segment, count = walls.segments[wall], walls.counts[wall]
    depth, _ = _meet(0.5 * (begin + end), view, segment)
    low, high = _covered(begin, end, view, segment, count)
    _running_sums(sums, walls.texels, walls.firsts[wall], low, high)
    rows = len(sums) - 1
    a, b = _scale(depth, view, walls.heights[wall], rows)
    first, last = _inner_rows(a, b, rows, height)
    for j in range(first):
        share, mean = _share_and_mean(sums, a, b, j)
        column[j] += share * (mean - column[j])
    half = 0.5 * max(b, 1.0)
    per_texel = 1 / (2 * half)
    for j in range(first, last):
        middle = a + b * j
        column[j] = (_at(sums, middle + half) - _at(sums, middle - half)) * per_texel
    for j in range(last, height):
        share, mean = _share_and_mean(sums, a, b, j)
        column[j] += share * (mean - column[j])
    return depth


@kernel
def _person_column(column, sums, opacity_sums, begin, end, wall_depth, view, people, p):
    """Put the person `p` before what `column` shows, where there is one and no wall before it."""
    segment, count = people.segments[p], people.counts[p]
    left, right = _seen_at(view, segment[2], segment[3]), _seen_at(view, segment[0], segment[1])
    first, last = max(begin, left), min(end, right)
    if np.isnan(left + right) or last - first < NARROWEST_PX:
        return
    depth, _ = _meet(0.5 * (first + last), view, segment)
    if not 0 < depth < wall_depth:
        return
    low, high = _covered(first, last, view, segment, count)
    _running_sums(sums, people.texels, people.firsts[p], low, high)
    _running_sums(opacity_sums, people.opacities, people.firsts[p], low, high)
    a, b = _scale(depth, view, people.heights[p], len(sums) - 1)
    beside = (last - first) / (end - begin)
    for j in range(len(column)):
        share, light = _share_and_mean(sums, a, b, j)
        if share > 0:
            _, opacity = _share_and_mean(opacity_sums, a, b, j)
            column[j] += beside * share * (light - opacity / 255 * column[j])


@kernel
def _seen_at(view, x, y):
    """The column in which a place is seen, or no number where it is not before the camera."""
    dx, dy = x - view.eye[0], y - view.eye[1]
    depth = view.ahead[0] * dx + view.ahead[1] * dy
    if depth < NEAREST_M:
        return np.nan
    right = view.ahead[1] * dx - view.ahead[0] * dy
    return view.centre[0] + view.focal_px * right / depth


@kernel
def read_out(light, sensor, noise, seed):
    """(height, width) uint8 of the `light` (width, height).

    `noise` are 2^12 quantiles of the standard normal distribution, of which each pixel gets one by
    a hash of its number and `seed` (uint64).
    """
    width, height = light.shape
    image = np.empty((height, width), np.uint8)
    middle_x, middle_y = 0.5 * (width - 1), 0.5 * (height - 1)
    loss = sensor.vignetting / (middle_x**2 + middle_y**2)
    per_grey = sensor.photon_noise**2 / 255
    dark = sensor.read_noise**2
    is_noisy = per_grey > 0 or dark > 0
    for block in range(0, height, BLOCK):
        for i in range(width):
            for j in range(block, min(block + BLOCK, height)):
                off_centre = (i - middle_x) ** 2 + (j - middle_y) ** 2
                grey = light[i, j] * sensor.gain * (1 - loss * off_centre)
                if is_noisy:
                    drawn = noise[_hash(seed + np.uint64(i * height + j)) >> np.uint64(52)]
                    grey += np.sqrt(per_grey * grey + dark) * drawn
                image[j, i] = np.uint8(min(max(grey + 0.5, 0.0), 255.0))
    return image


@kernel
def _hash(number):
    """64 bits that look random (the finaliser of SplitMix64)."""
    number = (number + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    number = (number ^ (number >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    number = (number ^ (number >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return number ^ (number >> np.uint64(31))
