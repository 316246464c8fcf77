"""Things that hang or stand on walls, each drawn from a random generator: (h, w) float32 light.

Sizes are in texels. Light is 0..255. Each kind is rich in corners and blobs of many sizes, as what
hangs in real corridors is, and no two that are drawn look alike.
"""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

ALPHABET = tuple(np.random.default_rng(letter).choice(15, (4, 2)) for letter in range(40))
"""Strokes of each letter: from and to one of 3 x 5 points, counted along the rows."""

Draw = Callable[[np.random.Generator, int, int], np.ndarray]


class Kind(NamedTuple):
    """One kind of thing on a wall."""

    draw: Draw
    widths_m: tuple[float, float]
    heights_m: tuple[float, float]
    middle_m: float | None
    """Height of its middle above the floor [m]; None where it stands on the floor."""


def fractal(
    rng: np.random.Generator, height: int, width: int, coarsest: int, roughness: float
) -> np.ndarray:
    """(h, w) noise of several octaves, of zero mean and unit variance or less.

    Each octave has half the cells' size and `roughness` (0..1) times the amplitude of the one
    before, down to cells of two texels.
    """
    total = np.zeros((height, width), np.float32)
    cell, amplitude, power = coarsest, 1.0, 0.0
    while cell >= 2:
        rows, columns = height // cell + 4, width // cell + 4
        coarse = rng.standard_normal((rows, columns), np.float32)
        size = columns * cell, rows * cell
        fine = cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
        total += np.float32(amplitude) * fine[cell : cell + height, cell : cell + width]
        power += amplitude**2
        cell, amplitude = cell // 2, amplitude * roughness
    return total / np.float32(np.sqrt(power))


def photograph(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Clouds of natural roughness, with things of sharp and of soft outline before them."""
    scene = 128 + 45 * fractal(rng, height, width, max(height // 3, 4), rng.uniform(0.45, 0.7))
    for _ in range(rng.integers(12, 30)):
        mask = np.zeros((height, width), np.float32)
        _outline(rng, mask)
        if rng.random() < 0.3:
            cv2.GaussianBlur(mask, (0, 0), rng.uniform(1, 4), dst=mask)
        mask *= rng.uniform(0.4, 1)
        scene += mask * (rng.uniform(0, 255) - scene)
    return _framed(rng, scene)


def page(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """A heading and lines of text, a drawing between them, dark on light or light on dark."""
    sheet = np.full((height, width), 225, np.float32)
    y = _line(rng, sheet, 8, int(rng.integers(24, 44)), 4)
    drawing = int(height * rng.uniform(0.2, 0.4))
    at = rng.uniform(0.2, 0.6) * height
    tall = int(rng.integers(8, 16))
    while y < height - 2 * tall:
        if y > at and drawing:
            inner = sheet[y : y + drawing, 8 : width - 8]
            inner[:] = photograph(rng, *inner.shape) if min(inner.shape) > 16 else inner
            y, drawing = y + drawing + 4, 0
        y = _line(rng, sheet, y, tall, 1 + tall // 12)
    return sheet if rng.random() < 0.75 else 255 - sheet


def shapes(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Flat shapes over each other, as on a print."""
    print_ = np.full((height, width), rng.uniform(40, 220), np.float32)
    for _ in range(rng.integers(25, 60)):
        mask = np.zeros((height, width), np.float32)
        _outline(rng, mask)
        np.copyto(print_, rng.uniform(10, 245), where=mask > 0.5)
    return _framed(rng, print_)


def board(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """A cork board with sheets of paper pinned to it."""
    cork = 120 + 18 * fractal(rng, height, width, 8, 0.9)
    for _ in range(rng.integers(6, 14)):
        h, w = rng.integers([height // 6, width // 10], [height // 2, width // 4])
        draw = (photograph, page, page, shapes)[rng.integers(4)]
        sheet = draw(rng, max(int(h), 20), max(int(w), 20))
        y, x = rng.integers(0, height - len(sheet) + 1), rng.integers(0, width - sheet.shape[1] + 1)
        cork[y : y + sheet.shape[0], x : x + sheet.shape[1]] = sheet
    return _framed(rng, cork)


def shelf(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Boards with books of all heights, thicknesses and shades on them."""
    case = np.full((height, width), 45, np.float32)
    boards = int(rng.integers(4, 7))
    for y0, y1 in zip(*_cuts(height, boards), strict=True):
        x = 4
        while x < width - 12:
            thick, tall = int(rng.integers(5, 16)), int((y1 - y0 - 6) * rng.uniform(0.6, 0.98))
            _book(rng, case[y1 - 4 - tall : y1 - 4, x : min(x + thick, width - 4)])
            x += thick + int(rng.integers(0, 2) + 12 * (rng.random() < 0.06))
        case[y1 - 4 : y1] = 150
    case[:, :4] = case[:, -4:] = 150
    return case


def door(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """A wooden door with its frame, a handle, a number and a notice."""
    grain = fractal(rng, height // 8 + 1, width, 16, 0.7).repeat(8, axis=0)[:height]
    leaf = rng.uniform(90, 190) + 8 * grain
    frame = max(width // 18, 2)
    leaf[:frame], leaf[:, :frame], leaf[:, -frame:] = 60, 60, 60
    y, x = int(height * 0.52), int(width * 0.82)
    cv2.rectangle(leaf, (x, y), (x + width // 12, y + width // 8), 220, -1)
    cv2.circle(leaf, (x + width // 24, y + width // 16), width // 30, 30, -1)
    plate = page(rng, max(height // 9, 24), max(width // 3, 40))
    y, x = int(height * rng.uniform(0.15, 0.3)), int(width * rng.uniform(0.2, 0.45))
    leaf[y : y + plate.shape[0], x : x + plate.shape[1]] = plate
    return leaf


KINDS = (
    Kind(photograph, (0.5, 1.2), (0.4, 0.9), 1.35),
    Kind(page, (0.5, 0.9), (0.6, 1.1), 1.3),
    Kind(shapes, (0.5, 1.2), (0.5, 1.0), 1.3),
    Kind(board, (1.1, 1.9), (0.8, 1.1), 1.25),
    Kind(shelf, (0.8, 1.6), (1.3, 1.9), None),
    Kind(door, (0.85, 1.0), (1.9, 1.95), None),
)
"""All kinds; one is as likely as another."""


def _outline(rng: np.random.Generator, mask: np.ndarray) -> None:
    """Fill one shape with ones: a polygon, an ellipse, or a bar."""
    height, width = mask.shape
    centre = rng.uniform(0, [width, height])
    reach = rng.uniform(0.03, 0.3) * min(height, width) + 2
    if rng.random() < 0.4:
        axes = (int(reach) + 1, int(reach * rng.uniform(0.3, 1)) + 1)
        middle = (int(centre[0]), int(centre[1]))
        cv2.ellipse(mask, middle, axes, rng.uniform(0, 180), 0, 360, 1.0, -1)
        return
    angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 7)))
    radii = reach * rng.uniform(0.5, 1.5, len(angles))
    corners = centre + np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])
    cv2.fillPoly(mask, [corners.astype(np.int32)], 1.0)


def _line(rng: np.random.Generator, sheet: np.ndarray, y: int, tall: int, thick: int) -> int:
    """Write words from row `y` down across the sheet; where the next line begins."""
    ink, step = rng.uniform(0, 60), 0.28 * tall
    at = 8.0
    while at < sheet.shape[1] - 8 - 3 * step:
        for start, stop in ALPHABET[rng.integers(len(ALPHABET))]:
            (row0, column0), (row1, column1) = divmod(start, 3), divmod(stop, 3)
            ends = [
                (at + column0 * step, y + row0 * tall / 4),
                (at + column1 * step, y + row1 * tall / 4),
            ]
            cv2.polylines(sheet, [np.rint(ends).astype(np.int32)], False, ink, thick)
        at += 3 * step if rng.random() < 0.84 else 5 * step
    return y + int(1.6 * tall) + 2


def _framed(rng: np.random.Generator, picture: np.ndarray) -> np.ndarray:
    """With a frame around it."""
    picture = np.clip(picture, 0, 255)
    wide, light = int(rng.integers(2, 6)), rng.choice([20.0, 60.0, 240.0])
    picture[:wide] = picture[-wide:] = light
    picture[:, :wide] = picture[:, -wide:] = light
    return picture


def _cuts(length: int, parts: int) -> tuple[np.ndarray, np.ndarray]:
    edges = np.linspace(0, length, parts + 1).astype(int)
    return edges[:-1], edges[1:]


def _book(rng: np.random.Generator, spine: np.ndarray) -> None:
    """Fill the spine of a book: its shade, two bands and a label, in place."""
    if min(spine.shape) < 3:
        return
    spine[:] = rng.uniform(20, 235)
    bands = rng.integers(0, len(spine), 2)
    for y in bands:
        spine[y : y + 3] = rng.uniform(20, 235)
    top = int(rng.uniform(0.1, 0.5) * len(spine))
    label = spine[top : top + len(spine) // 3, 1:-1]
    label[:] = rng.uniform(20, 235, label.shape).round(-2) if rng.random() < 0.5 else label
