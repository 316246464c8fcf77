"""Closed tours through the building, set by hand, and a team's share of them (paper sec. 7)."""

from collections.abc import Iterator

import numpy as np

from msg_defs.errors import InputError
from sim_world.planar import wrap

CORNER_RADIUS_M = 1.0
"""Radius of the arcs that round the corners of a tour."""

TURN_M_PER_RAD = 2.0
"""Driving so far takes as long as turning by one radian: robots slow down in corners, to 19 degrees
a second by default, so that what the camera sees overlaps from frame to frame [m/rad]."""

_SOUTH_WEST, _SOUTH, _SOUTH_EAST = (1.75, 1.75), (15.0, 1.75), (28.25, 1.75)
_NORTH_WEST, _NORTH = (1.75, 28.25), (15.0, 28.25)
_HALL_EAST, _HALL_WEST = (28.25, 25.0), (15.0, 25.0)
_HALL_SOUTH_EAST, _HALL_CENTRE = (28.25, 22.0), (23.0, 25.0)

TOURS = {
    # The western loop counter-clockwise, the eastern one clockwise, northwards between them.
    "figure_eight": (
        *(_SOUTH, _NORTH, _NORTH_WEST, _SOUTH_WEST),
        *(_SOUTH, _HALL_WEST, _HALL_EAST, _SOUTH_EAST),
    ),
    # From the hall southwards between the loops, the western one clockwise, the eastern one last.
    "hall_first": (
        *(_HALL_CENTRE, _HALL_WEST, _SOUTH, _SOUTH_WEST, _NORTH_WEST, _NORTH),
        *(_SOUTH, _SOUTH_EAST, _HALL_SOUTH_EAST),
    ),
    # All around the building counter-clockwise, with the eastern loop once more on the way.
    "ring": (
        *(_NORTH_WEST, _SOUTH_WEST, _SOUTH_EAST, _HALL_EAST, _HALL_WEST),
        *(_SOUTH, _SOUTH_EAST, _HALL_EAST, (17.0, 25.0), (15.0, 28.25)),
    ),
}
"""Name -> corners [m] of a tour that ends where it begins, each corner turning by less than pi."""


def poses(
    tour: str, robots: int, movements: int, start_offset: float = 0.0, samples: int = 1
) -> np.ndarray:
    """(K, n + 1, 3) true poses x [m], y [m], yaw [rad] of K robots that share a tour.

    The tour, begun at `start_offset` (0..1) of its duration, is cut into K equal parts, and each
    part into T//K movements of equal duration, each of which ends the last of so many `samples`:
    n = T//K samples. A part ends at the pose where the next one begins.
    """
    each = movements // robots
    if not each:
        raise InputError(
            f"movements = {movements} for robots = {robots}: give at least one movement per robot"
        )
    each *= samples
    share = start_offset + np.arange(robots * each + 1) / (robots * each)
    path = _resample(tour, share)
    return np.stack([path[k * each : (k + 1) * each + 1] for k in range(robots)])


class Drive:
    """(N, 3) poses of one robot that goes on with its team's next part after each of its own.

    `parts` (K, n + 1, 3) is what `poses` returns. Iterating makes one pose after the other, so that
    a drive of days takes no more memory than one lap.
    """

    def __init__(self, parts: np.ndarray, robot: int, laps: int) -> None:
        self._parts = parts
        self._robot = robot
        self._laps = laps

    def __len__(self) -> int:
        return 1 + self._laps * (self._parts.shape[1] - 1)

    def __iter__(self) -> Iterator[np.ndarray]:
        yield self._parts[self._robot, 0]
        for lap in range(self._laps):
            yield from self._parts[(self._robot + lap) % len(self._parts), 1:]


def _resample(tour: str, share: np.ndarray) -> np.ndarray:
    """Poses at the given shares of the tour's duration; whole numbers are its beginning."""
    x, y, yaw = _rounded(np.array(TOURS[tour])).T
    yaw = np.unwrap(yaw)
    efforts = np.hypot(np.hypot(np.diff(x), np.diff(y)), TURN_M_PER_RAD * np.diff(yaw))
    effort = np.concatenate([[0], np.cumsum(efforts)])
    at = share % 1.0 * effort[-1]
    turned = wrap(np.interp(at, effort, yaw))
    return np.column_stack([np.interp(at, effort, x), np.interp(at, effort, y), turned])


def _rounded(corners: np.ndarray) -> np.ndarray:
    """Dense poses of the closed polygon with rounded corners, from the end of the first arc on."""
    arcs = [
        _arc(before, corner, after)
        for before, corner, after in zip(
            np.roll(corners, 1, axis=0), corners, np.roll(corners, -1, axis=0), strict=True
        )
    ]
    return np.concatenate([arcs[0][-1:], *arcs[1:], arcs[0]])


def _arc(before: np.ndarray, corner: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Poses about every degree along the arc that touches both sides of a corner."""
    heading = np.arctan2(*(corner - before)[::-1])
    turn = wrap(np.arctan2(*(after - corner)[::-1]) - heading)
    radius = np.copysign(CORNER_RADIUS_M, turn)
    start = corner - CORNER_RADIUS_M * np.tan(abs(turn) / 2) * _direction(heading)
    centre = start + radius * _direction(heading + np.pi / 2)
    yaw = heading + np.linspace(0, turn, 2 + int(np.degrees(abs(turn))))
    return np.column_stack([centre + radius * _direction(yaw - np.pi / 2).T, yaw])


def _direction(yaw: np.ndarray | float) -> np.ndarray:
    return np.array([np.cos(yaw), np.sin(yaw)])
