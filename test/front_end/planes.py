"""A stereo pair of textured planes whose disparity is known everywhere."""

import numpy as np

from multi_robot_slam.front_end.rig import StereoRig

WIDTH, HEIGHT = 480, 320
RIG = StereoRig(300.0, (239.5, 159.5), 0.1, WIDTH, HEIGHT)
"""A disparity of 30 px is 1 m."""

SLOPE = 0.04
"""Of the disparity along the row, on the lower half."""


def disparity(columns, rows):
    """Of the left image's pixels [px]: a wall above, a slope below, neither in whole pixels."""
    return np.where(rows < HEIGHT / 2, 17.3 + 0.0 * columns, 9.6 + SLOPE * columns)


def left_column(columns, rows):
    """Where the left image has what the right one has at `columns`."""
    slope = np.where(rows < HEIGHT / 2, 0.0, SLOPE)
    return (columns + disparity(0 * columns, rows)) / (1 - slope)


def texture(columns, rows, seed=0, waves=150):
    """(H, W): smooth noise, as a sum of waves that is exact between the pixels, too."""
    random = np.random.default_rng(seed)
    frequencies = random.normal(0, 0.25, (waves, 2))
    phases = random.uniform(0, 2 * np.pi, waves)
    grey = sum(
        np.cos(fx * columns + fy * rows + phase)
        for (fx, fy), phase in zip(frequencies, phases, strict=True)
    )
    return 128 + 40 * grey / np.sqrt(waves / 2)


def pair(noise=2.0, seed=0):
    """(left, right) uint8; the right camera's picture is darker, and both have noise."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    left = texture(columns, rows, seed)
    right = 0.9 * texture(left_column(columns, rows), rows, seed) + 5
    random = np.random.default_rng(seed + 1)
    return tuple(
        np.clip(np.rint(image + random.normal(0, noise, image.shape)), 0, 255).astype(np.uint8)
        for image in (left, right)
    )
