"""Where each robot's camera finds landmarks again: learnt from its frames, no camera is known.

Directions from the camera are cut into cells of bearing and elevation, distances into steps of a
fixed ratio. Counted are the observations of landmarks that were known before: one of something
known is no gross error. A point is in view where its cell has been used, and those around it too,
so that errors of pose and landmark by a part of a cell do not matter; what lies at the edge of the
view, or as far as the farthest that was found, is not expected.
"""

from typing import NamedTuple

import numpy as np

from multi_robot_slam.models.compiled import kernel

BEARINGS, ELEVATIONS, DISTANCES = 72, 72, 40
BEARING_RAD, ELEVATION_RAD = 2 * np.pi / BEARINGS, np.pi / ELEVATIONS
NEAREST_M, RATIO = 0.3, 1.25
"""Of the cells of distances, which reach to 2 km."""
USED = 2
"""Observations that make a cell one that is used; one alone may be a wrong match."""


class Views(NamedTuple):
    """How many known landmarks K robots have found, by where."""

    bearings: np.ndarray
    """(K, DISTANCES, BEARINGS) int32."""
    elevations: np.ndarray
    """(K, DISTANCES, ELEVATIONS) int32."""

    @classmethod
    def nothing(cls, robots: int) -> "Views":
        return cls(
            np.zeros((robots, DISTANCES, BEARINGS), np.int32),
            np.zeros((robots, DISTANCES, ELEVATIONS), np.int32),
        )

    def with_another(self, robot: int) -> "Views":
        """With another robot after the others, whose camera is that of `robot`."""
        return Views(*(np.concatenate([own, own[robot : robot + 1]]) for own in self))

    def also(self, robots: np.ndarray, rays: np.ndarray) -> "Views":
        """These, and known landmarks along `rays` (O, 3) from their cameras, by `robots` (O,)."""
        result = Views(self.bearings.copy(), self.elevations.copy())
        _count(result, robots, rays)
        return result


@kernel
def cell_of(ray: np.ndarray) -> tuple[int, int, int]:
    """Indices of distance, bearing and elevation of a point at `ray` (3,) from the camera [m]."""
    across = np.hypot(ray[0], ray[1])
    far = np.hypot(across, ray[2])
    distance = int(np.log(max(far / NEAREST_M, 1.0)) / np.log(RATIO))
    bearing = int((np.arctan2(ray[1], ray[0]) + np.pi) / BEARING_RAD)
    elevation = int((np.arctan2(ray[2], across) + 0.5 * np.pi) / ELEVATION_RAD)
    return min(distance, DISTANCES - 1), bearing % BEARINGS, min(elevation, ELEVATIONS - 1)


@kernel
def is_in_view(views: Views, robot: int, ray: np.ndarray) -> bool:
    """Whether `robot` has found known landmarks all around the point at `ray` (3,) [m]."""
    distance, bearing, elevation = cell_of(ray)
    if distance == 0 or distance == DISTANCES - 1:
        return False
    near, far = views.bearings[robot, distance], views.bearings[robot, distance + 1]
    left, right = (bearing + 1) % BEARINGS, (bearing - 1) % BEARINGS
    if min(near[bearing], near[left], near[right], far[bearing]) < USED:
        return False
    heights = views.elevations[robot, distance]
    lower, upper = False, False
    for e in range(ELEVATIONS):
        lower |= e < elevation and heights[e] >= USED
        upper |= e > elevation and heights[e] >= USED
    return lower and upper


@kernel
def _count(views: Views, robots: np.ndarray, rays: np.ndarray) -> None:
    for o in range(len(rays)):
        distance, bearing, elevation = cell_of(rays[o])
        views.bearings[robots[o], distance, bearing] += 1
        views.elevations[robots[o], distance, elevation] += 1
