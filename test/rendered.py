"""Rooms to render, and how."""

from dataclasses import replace

import numpy as np

from msg_defs.types import CameraMount, PoseSample, StereoCamera, Walls
from sim_world.rendering import textures
from sim_world.rendering.renderer import Renderer
from sim_world.rendering.settings import ImageSettings
from sim_world.scenario import Scenario

ROOM = ((0, 0), (8, 0), (8, 6), (0, 6))
"""Corners of a room [m], counter-clockwise."""
PILLAR = ((5, 3.5), (5, 4), (5.5, 4), (5.5, 3.5))
"""Corners of something in it, clockwise."""

PERFECT = ImageSettings(enabled=True, blur_px=0.0)
SMALL = StereoCamera(focal_px=30.0, width_px=40, height_px=30, mount=CameraMount(up_m=0.9))


def walls(*polygons):
    """Walls 2 m high around each polygon."""
    corners = [np.array(polygon, float) for polygon in polygons]
    return Walls(np.vstack([np.hstack([c, np.roll(c, -1, axis=0)]) for c in corners]), 2.0)


def renderer(room, painted, images=PERFECT, camera=None, seed=0, robots=2):
    scenario = Scenario(robots=robots, images=images, camera=camera or StereoCamera())
    return Renderer(room, painted, scenario, seed)


def noisy(room, texel_m, seed=0, least=0, most=255):
    """Walls of random texels."""
    painted = textures.blank(room, texel_m)
    rng = np.random.default_rng(seed)
    painted.texels[:] = rng.integers(least, most + 1, painted.texels.shape)
    return painted


def grey(room, light):
    """Walls of one shade."""
    painted = textures.blank(room, 0.05)
    painted.texels[:] = light
    return painted


def checkered(room, squares_per_m=4, texel_m=0.005):
    """Walls of black and white squares, from each wall's second end and from the top."""
    painted = textures.blank(room, texel_m)
    for wall, (x0, y0, x1, y1) in enumerate(room.segments):
        picture = painted.of(wall)
        along = (np.arange(picture.shape[1]) + 0.5) * np.hypot(x1 - x0, y1 - y0) / picture.shape[1]
        down = (np.arange(len(picture)) + 0.5) * room.height_m / len(picture)
        squares = np.floor(along * squares_per_m) + np.floor(down * squares_per_m)[:, None]
        picture[:] = np.where(squares % 2, 220, 30)
    return painted


def at(x, y, yaw, twist=(0.0, 0.0), stamp_ns=10**9, robot="robot_1"):
    """The truth about a robot there."""
    return PoseSample(robot, stamp_ns, np.array([x, y, yaw], float), np.array(twist, float))


def changed(images=PERFECT, **values):
    return replace(images, **values)
