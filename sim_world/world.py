"""The building: walls, the landmarks on them, and which of these a camera sees (paper sec. 6)."""

from dataclasses import dataclass

import numpy as np

from msg_defs.types import LandmarkMap, StereoCamera, Walls
from sim_world import descriptors, stereo
from sim_world.scenario import Scenario

HEIGHT_M = 2.0

OUTER = (
    *((0, 0), (9, 0), (9, 0.7), (9.2, 0.7), (9.2, 0), (22, 0), (22, 0.7), (22.2, 0.7), (22.2, 0)),
    *((30, 0), (30, 7), (29.3, 7), (29.3, 7.2), (30, 7.2)),
    *((30, 30), (20.2, 30), (20.2, 27), (20, 27), (20, 30)),
    *((8.2, 30), (8.2, 29.3), (8, 29.3), (8, 30)),
    *((0, 30), (0, 20.2), (0.7, 20.2), (0.7, 20), (0, 20)),
)
"""Corners [m] of the outer walls, counter-clockwise, with short walls that reach inside."""
WEST_BLOCK = (
    *((3.5, 3.5), (3.5, 10), (7, 10), (7, 14), (3.5, 14)),
    *((3.5, 26.5), (6, 26.5), (6, 23.5), (10, 23.5), (10, 26.5)),
    *((13.25, 26.5), (13.25, 21), (10, 21), (10, 17), (13.25, 17), (13.25, 3.5)),
)
"""Corners [m] of the block inside the western loop, clockwise, with three open rooms."""
EAST_BLOCK = (
    *((16.75, 3.5), (16.75, 8), (20.5, 8), (20.5, 12), (16.75, 12)),
    *((16.75, 21), (26.5, 21), (26.5, 16), (23.5, 16), (23.5, 13), (26.5, 13), (26.5, 3.5)),
)
"""Corners [m] of the block inside the eastern loop, clockwise, with two open rooms."""


def _closed(corners: tuple) -> np.ndarray:
    points = np.array(corners, float)
    return np.hstack([points, np.roll(points, -1, axis=0)])


def building() -> Walls:
    """The walls. Each has free space on its left, seen from its first end to its second."""
    return Walls(np.vstack([_closed(c) for c in (OUTER, WEST_BLOCK, EAST_BLOCK)]), HEIGHT_M)


@dataclass(frozen=True, eq=False)
class World:
    """The walls and the N landmarks on them."""

    walls: Walls
    landmarks: LandmarkMap
    """The true map: ids 0..N-1, no uncertainty, no observations."""
    wall_of: np.ndarray
    """(N,) row of the wall each landmark is on."""

    def visible(self, pose: np.ndarray, camera: StereoCamera, d_max_m: float) -> np.ndarray:
        """Rows of the landmarks that a robot at `pose` (x, y, yaw) can observe, ascending.

        They lie in the images of both cameras, at most `d_max_m` from the left one, and both
        cameras see them: from the free side of their wall and with no wall in between.
        """
        points = self.landmarks.positions.astype(float)
        in_camera = stereo.camera_from_map(points, pose, camera.mount)
        near = (in_camera**2).sum(1) <= d_max_m**2
        rows = np.flatnonzero(near & stereo.in_view(in_camera, camera))
        for eye in stereo.eyes(pose, camera):
            rows = rows[self._sees(eye[:2], points[rows, :2], self.wall_of[rows])]
        return rows

    def _sees(self, eye: np.ndarray, points: np.ndarray, wall_of: np.ndarray) -> np.ndarray:
        starts, ends = self.walls.segments[:, :2], self.walls.segments[:, 2:]
        along = ends - starts
        on_free_side = _cross(along, eye - starts)[wall_of] > 0
        hits = _crosses(eye, points, starts, along)
        hits[np.arange(len(points)), wall_of] = False
        return on_free_side & ~hits.any(1)


def build(scenario: Scenario) -> World:
    """The building with landmarks spread evenly at random over its wall faces."""
    places, looks = np.random.default_rng(scenario.world_seed).spawn(2)
    walls = building()
    wall_of, positions = _place(walls, scenario.landmarks, places)
    database = descriptors.load(scenario.descriptor_database)
    drawn = _draw(len(database), scenario.landmarks, looks)
    return World(walls, _true_map(positions, database[drawn]), wall_of)


def _place(walls: Walls, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    starts, ends = walls.segments[:, :2], walls.segments[:, 2:]
    lengths = np.linalg.norm(ends - starts, axis=1)
    wall_of = rng.choice(len(lengths), count, p=lengths / lengths.sum())
    share = rng.random((count, 1))
    ground = starts[wall_of] + share * (ends - starts)[wall_of]
    return wall_of, np.column_stack([ground, rng.uniform(0, walls.height_m, count)])


def _draw(size: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw `count` of `size` rows; none comes twice before all have come once."""
    rounds = -(-count // size)
    return np.concatenate([rng.permutation(size) for _ in range(rounds)])[:count]


def _true_map(positions: np.ndarray, looks: np.ndarray) -> LandmarkMap:
    count = len(positions)
    return LandmarkMap(
        ids=np.arange(count, dtype=np.uint32),
        positions=positions.astype(np.float32),
        covariances=np.zeros((count, 6), np.float32),
        observations=np.zeros(count, np.uint32),
        robots=np.zeros(count, np.uint32),
        descriptors=looks,
    )


def _crosses(
    eye: np.ndarray, points: np.ndarray, starts: np.ndarray, along: np.ndarray
) -> np.ndarray:
    """(N, W) bool: the line from `eye` (2,) to each point (N, 2) meets the wall (W, 2)."""
    sight = (points - eye)[:, None]
    to_wall = starts - eye
    with np.errstate(divide="ignore", invalid="ignore"):
        parallel = 1 / _cross(sight, along)
        on_sight = _cross(to_wall, along) * parallel
        on_wall = _cross(to_wall, sight) * parallel
    return (on_sight > 0) & (on_sight < 1) & (on_wall >= 0) & (on_wall <= 1)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
