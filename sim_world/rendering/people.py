"""People who walk through the building: where each is when, and how each looks."""

from dataclasses import dataclass

import cv2
import numpy as np

from sim_world import trajectories
from sim_world.rendering.kernels import Surfaces
from sim_world.rendering.pictures import fractal

HEIGHT_M = 1.7
WIDTH_M = 0.6
TEXEL_M = 0.005
STRIDE_M = 1.4
"""Way of two steps [m]."""
PHASES = 4
"""Pictures of a person, from one step to the next but one."""
SPEED_M_S = (0.8, 1.5)
ASIDE_M = (0.45, 0.7)
"""Beside the middle of the tour, where robots drive."""
NEAREST_M = 0.3
"""Nearer than this to the camera nobody is seen."""
POINTS = 4000
"""Of a tour that people follow."""


@dataclass(frozen=True, eq=False)
class Walker:
    """One person's way: around and around a tour, beside its middle."""

    path: np.ndarray
    """(N, 3) poses of the tour, in equal times."""
    duration_s: float
    """Of one round; negative the other way round."""
    start: float
    """Where on the way at time 0 [share of it]."""
    left_m: float
    """To the left of the path [m]."""

    def at(self, seconds: float) -> np.ndarray:
        """(2,) where in `map` [m]."""
        share = (self.start + seconds / self.duration_s) % 1.0
        k, part = divmod(share * (len(self.path) - 1), 1.0)
        before, after = self.path[int(k)], self.path[min(int(k) + 1, len(self.path) - 1)]
        x, y = before[:2] + part * (after - before)[:2]
        return np.array([x - self.left_m * np.sin(before[2]), y + self.left_m * np.cos(before[2])])

    def phase(self, seconds: float) -> int:
        """Which of the pictures shows how far the legs are."""
        way = np.hypot(*np.diff(self.path[:, :2], axis=0).T).sum() * seconds / self.duration_s
        return int(abs(way) / STRIDE_M * PHASES) % PHASES


class Crowd:
    """All who walk through the building."""

    def __init__(self, count: int, seed: np.random.SeedSequence) -> None:
        seeds = [s.spawn(2) for s in seed.spawn(count)]
        self.walkers = [_walker(np.random.default_rng(ways)) for ways, _ in seeds]
        drawn = [_pictures(np.random.default_rng(looks)) for _, looks in seeds]
        rows, columns = round(HEIGHT_M / TEXEL_M), round(WIDTH_M / TEXEL_M)
        empty = np.empty((0, columns, rows), np.uint8)
        self._columns = columns
        self._texels = np.concatenate([empty, *(light for light, _ in drawn)]).reshape(-1, rows)
        self._opacities = np.concatenate([empty, *(mask for _, mask in drawn)]).reshape(-1, rows)

    def seen_from(self, place: np.ndarray, seconds: float) -> Surfaces:
        """Everyone, turned towards `place` (2,) [m], the farthest first."""
        places = np.array([walker.at(seconds) for walker in self.walkers]).reshape(-1, 2)
        phases = np.array([walker.phase(seconds) for walker in self.walkers], np.int64)
        distances = np.linalg.norm(places - place, axis=1)
        order = [i for i in np.argsort(-distances) if distances[i] > NEAREST_M]
        towards = (place - places[order]) / distances[order, None]
        half = 0.5 * WIDTH_M * np.column_stack([towards[:, 1], -towards[:, 0]])
        return Surfaces(
            segments=np.hstack([places[order] - half, places[order] + half]),
            heights=np.full(len(order), HEIGHT_M),
            firsts=(np.array(order, np.int64) * PHASES + phases[order]) * self._columns,
            counts=np.full(len(order), self._columns),
            texels=self._texels,
            opacities=self._opacities,
        )


def _walker(rng: np.random.Generator) -> Walker:
    tour = list(trajectories.TOURS)[rng.integers(len(trajectories.TOURS))]
    path = trajectories.poses(tour, 1, POINTS)[0]
    length_m = np.hypot(*np.diff(path[:, :2], axis=0).T).sum()
    way, side = rng.choice([-1, 1], 2)
    return Walker(
        path=path,
        duration_s=float(way * length_m / rng.uniform(*SPEED_M_S)),
        start=float(rng.random()),
        left_m=float(side * rng.uniform(*ASIDE_M)),
    )


def _pictures(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(PHASES * columns... ) light, already dimmed by its opacity, and opacity of one person."""
    rows, columns = round(HEIGHT_M / TEXEL_M), round(WIDTH_M / TEXEL_M)
    clothes = _clothes(rng, rows, columns)
    outlines = [_outline(rows, columns, phase) for phase in range(PHASES)]
    light = [np.rint(np.clip(clothes, 0, 255) * outline / 255) for outline in outlines]
    return (
        np.ascontiguousarray(np.stack(light).astype(np.uint8).transpose(0, 2, 1)),
        np.ascontiguousarray(np.stack(outlines).transpose(0, 2, 1)),
    )


def _clothes(rng: np.random.Generator, rows: int, columns: int) -> np.ndarray:
    """(rows, columns) light: hair, face, a shirt, trousers, shoes."""
    light = np.empty((rows, columns), np.float32)
    hair, face, shirt, trousers = (int(share * rows) for share in (0.06, 0.15, 0.52, 0.96))
    light[:hair], light[hair:face] = rng.uniform(20, 120), rng.uniform(90, 200)
    light[face:shirt] = rng.uniform(40, 220)
    stripe = int(rng.integers(5, 20))
    if rng.random() < 0.5:
        for y in range(face, shirt, 2 * stripe):
            light[y : min(y + stripe, shirt)] = rng.uniform(20, 240)
    light[shirt:trousers], light[trousers:] = rng.uniform(25, 130), rng.uniform(10, 60)
    return light + 9 * fractal(rng, rows, columns, 32, 0.8)


def _outline(rows: int, columns: int, phase: int) -> np.ndarray:
    """(rows, columns) uint8: 255 where the person is, legs apart in every other phase."""
    mask = np.zeros((rows, columns), np.uint8)
    middle, shoulder, hip = columns // 2, int(0.18 * rows), int(0.5 * rows)
    cv2.ellipse(
        mask, (middle, int(0.075 * rows)), (columns // 9, int(0.07 * rows)), 0, 0, 360, 255, -1
    )
    broad, slim = int(0.27 * columns), int(0.2 * columns)
    neck, armpit = int(0.16 * rows), int(0.22 * rows)
    trunk = [
        *((middle - slim // 2, neck), (middle + slim // 2, neck)),
        *((middle + broad, armpit), (middle + slim, hip), (middle - slim, hip)),
        (middle - broad, armpit),
    ]
    cv2.fillPoly(mask, [np.array(trunk, np.int32)], 255)
    cv2.line(mask, (middle, int(0.12 * rows)), (middle, shoulder), 255, columns // 10)
    apart = (0.06, 0.2, 0.06, 0.2)[phase]
    for side in (-1, 1):
        swing = side * (1 if phase != 3 else -1)
        foot = (middle + int(side * apart * columns), int(0.99 * rows))
        cv2.line(mask, (middle + side * slim // 2, hip), foot, 255, columns // 7)
        hand = (middle + int((side * 0.3 + 0.07 * swing) * columns), int(0.52 * rows))
        cv2.line(mask, (middle + side * (broad - 2), shoulder + 6), hand, 255, columns // 10)
    return mask
