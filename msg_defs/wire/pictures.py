"""Markers for RViz: the walls, and the map with the paths."""

import itertools
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from msg_defs.errors import InputError
from msg_defs.topics import MAP_FRAME
from msg_defs.types import LandmarkMap, Trajectory, Walls
from msg_defs.wire.cdr import Writer
from msg_defs.wire.messages import (
    Marker,
    decode,
    require_finite,
    require_frame,
    stamp_of,
)
from msg_defs.wire.poses import spatial_pose

_COLOURS = (
    (0.90, 0.30, 0.23),
    (0.20, 0.60, 0.86),
    (0.18, 0.72, 0.42),
    (0.95, 0.62, 0.07),
    (0.61, 0.35, 0.71),
    (0.10, 0.74, 0.74),
)
"""Red, green, blue of the first robot, the second, ...; then over again."""
_LANDMARK_COLOUR = (0.75, 0.75, 0.75)
_WALL_COLOUR = (0.45, 0.45, 0.50)
_LINE_WIDTH_M = 0.05
_POINT_WIDTH_M = 0.1
_SIGMAS = 3.0

_WALL_CORNERS = np.array([[0, 0], [1, 0], [1, 1], [1, 1], [0, 1], [0, 0]])
"""Which end of a wall, and which of its edges (0 bottom, 1 top): two triangles."""
_WALL_SIZE = len(_WALL_CORNERS)

_MATRIX = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
"""Where the elements of a 3 x 3 covariance are among its six."""


class _Picture(NamedTuple):
    """What a marker shows."""

    name: str
    kind: int
    """Such as `Marker.POINTS`."""
    points: np.ndarray
    """(n, 3) float64 in `map` [m]."""
    scale: tuple[float, float, float]
    colour: tuple[float, float, float]
    """Red, green, blue."""
    action: int = Marker.ADD


def encode_walls(walls: Walls, stamp_ns: int) -> bytes:
    """Marker in `map`: two triangles a wall, one metre high, with the height as their scale."""
    points, scale = _wall_points(walls.segments), (1.0, 1.0, walls.height_m)
    picture = _Picture("walls", Marker.TRIANGLE_LIST, points, scale, _WALL_COLOUR)
    return _draw(Writer(), picture, stamp_ns).done()


def decode_walls(data: bytes) -> Walls:
    """Exactly the walls that were encoded."""
    what = "walls"
    marker = decode(Marker, data, what)
    stamp_of(marker.header, what)
    require_frame(marker.header.frame_id, (MAP_FRAME,), what)
    points = np.array([(p.x, p.y, p.z) for p in marker.points], np.float64).reshape(-1, 3)
    require_finite(points, what, "corner")
    corners = points[: len(points) // _WALL_SIZE * _WALL_SIZE].reshape(-1, _WALL_SIZE, 3)
    segments = corners[:, :2, :2].reshape(-1, 4)
    height_m = marker.scale.z
    if not (
        marker.type == Marker.TRIANGLE_LIST
        and np.array_equal(points, _wall_points(segments))
        and 0 < height_m < math.inf
    ):
        raise InputError(
            f"{what}: marker of type {marker.type} with {len(points)} corners and scale.z = "
            f"{height_m} is no list of upright walls; publish two triangles a wall, z from 0 to 1, "
            "and the height as scale.z"
        )
    return Walls(segments, height_m)


def encode_markers(landmarks: LandmarkMap, paths: Mapping[str, Trajectory], stamp_ns: int) -> bytes:
    """MarkerArray in `map`, a whole picture: it replaces the one before.

    However many landmarks there are, they make two markers: a point each, and the three principal
    axes of each one's 3-sigma ellipsoid as lines. Each robot's path is one line in its colour.
    """
    centres = landmarks.positions.astype(np.float64)
    axes = _principal_axes(landmarks.covariances)
    ends = centres[:, None, None] + np.stack([axes, -axes], axis=2)
    axis_points, thin = ends.reshape(-1, 3), _line_scale(0.4)
    pictures = [
        _Picture("landmarks", Marker.POINTS, centres, (_POINT_WIDTH_M,) * 3, _LANDMARK_COLOUR),
        _Picture("3 sigma", Marker.LINE_LIST, axis_points, thin, _LANDMARK_COLOUR),
    ]
    for (robot, path), colour in zip(paths.items(), itertools.cycle(_COLOURS), strict=False):
        name, points = f"path of {robot}", path.poses * (1, 1, 0)
        pictures.append(_Picture(name, Marker.LINE_STRIP, points, _line_scale(1.0), colour))
    shown = [_CLEAR, *(picture for picture in pictures if _is_visible(picture))]
    message = Writer().numbers("I", len(shown))
    for picture in shown:
        _draw(message, picture, stamp_ns)
    return message.done()


def _is_visible(picture: _Picture) -> bool:
    """RViz complains about lists without points, and about a line strip of one."""
    return len(picture.points) > (picture.kind == Marker.LINE_STRIP)


def _principal_axes(covariances: np.ndarray) -> np.ndarray:
    """(N, 3, 3): half axes of the 3-sigma ellipsoids [m], one a row, of `covariances` (N, 6)."""
    variances, directions = np.linalg.eigh(covariances.astype(np.float64)[:, _MATRIX])
    lengths = _SIGMAS * np.sqrt(variances.clip(min=0))
    return lengths[:, :, None] * directions.swapaxes(1, 2)


def _line_scale(share: float) -> tuple[float, float, float]:
    return (_LINE_WIDTH_M * share, 0.0, 0.0)


def _wall_points(segments: np.ndarray) -> np.ndarray:
    """(6 W, 3) corners of the triangles of `segments` (W, 4), one metre high."""
    end, edge = _WALL_CORNERS.T
    places = segments.reshape(-1, 2, 2)[:, end]
    edges = np.broadcast_to(edge[:, None], (len(segments), _WALL_SIZE, 1))
    return np.concatenate([places, edges], axis=2).reshape(-1, 3)


_CLEAR = _Picture(
    "", Marker.POINTS, np.zeros((0, 3)), (0.0,) * 3, (0.0,) * 3, action=Marker.DELETEALL
)


def _draw(message: Writer, picture: _Picture, stamp_ns: int) -> Writer:
    """Append the Marker of a picture in `map`, which has no texture, text or mesh."""
    message.header(stamp_ns, MAP_FRAME).text(picture.name)
    message.numbers("3i", 0, picture.kind, picture.action)
    message.numbers("7d", *spatial_pose((0, 0, 0))).numbers("3d", *picture.scale)
    message.numbers("4f", *picture.colour, 1.0)
    lifetime, is_locked, colours, has_materials = (0, 0), 0, 0, 0
    message.numbers("iI", *lifetime).numbers("B", is_locked).rows(picture.points)
    message.numbers("I", colours)
    texture, data, corners = "", 0, 0
    message.text(texture).header(stamp_ns, MAP_FRAME).text("").numbers("2I", data, corners)
    text, mesh = "", ""
    message.text(text).text(mesh).text("").numbers("I", data)
    return message.numbers("B", has_materials)
