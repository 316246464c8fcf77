"""The rendered camera once more, pixel by pixel and in plain Python: slow and obvious.

`picture` integrates over each pixel's square as the compiled ray caster says it does; `sampled`
knows nothing of integrals and averages rays.
"""

from itertools import pairwise

import numpy as np

from sim_world.rendering.kernels import Surfaces, View


def picture(size, view: View, walls: Surfaces, people: Surfaces, backdrop) -> np.ndarray:
    """(height, width) light."""
    width, height = size
    result = np.zeros((height, width))
    ends = [_column_of(end, view) for end in walls.segments.reshape(-1, 2)]
    cuts = sorted(x for x in ends if x is not None)
    for i in range(width):
        edges = [i - 0.5, *(x for x in cuts if i - 0.5 < x < i + 0.5), i + 0.5]
        for begin, end in pairwise(edges):
            for j in range(height):
                seen = _part(begin, end, j, view, walls, people, backdrop)
                result[j, i] += (end - begin) * seen
    return result


def sampled(size, view: View, walls: Surfaces, backdrop, rays: int) -> np.ndarray:
    """(height, width) light: the mean of `rays` times `rays` rays for each pixel."""
    width, height = size
    offsets = (np.arange(rays) + 0.5) / rays - 0.5
    result = np.zeros((height, width))
    for i in range(width):
        for dx in offsets:
            hit = _nearest(i + dx, view, walls)
            for j in range(height):
                for dy in offsets:
                    result[j, i] += _texel(j + dy, hit, view, walls, backdrop[j]) / rays**2
    return result


def _texel(row, hit, view, walls, beyond):
    if hit is None:
        return beyond
    wall, depth, share = hit
    z = view.eye[2] - depth * (row - view.centre[1]) / view.focal_px
    if not 0 <= z < walls.heights[wall]:
        return beyond
    rows, count = walls.texels.shape[1], walls.counts[wall]
    column = min(int((1 - share) * count), count - 1)
    return walls.texels[walls.firsts[wall] + column, int((1 - z / walls.heights[wall]) * rows)]


def _part(begin, end, j, view, walls, people, backdrop):
    """What the part of row j between two columns shows."""
    hit = _nearest((begin + end) / 2, view, walls)
    light, wall_depth = backdrop[j], np.inf
    if hit is not None:
        wall, wall_depth, _ = hit
        inside, mean = _mean(begin, end, j, wall, wall_depth, view, walls, walls.texels)
        light += inside * (mean - light)
    for p in range(len(people.segments)):
        light = _with_person(light, begin, end, j, p, wall_depth, view, people)
    return light


def _with_person(light, begin, end, j, p, wall_depth, view, people):
    left, right = _column_of(people.segments[p, 2:], view), _column_of(people.segments[p, :2], view)
    if left is None or right is None or min(end, right) <= max(begin, left):
        return light
    first, last = max(begin, left), min(end, right)
    depth, _ = _meet((first + last) / 2, view, people.segments[p])
    if not depth < wall_depth:
        return light
    inside, own = _mean(first, last, j, p, depth, view, people, people.texels)
    _, opacity = _mean(first, last, j, p, depth, view, people, people.opacities)
    return light + (last - first) / (end - begin) * inside * (own - opacity / 255 * light)


def _mean(begin, end, j, s, depth, view, surfaces, texels):
    """The share of row j that lies on the surface `s`, and the mean of the texels it covers."""
    rows, count = texels.shape[1], surfaces.counts[s]
    columns = [0, count]
    for side, x in enumerate((begin, end)):
        meets, share = _meet(x, view, surfaces.segments[s])
        if meets > 0:
            columns[side] = min(max((1 - share) * count, 0), count)
    lines = []
    for y in (j - 0.5, j + 0.5):
        z = view.eye[2] - depth * (y - view.centre[1]) / view.focal_px
        lines.append((1 - z / surfaces.heights[s]) * rows)
    inside = (min(max(lines[1], 0), rows) - min(max(lines[0], 0), rows)) / (lines[1] - lines[0])
    if inside == 0:
        return 0.0, 0.0
    of_columns = _overlaps(*columns, count)
    of_rows = _overlaps(*(min(max(v, 0), rows) for v in lines), rows)
    own = texels[surfaces.firsts[s] : surfaces.firsts[s] + count].astype(float)
    return inside, of_columns @ own @ of_rows


def _overlaps(low, high, count):
    """(count,) share of each unit interval in [low, high], which is made one wide if it is less."""
    middle, half = (low + high) / 2, max(high - low, 1) / 2
    low, high = max(middle - half, 0), min(middle + half, count)
    lengths = [max(min(k + 1, high) - max(k, low), 0) for k in range(count)]
    return np.array(lengths) / (high - low)


def _nearest(x, view, walls):
    hits = [(w, *_meet(x, view, segment)) for w, segment in enumerate(walls.segments)]
    hits = [(w, depth, share) for w, depth, share in hits if depth > 0 and 0 <= share <= 1]
    return min(hits, key=lambda hit: hit[1], default=None)


def _meet(x, view, segment):
    """Depth and share at which the ray of column x meets the segment's line; from its left only."""
    ahead, right = view.ahead, np.array([view.ahead[1], -view.ahead[0]])
    ray = ahead + (x - view.centre[0]) / view.focal_px * right
    along = segment[2:] - segment[:2]
    normal = np.array([-along[1], along[0]])
    if normal @ (view.eye[:2] - segment[:2]) <= 0 or normal @ ray >= 0:
        return -1.0, 0.0
    depth, share = np.linalg.solve(np.column_stack([ray, -along]), segment[:2] - view.eye[:2])
    return depth, share


def _column_of(point, view):
    """Where a place is seen, or None behind the camera."""
    offset = np.asarray(point) - view.eye[:2]
    depth = offset @ view.ahead
    if depth <= 1e-6:
        return None
    return view.centre[0] + view.focal_px * (offset @ [view.ahead[1], -view.ahead[0]]) / depth
