"""Stereo pairs of the building, as a robot's camera takes them."""

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from scipy.special import ndtri

from msg_defs.types import PoseSample, Walls
from sim_world import stereo
from sim_world.planar import compose
from sim_world.rendering import kernels, textures
from sim_world.rendering.kernels import Sensor, Surfaces, View
from sim_world.rendering.level import require_level
from sim_world.rendering.people import Crowd
from sim_world.rendering.settings import WallSettings
from sim_world.rendering.textures import Textures
from sim_world.scenario import Scenario
from sim_world.world import building

WALL_STREAM = 2
"""The world's stream of random numbers for what is on the walls; places and descriptors precede."""
PICTURE_STREAM = 2
"""A robot's stream of random numbers for its pictures; wheels and landmarks precede."""
PEOPLE_STREAM = 1_000_000
"""The simulation's stream of random numbers for people, behind those of all robots."""

MOST_PARTS = 8
"""Moments of which a picture with motion blur is the average, at most."""
NEAR_M = 2.0
"""Distance at which driving moves what is seen by as much as counts for motion blur."""

NOISE = ndtri((np.arange(4096) + 0.5) / 4096).astype(np.float32)
"""Quantiles of the standard normal distribution."""


class Pair(NamedTuple):
    """What both cameras see at one instant: (height, width) uint8 each."""

    left: np.ndarray
    right: np.ndarray


def of_building(scenario: Scenario, seed: int) -> "Renderer":
    """The renderer of a simulation with this scenario and seed."""
    walls = _building_textures(scenario.images.walls, scenario.world_seed)
    return Renderer(building(), walls, scenario, seed)


@lru_cache(maxsize=2)
def _building_textures(settings: WallSettings, world_seed: int) -> Textures:
    return textures.paint(
        building(), settings, np.random.SeedSequence(world_seed, spawn_key=(WALL_STREAM,))
    )


class Renderer:
    """The pictures of all robots of a simulation; the same scenario and seed give the same bytes.

    The cameras are those of `stereo.project`: whole numbers are the centres of pixels, as in
    OpenCV. Light counts linearly, from 0 to 255.
    """

    def __init__(self, walls: Walls, textures: Textures, scenario: Scenario, seed: int) -> None:
        """Render `walls` with the `textures` on them; `InputError` for a camera not level."""
        require_level(scenario.camera, walls.height_m)
        self.scenario = scenario
        self._camera, self._images = scenario.camera, scenario.images
        self._names, self._seed = scenario.names, seed
        self._walls = Surfaces(
            segments=walls.segments,
            heights=np.full(len(walls.segments), walls.height_m),
            firsts=textures.firsts,
            counts=textures.counts,
            texels=textures.texels,
            opacities=np.empty((0, textures.texels.shape[1]), np.uint8),
        )
        self._crowd = Crowd(self._images.people, self._stream(PEOPLE_STREAM))

    def pair(self, true: PoseSample) -> Pair:
        """What the robot `true.robot` sees at this pose and stamp, moving by this twist.

        A function of `true`, scenario and seed alone: pairs can be had in any order.
        """
        left, right = self._light(true)
        return Pair(self._read_out(left, true, 0), self._read_out(right, true, 1))

    def _light(self, true: PoseSample) -> list[np.ndarray]:
        """(width, height) float32 on both sensors, averaged over the time of exposure."""
        size = self._camera.width_px, self._camera.height_px
        light = [np.zeros(size, np.float32) for _ in range(2)]
        parts = self._parts(true.twist)
        for part in range(parts):
            after_s = ((part + 0.5) / parts - 0.5) * self._images.exposure_s
            speed, turn = true.twist * after_s
            pose = compose(true.pose, np.array([speed, 0.0, turn]))
            views = self._views(pose)
            middle = 0.5 * (views[0].eye + views[1].eye)[:2]
            people = self._crowd.seen_from(middle, true.stamp_ns / 1e9 + after_s)
            for sensor, view in zip(light, views, strict=True):
                kernels.expose(sensor, 1 / parts, view, self._walls, people, self._backdrop(view))
        if self._images.blur_px:
            for sensor in light:
                cv2.GaussianBlur(sensor, (0, 0), self._images.blur_px, dst=sensor)
        return light

    def _parts(self, twist: np.ndarray) -> int:
        """How many moments stand for the time of exposure: one for each pixel of motion."""
        speed = abs(twist[1]) + abs(twist[0]) / NEAR_M
        moved_px = self._camera.focal_px * self._images.exposure_s * speed
        return int(min(1 + np.ceil(moved_px), MOST_PARTS)) if moved_px else 1

    def _views(self, pose: np.ndarray) -> tuple[View, View]:
        camera = self._camera
        yaw = pose[2] + camera.mount.yaw_rad
        ahead, centre = np.array([np.cos(yaw), np.sin(yaw)]), np.array(camera.centre_px)
        left, right = stereo.eyes(pose, camera)
        return (
            View(left, ahead, camera.focal_px, centre),
            View(right, ahead, camera.focal_px, centre + self._images.right_off_px),
        )

    def _backdrop(self, view: View) -> np.ndarray:
        """(height,) float32: floor and ceiling, lighter the nearer they are."""
        slopes = (np.arange(self._camera.height_px) - view.centre[1]) / view.focal_px
        return np.where(slopes < 0, 180 - 60 * slopes, 85 + 70 * slopes).clip(0, 255).astype("f4")

    def _read_out(self, light: np.ndarray, true: PoseSample, side: int) -> np.ndarray:
        images, robot = self._images, self._names.index(true.robot)
        seconds = true.stamp_ns / 1e9
        gain = images.exposure_drift * self._wave(robot, 0, seconds)
        if side:
            gain += images.gain_difference * self._wave(robot, 1, seconds)
        sensor = Sensor(np.exp(gain), images.vignetting, images.photon_noise, images.read_noise)
        seed = self._stream(robot, PICTURE_STREAM, true.stamp_ns, side).generate_state(1, np.uint64)
        return kernels.read_out(light, sensor, NOISE, seed[0])

    def _wave(self, robot: int, number: int, seconds: float) -> float:
        """Something of the robot's own that changes slowly between -1 and 1."""
        rng = np.random.default_rng(self._stream(robot, PICTURE_STREAM, number))
        period_s, phase, sign = rng.uniform(15, 40), rng.random(), rng.choice([-1, 1])
        return sign * (0.6 + 0.4 * np.sin(2 * np.pi * (seconds / period_s + phase)))

    def _stream(self, *key: int) -> np.random.SeedSequence:
        return np.random.SeedSequence(self._seed, spawn_key=key)
