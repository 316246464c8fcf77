"""What is on the walls, down to the smallest detail: texels painted once for a whole building.

A wall is cut into bays, each of one material, or plain; on bays that are not there hang and stand
things (`pictures`). All is drawn at random, from streams of its own for each wall and purpose: the
same seed gives the same walls, and more plain bays or more copies leave all else as it was.
"""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from msg_defs.types import Walls
from sim_world.rendering.pictures import KINDS, Kind, fractal
from sim_world.rendering.settings import WallSettings

TEXEL_M = 0.004
"""Size of the smallest detail [m]; a pixel covers as much at 2 m."""
BAY_M = (3.0, 7.0)
"""Length of a bay [m]."""
SKIRTING_M = 0.1
"""Height of the dark board at the bottom of every wall [m]."""
LEAST_GAP_M = 0.1
"""Between two things on a wall [m]."""


@dataclass(frozen=True, eq=False)
class Textures:
    """The texels of all walls.

    Those of a wall are columns from its second end to its first, from left to right for who looks
    at it; a column runs from the top of the wall to the floor.
    """

    texels: np.ndarray
    """(C, R) uint8: columns of all walls, light."""
    firsts: np.ndarray
    """(W,) int64: first column of each wall."""
    counts: np.ndarray
    """(W,) int64: columns of each wall."""

    def of(self, wall: int) -> np.ndarray:
        """(R, count) the picture of one wall as it is seen; a view."""
        first = self.firsts[wall]
        return self.texels[first : first + self.counts[wall]].T


def blank(walls: Walls, texel_m: float = TEXEL_M) -> Textures:
    """Black walls, in texels of `texel_m` or, so that they fill each wall, a little else."""
    lengths = np.hypot(*(walls.segments[:, 2:] - walls.segments[:, :2]).T)
    counts = np.maximum(1, np.rint(lengths / texel_m)).astype(np.int64)
    firsts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    rows = max(1, round(walls.height_m / texel_m))
    return Textures(np.zeros((counts.sum(), rows), np.uint8), firsts, counts)


def paint(walls: Walls, settings: WallSettings, seed: np.random.SeedSequence) -> Textures:
    """Walls of the building's height as `settings` and `seed` have them."""
    textures = blank(walls)
    of_designs, *of_walls = seed.spawn(1 + len(walls.segments))
    rng = np.random.default_rng(of_designs)
    designs = [_Thing.drawn(rng, rng) for _ in range(settings.designs)]
    for wall, own in enumerate(of_walls):
        canvas = _painted(textures.of(wall).shape, settings, designs, own)
        textures.of(wall)[:] = np.clip(np.rint(canvas), 0, 255)
    return textures


@dataclass(frozen=True, eq=False)
class _Thing:
    """Something that hangs or stands on a wall."""

    kind: Kind
    picture: np.ndarray

    @classmethod
    def drawn(cls, choice: np.random.Generator, content: np.random.Generator) -> "_Thing":
        kind = KINDS[choice.integers(len(KINDS))]
        height, width = (
            round(choice.uniform(*range_m) / TEXEL_M) for range_m in (kind.heights_m, kind.widths_m)
        )
        return cls(kind, kind.draw(content, height, width))

    def top(self, rows: int) -> int:
        """Row of its upper edge on a wall of so many rows."""
        height = len(self.picture)
        if self.kind.middle_m is None:
            return rows - height
        return rows - round(self.kind.middle_m / TEXEL_M) - height // 2


def _painted(
    shape: tuple[int, ...],
    settings: WallSettings,
    designs: list[_Thing],
    seed: np.random.SeedSequence,
) -> np.ndarray:
    """(R, C) float32: one wall."""
    rows, columns = shape
    canvas = np.empty((rows, columns), np.float32)
    of_layout, of_bays = seed.spawn(2)
    bays = _bays(columns, np.random.default_rng(of_layout))
    for (begin, end), own in zip(bays, of_bays.spawn(len(bays)), strict=True):
        _paint_bay(canvas[:, begin:end], settings, designs, own)
    return canvas


def _paint_bay(
    bay: np.ndarray, settings: WallSettings, designs: list[_Thing], seed: np.random.SeedSequence
) -> None:
    """Paint one bay (R, C), in place."""
    looks, choice, content = (np.random.default_rng(s) for s in seed.spawn(3))
    is_plain = looks.random() < settings.plain
    shade = looks.uniform(135, 215)
    material = MATERIALS[looks.integers(len(MATERIALS))]
    bay[:] = shade if is_plain else shade + material(looks, *bay.shape)
    bay *= np.linspace(1.05, 0.85, len(bay), dtype=np.float32)[:, None]
    bay[-max(1, round(SKIRTING_M / TEXEL_M)) :] = 0.4 * shade
    if not is_plain and settings.posters_per_m:
        _hang(bay, settings, designs, choice, content)


def _bays(columns: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Where each bay of a wall begins and ends."""
    ends = [0]
    while ends[-1] < columns:
        end = ends[-1] + round(rng.uniform(*BAY_M) / TEXEL_M)
        ends.append(end if columns - end > BAY_M[0] / TEXEL_M else columns)
    return list(pairwise(ends))


def _hang(
    bay: np.ndarray,
    settings: WallSettings,
    designs: list[_Thing],
    choice: np.random.Generator,
    content: np.random.Generator,
) -> None:
    """Hang things on a bay, from left to right, in place."""
    rows, columns = bay.shape
    at = 0
    while True:
        own, copy = _Thing.drawn(choice, content), designs[choice.integers(len(designs))]
        thing = copy if choice.random() < settings.repeated else own
        room = max(own.picture.shape[1], copy.picture.shape[1])
        spare_m = max(1 / settings.posters_per_m - room * TEXEL_M, 0)
        at += round(max(choice.uniform(0, 2 * spare_m), LEAST_GAP_M) / TEXEL_M)
        if at + room > columns:
            return
        top, (height, width) = thing.top(rows), thing.picture.shape
        bay[top : top + height, at : at + width] = thing.picture
        at += room


def _plaster(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    return 5 * fractal(rng, height, width, 128, 0.8)


def _concrete(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Rough, with the holes of its formwork and the joints between the panels."""
    face = 12 * fractal(rng, height, width, 64, 0.75)
    for x in range(int(rng.integers(20, 200)), width, 300):
        face[:, x : x + 2] -= 40
    for x in range(60, width, 150):
        for y in range(height // 6, height, height // 3):
            cv2.circle(face, (x + int(rng.integers(-6, 7)), y), 4, -60.0, -1)
    return face


def _bricks(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Courses of bricks of slightly different shades."""
    tall, long = 18, 60
    courses, each = height // tall + 1, width // long + 2
    shades = rng.normal(0, 14, (courses, each)).astype(np.float32)
    wall = shades.repeat(tall, axis=0).repeat(long, axis=1)[:height]
    wall[tall - 3 :: tall] = 35
    for course in range(courses):
        row = wall[course * tall : (course + 1) * tall]
        row[:, long - 3 :: long] = 35
        row[:] = np.roll(row, (course % 2) * long // 2, axis=1)
    return wall[:, :width] + 7 * fractal(rng, height, width, 16, 0.9)


def _panels(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Boards of wood, upright, each with its grain."""
    grain = 9 * fractal(rng, height // 8 + 1, width, 16, 0.8).repeat(8, axis=0)[:height]
    for x in range(0, width, 45):
        grain[:, x : x + 45] += rng.normal(0, 12)
        grain[:, x : x + 2] -= 50
    return grain


MATERIALS = (_plaster, _concrete, _bricks, _panels)
