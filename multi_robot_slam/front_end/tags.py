"""AprilTag and ArUco markers in a stereo pair: landmarks that say which they are, and robots.

A tag is where its four corners are by (14), found in both images: its centre is their mean, without
the bias that the mean of four pixels has under perspective. Its printed size is not needed for
that, so a wrong one cannot move it; that the four points are the corners of a square of this size
tells a tag from what looks like one.
"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np

from multi_robot_slam.front_end.covariance import jacobian
from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.front_end.settings import TagSettings
from multi_robot_slam.front_end.tag_corners import refined
from multi_robot_slam.front_end.tag_families import FAMILIES, descriptors
from multi_robot_slam.models.symmetric import pack

MOST_BLURRED_PX = 0.25
"""Corners that are less exact are blurred, or something covers an edge of their tag."""
FARTHEST_MOVED_PX = 3.0
"""A corner that is refined by more has left its tag."""
MOST_ROWS_PX = 2.0
"""Corners of one tag whose rows differ by more are of two tags."""
LEAST_DISPARITIES = 10.0
"""Standard deviations of a corner's disparity in it: with fewer, (14) is not linear enough."""
TOLERANCE = 0.1
"""A tag's sides may be wrong by such a share: printers scale, paper bends, calibrations err."""
SIGMAS = 4.0
"""Beyond that, a tag is no square of its size when so many standard deviations off."""

_RIGHT = np.array([-0.5, 0.5, 0.5, -0.5])
_UP = np.array([0.5, 0.5, -0.5, -0.5])
"""Of corners upper left, upper right, lower right, lower left: the tag's two sides as vectors."""


@dataclass(frozen=True, eq=False)
class TagCounts:
    """What became of the tags that the left image shows."""

    seen: int = 0
    ambiguous: int = 0
    """Their number is twice in one image."""
    one_sided: int = 0
    """Not in the right image, or there on other rows."""
    blurred: int = 0
    """Without four straight edges, or partly covered."""
    far: int = 0
    """Disparity too small for its error."""
    other_size: int = 0
    """Not square, or not of `size_m`."""
    matched: int = 0


class RobotsSeen(NamedTuple):
    """The S robots whose tags are in view, each once: what becomes `Sightings`."""

    others: np.ndarray
    """(S,) uint32: index in the team."""
    positions: np.ndarray
    """(S, 3) float32: where its `base_link` is in the camera frame, but at its tag's height [m]."""
    covariances: np.ndarray
    """(S, 6) float32 [m^2]."""


@dataclass(frozen=True, eq=False)
class Tags:
    """T tags on what stands still, and the robots that carry others."""

    numbers: np.ndarray
    """(T,) int64, ascending."""
    positions: np.ndarray
    """(T, 3) float32: centre of each in the camera frame [m]."""
    covariances: np.ndarray
    """(T, 6) float32 [m^2]."""
    descriptors: np.ndarray
    """(T, 128) float32: `tag_families.descriptors` of the numbers."""
    pixels: np.ndarray
    """(T, 3) float64: column, row, disparity of the centre [px]."""
    sides_px: np.ndarray
    """(T,) float64: side of each as it would look from straight ahead [px]."""
    robots: RobotsSeen
    counts: TagCounts
    outlines: np.ndarray
    """(seen, 4, 2): corners of all tags in the left image, also of those not used [px]."""
    other_sides_m: np.ndarray
    """(other_size,): mean side of those not of `size_m`, for who has measured it wrongly [m]."""

    def cover(self, points: np.ndarray) -> np.ndarray:
        """Which of the points (n, 2) of the left image lie on a tag (n,) bool.

        Corners of its pattern look like those of other tags, and may be on a robot that moves.
        """
        on_tag = np.zeros(len(points), bool)
        for outline in self.outlines:
            middle = outline.mean(axis=0)
            wider = middle + 1.3 * (outline - middle)
            side = np.roll(wider, -1, axis=0) - wider
            to = points[:, None] - wider
            on_tag |= (side[:, 0] * to[..., 1] - side[:, 1] * to[..., 0] > 0).all(axis=1)
        return on_tag


class _Quads(NamedTuple):
    """Tags found in one image."""

    numbers: np.ndarray
    """(n,) int64."""
    corners: np.ndarray
    """(n, 4, 2): upper left, upper right, lower right, lower left of the printed tag [px]."""


class _Squares(NamedTuple):
    """Tags found in both images."""

    numbers: np.ndarray
    """(n,) int64."""
    corners: np.ndarray
    """(n, 4, 3) in the camera frame [m]."""
    covariances: np.ndarray
    """(n, 4, 3, 3): of each corner [m^2]."""

    def only(self, rows: np.ndarray) -> "_Squares":
        return _Squares(*(values[rows] for values in self))

    def centres(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean of the corners (n, 3) [m], and its covariance (n, 3, 3) [m^2]."""
        return self.corners.mean(axis=1), self.covariances.sum(axis=1) / 16

    def sides(self) -> tuple[np.ndarray, np.ndarray]:
        """From the left edge to the right one, from the lower to the upper: (n, 3) each [m]."""
        across = np.einsum("c,ncx->nx", _RIGHT, self.corners)
        return across, np.einsum("c,ncx->nx", _UP, self.corners)


_FATES = ("matched", "one_sided", "blurred", "far", "other_size")
_MATCHED, _ONE_SIDED, _BLURRED, _FAR, _OTHER_SIZE = range(len(_FATES))
_NO_SQUARES = _Squares(np.empty(0, np.int64), np.empty((0, 4, 3)), np.empty((0, 4, 3, 3)))
_NO_QUADS = _Quads(np.empty(0, np.int64), np.empty((0, 4, 2)))


def find(left: np.ndarray, right: np.ndarray, rig: StereoRig, settings: TagSettings) -> Tags:
    """Tags in a rectified pair (H, W) uint8, of the family that settings name; none without one."""
    seen = _detected(left, settings.family)
    other = _detected(right, settings.family) if len(seen.numbers) else _NO_QUADS
    rows, partners, ambiguous = _partners(seen.numbers, other.numbers)
    in_left = _Quads(seen.numbers[rows], seen.corners[rows])
    in_right = _Quads(other.numbers[partners], other.corners[partners])
    squares, fates, sides = _measured((left, right), (in_left, in_right), rig, settings)
    counted = np.bincount(fates, minlength=len(_FATES)).tolist()
    counts = dict(zip(_FATES, counted, strict=True))
    counts["one_sided"] += len(seen.numbers) - len(rows) - ambiguous
    robots = {number: place for number, *place in settings.on_robots}
    carried = np.isin(squares.numbers, list(robots))
    still = squares.only(~carried)
    positions, covariances = still.centres()
    return Tags(
        numbers=still.numbers,
        positions=positions.astype(np.float32),
        covariances=pack(covariances).astype(np.float32),
        descriptors=descriptors(still.numbers),
        pixels=rig.pixel(positions),
        sides_px=rig.focal_px * settings.size_m / positions[:, 2],
        robots=_robots(squares.only(carried), robots, settings.size_m),
        counts=TagCounts(seen=len(seen.numbers), ambiguous=ambiguous, **counts),
        outlines=seen.corners,
        other_sides_m=sides,
    )


@cache
def _detector(family: str) -> cv2.aruco.ArucoDetector:
    dictionary = getattr(cv2.aruco, FAMILIES[family].dictionary)
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary))


def _detected(image: np.ndarray, family: str) -> _Quads:
    """Tags in an image (H, W) uint8, by number."""
    if not family:
        return _NO_QUADS
    corners, numbers, _ = _detector(family).detectMarkers(image)
    if numbers is None:
        return _NO_QUADS
    order = np.argsort(numbers.ravel(), kind="stable")
    quads = np.asarray(corners, np.float64).reshape(-1, 4, 2)
    return _Quads(numbers.ravel()[order].astype(np.int64), quads[order])


def _partners(seen: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Which tags of the left image are which of the right, and how many are ambiguous.

    A number that is twice in one image is used in neither: either tag may be misplaced.
    """
    same = seen[:, None] == other
    ambiguous = ((seen[:, None] == seen).sum(axis=1) > 1) | (same.sum(axis=1) > 1)
    rows = np.flatnonzero(~ambiguous & same.any(axis=1))
    return rows, np.nonzero(same[rows])[1], int(ambiguous.sum())


def _measured(
    images: tuple[np.ndarray, np.ndarray],
    quads: tuple[_Quads, _Quads],
    rig: StereoRig,
    settings: TagSettings,
) -> tuple[_Squares, np.ndarray, np.ndarray]:
    """Tags in space that stand every test; what became of all (n,); sides that are wrong [m].

    `quads` hold the same n tags in the left and in the right image.
    """
    cells = _detector(settings.family).getDictionary().markerSize + 2 if settings.family else 0
    found = [refined(image, quad.corners, cells) for image, quad in zip(images, quads, strict=True)]
    (left, _), (right, _) = found
    spread = np.maximum(*(spread for _, spread in found))
    moved = np.maximum(
        *(
            np.abs(corners - quad.corners).max(axis=(1, 2))
            for (corners, _), quad in zip(found, quads, strict=True)
        )
    )
    pixels = np.dstack([left, left[:, :, 0] - right[:, :, 0]])
    sigmas = np.maximum(spread, settings.sigma_px)
    least = LEAST_DISPARITIES * np.sqrt(2) * sigmas
    is_sharp = (spread <= MOST_BLURRED_PX) & (moved <= FARTHEST_MOVED_PX)
    rows_apart = np.abs(left - right)[:, :, 1].max(axis=1, initial=0)
    fates = np.select(
        [~is_sharp, rows_apart > MOST_ROWS_PX, pixels[:, :, 2].min(axis=1, initial=np.inf) < least],
        [_BLURRED, _ONE_SIDED, _FAR],
        _MATCHED,
    )
    good = np.flatnonzero(fates == _MATCHED)
    squares = _in_space(quads[0].numbers[good], pixels[good], sigmas[good], rig)
    fits, sides = _are_squares(squares, settings.size_m)
    fates[good[~fits]] = _OTHER_SIZE
    return squares.only(fits), fates, sides[~fits]


def _in_space(
    numbers: np.ndarray, pixels: np.ndarray, sigmas: np.ndarray, rig: StereoRig
) -> _Squares:
    """Tags whose corners are at `pixels` (n, 4, 3), with errors of `sigmas` (n,) [px].

    Column and row in either image are independent; the disparity shares the left column's error.
    """
    if not len(numbers):
        return _NO_SQUARES
    shared = np.array([[1.0, 0, 1], [0, 1, 0], [1, 0, 2]])
    levers = jacobian(rig, pixels.reshape(-1, 3)).reshape(-1, 4, 3, 3)
    covariances = levers @ shared @ np.swapaxes(levers, 2, 3) * sigmas[:, None, None, None] ** 2
    return _Squares(numbers, rig.point(*np.moveaxis(pixels, -1, 0)), covariances)


def _are_squares(squares: _Squares, size_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Which are squares of this size within their errors (n,) bool; mean of their sides (n,) [m].

    A noisy side is longer than it is by the trace of its covariance, in the square.
    """
    across, up = squares.sides()
    noise = squares.covariances.sum(axis=1) / 4
    excess = np.trace(noise, axis1=1, axis2=2)
    errors = []
    for one, two, expected in ((across, across, size_m), (up, up, size_m), (across, up, 0.0)):
        product = (one * two).sum(axis=1)
        along = one + two
        variance = np.einsum("nx,nxy,ny->n", along, noise, along) + (noise**2).sum(axis=(1, 2))
        wrong = product - excess * (expected > 0) - expected**2
        errors.append(np.abs(wrong) - SIGMAS * np.sqrt(variance))
    bent = np.einsum("c,ncx->nx", [1, -1, 1, -1], squares.corners)
    bend = size_m * (np.linalg.norm(bent, axis=1) - SIGMAS * 2 * np.sqrt(excess))
    fits = np.max([*errors, bend], axis=0) <= 2 * TOLERANCE * size_m**2
    lengths = [np.sqrt(np.maximum((side**2).sum(axis=1) - excess, 0)) for side in (across, up)]
    return fits, np.mean(lengths, axis=0)


def _robots(squares: _Squares, places: dict[int, list[float]], size_m: float) -> RobotsSeen:
    """The robots that carry these tags: of several tags of one robot, by the surest."""
    seen: dict[int, tuple[float, np.ndarray, np.ndarray]] = {}
    for number, corners, noise in zip(*squares, strict=True):
        robot, forward, left, yaw = places[int(number)]
        position, covariance = axis_of_robot(corners, noise, (forward, left, yaw), size_m)
        spread = float(np.trace(covariance))
        if position[2] > 0 and spread < seen.get(int(robot), (np.inf,))[0]:
            seen[int(robot)] = spread, position, covariance
    others = sorted(seen)
    return RobotsSeen(
        np.array(others, np.uint32),
        np.array([seen[n][1] for n in others], np.float32).reshape(-1, 3),
        pack(np.array([seen[n][2] for n in others]).reshape(-1, 3, 3)).astype(np.float32),
    )


def axis_of_robot(
    corners: np.ndarray, noise: np.ndarray, place: tuple[float, float, float], size_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Where a robot's vertical axis is at the height of a tag that it carries upright.

    From the tag's centre the axis is `out` along the normal and `across` along its side. Neither
    direction is normalised: their errors then stay linear, however far the tag, and unbiased.

    Parameters
    ----------
    corners : (4, 3) in the camera frame [m]; noise : (4, 3, 3), their covariances [m^2].
    place : forward, left of the tag's centre on `base_link` [m], and the yaw it faces [rad].

    Returns
    -------
    Position (3,) in the camera frame [m] and its covariance (3, 3) [m^2].

    """
    forward, left, yaw = place
    out = -(forward * np.cos(yaw) + left * np.sin(yaw))
    across = forward * np.sin(yaw) - left * np.cos(yaw)
    side, up = _RIGHT @ corners, _UP @ corners
    # the camera frame is left-handed: right x up is away from who looks at the tag
    normal = np.cross(up, side) / size_m**2
    position = corners.mean(axis=0) + across / size_m * side + out * normal
    levers = (0.25 + across / size_m * _RIGHT)[:, None, None] * np.eye(3)
    turning = np.multiply.outer(_RIGHT, _cross(up)) - np.multiply.outer(_UP, _cross(side))
    levers = levers + out / size_m**2 * turning
    return position, (levers @ noise @ np.swapaxes(levers, 1, 2)).sum(axis=0)


def _cross(vector: np.ndarray) -> np.ndarray:
    """(3, 3): its product with another vector is the cross product."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
