"""Corners of tags to a fraction of a pixel: where the lines along their four edges meet.

A detector's corners are off by up to half a pixel, or pulled towards the pattern inside. But all
along each side of a tag white paper meets a black border, so many points of each edge can be found,
each where brightness falls most steeply across it, and a line through them is far more exact.
"""

import cv2
import numpy as np

ALONG = np.linspace(0.12, 0.88, 24)
"""Where edges are looked at, as a share of their length: not near corners, which are rounded."""
_ACROSS = np.linspace(-1, 1, 13)
"""Where brightness is read across an edge, in units of the reach."""
REACH_PX = (2.0, 4.0)
"""Least and most reach across an edge [px]: a blurred edge must fit in, its neighbours not."""
AT_CORNER = 5.5
"""A line through n independent points is exact to 2 / sqrt(n) of their spread at its end.

Neighbouring points share their error, of noise and of the pattern inside: an edge of L px has as
many independent ones as L / 7.6. Measured on drawn tags, with sides of 14 to 72 px and two kinds of
blur and noise.
"""
ROUNDS = 3
"""Each reads around the lines of the one before."""


def refined(image: np.ndarray, corners: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners of T tags and how straight their edges are.

    Parameters
    ----------
    image : (H, W) uint8.
    corners : (T, 4, 2) column and row as a detector gives them, clockwise around each tag [px].
    cells : of a tag's side, its black border included.

    Returns
    -------
    Corners (T, 4, 2), and the standard deviation of their columns and rows (T,) as far as it shows
    in how straight the edges are [px]; both NaN where a side has no edge.

    """
    if not len(corners):
        return corners, np.empty(0)
    spread = np.empty(0)
    for _ in range(ROUNDS):
        points = _edge_points(image, corners, cells)
        corners, spread = _meeting(points)
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    return corners, AT_CORNER * spread / np.sqrt(sides.min(axis=1))


def _edge_points(image: np.ndarray, corners: np.ndarray, cells: int) -> np.ndarray:
    """(T, 4, 24, 2): points of the edges from each corner to the next, NaN where there is none."""
    side = np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(side, axis=2, keepdims=True)
    inwards = np.stack([-side[..., 1], side[..., 0]], axis=2) / length
    reach = np.clip(0.8 * length / cells, *REACH_PX)[..., None]
    starts = corners[:, :, None] + ALONG[:, None] * side[:, :, None]
    offsets = _ACROSS * reach
    samples = starts[..., None, :] + offsets[..., None] * inwards[:, :, None, None]
    shades = _shades(image, samples)
    falls = np.maximum(shades[..., :-1] - shades[..., 1:], 0)
    middles = (offsets[..., :-1] + offsets[..., 1:]) / 2
    with np.errstate(invalid="ignore", divide="ignore"):
        across = (falls * middles).sum(axis=-1) / falls.sum(axis=-1)
    return starts + across[..., None] * inwards[:, :, None]


def _shades(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Brightness at points (T, 4, 24, 13, 2), in the shape (T, 4, 24, 13)."""
    columns, rows = np.moveaxis(points.astype(np.float32), -1, 0)
    flat = (4 * len(points), -1)
    shades = cv2.remap(
        image,
        columns.reshape(flat),
        rows.reshape(flat),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return shades.reshape(columns.shape).astype(np.float32)


def _meeting(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the lines through points (T, 4, n, 2) meet (T, 4, 2), and the points' spread (T,)."""
    centres = points.mean(axis=2)
    about = points - centres[:, :, None]
    xx, xy, yy = ((about[..., i] * about[..., j]).mean(axis=2) for i, j in ((0, 0), (0, 1), (1, 1)))
    angle = np.arctan2(2 * xy, xx - yy) / 2
    normals = np.stack([-np.sin(angle), np.cos(angle)], axis=2)
    residuals = np.einsum("tsnk,tsk->tsn", about, normals)
    distances = np.einsum("tsk,tsk->ts", centres, normals)
    # corner i is where the side that ends there meets the one that begins
    before, offset = np.roll(normals, 1, axis=1), np.roll(distances, 1, axis=1)
    determinant = before[..., 0] * normals[..., 1] - before[..., 1] * normals[..., 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        x = (offset * normals[..., 1] - distances * before[..., 1]) / determinant
        y = (before[..., 0] * distances - normals[..., 0] * offset) / determinant
    return np.stack([x, y], axis=2), np.sqrt((residuals**2).mean(axis=(1, 2)))
