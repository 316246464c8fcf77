"""The database of SIFT descriptors that landmarks take theirs from (paper sec. 6)."""

import os
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msg_defs.errors import InputError
from msg_defs.types import DESCRIPTOR_SIZE

SHIPPED = Path(__file__).parent / "data" / "sift.npz"
IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")
QUANTILES = (0.0, 0.001, 0.01, 0.05, 0.5, 0.95, 0.99, 0.999, 1.0)

NEAR_IDENTICAL = 2 * DESCRIPTOR_SIZE * 0.01**2
"""Squared distance (19) below which two descriptors count as the same.

It is the mean distance of two sightings of one descriptor under the noise of the paper's Table 2,
sigma = 0.01: anything closer is one texture met twice and not two landmarks.
"""


def load(path: str | Path | None = None) -> np.ndarray:
    """(D, 128) float32 descriptors of unit norm, from the database at `path` or the one shipped."""
    path = Path(path or SHIPPED)
    try:
        with np.load(path) as file:
            raw = file["descriptors"]
    except OSError as error:
        raise InputError(f"cannot read the descriptors {path}: {error.strerror or error}") from None
    except (EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile):
        raise InputError(f"{path} is no descriptor file; make one: sim_world descriptors") from None
    if raw.dtype != np.uint8 or raw.shape[1:] != (DESCRIPTOR_SIZE,) or not raw.any(1).all():
        raise InputError(
            f"{path}: expected uint8 rows of {DESCRIPTOR_SIZE}, none of them zero, found "
            f"{raw.dtype} of shape {raw.shape}; make a database with sim_world descriptors"
        )
    return _unit(raw)


def save(descriptors: np.ndarray, path: Path) -> None:
    """Write (D, 128) uint8 descriptors; a file that exists is not overwritten."""
    try:
        with open(path, "xb") as file:
            np.savez_compressed(file, descriptors=descriptors)
    except FileExistsError:
        raise InputError(f"{path} exists; remove it or choose another name") from None
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None


def find_images(paths: Iterable[Path]) -> list[Path]:
    """The given images, and those in the given folders in alphabetical order."""
    return [image for path in paths for image in _images_of(Path(path))]


def build(images: Iterable[Path]) -> np.ndarray:
    """(D, 128) uint8 SIFT descriptors of the images, each D different from all the others.

    SIFT describes a point once for each dominant direction: the first one is kept. Of
    descriptors closer than `NEAR_IDENTICAL`, the first one is kept.
    """
    found = [_describe(image) for image in images]
    if not sum(map(len, found)):
        raise InputError("no SIFT features found; give images with more texture")
    return drop_near_identical(np.concatenate(found))


def drop_near_identical(raw: np.ndarray) -> np.ndarray:
    """The rows of `raw` (D, 128) farther than `NEAR_IDENTICAL` from every row kept before."""
    unit = _unit(raw)
    kept = np.empty_like(unit)
    rows: list[int] = []
    for row, descriptor in enumerate(unit):
        cosines = kept[: len(rows)] @ descriptor
        if cosines.max(initial=-1) <= 1 - NEAR_IDENTICAL / 2:
            kept[len(rows)] = descriptor
            rows.append(row)
    return raw[rows]


@dataclass(frozen=True, eq=False)
class DistanceSpread:
    """Quantiles of E (19) between two noisy sightings; what the threshold E_0 separates."""

    quantiles: tuple[float, ...]
    equal: np.ndarray
    """E of two sightings of the same descriptor."""
    nearest_other: np.ndarray
    """E of a sighting to the nearest sighting of any other descriptor."""


def distance_spread(
    descriptors: np.ndarray, sigma: float, rng: np.random.Generator
) -> DistanceSpread:
    """Spread of E among (N, 128) descriptors seen with noise `sigma` per element."""
    first, second = (descriptors + rng.normal(0, sigma, descriptors.shape) for _ in range(2))
    squared = (first**2).sum(1)[:, None] + (second**2).sum(1) - 2 * first @ second.T
    equal = squared.diagonal().copy()
    np.fill_diagonal(squared, np.inf)
    return DistanceSpread(
        QUANTILES, np.quantile(equal, QUANTILES), np.quantile(squared.min(1), QUANTILES)
    )


def _unit(raw: np.ndarray) -> np.ndarray:
    rows = raw.astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def _images_of(path: Path) -> list[Path]:
    if not path.exists():
        raise InputError(f"{path} does not exist; give images or folders of images")
    if not path.is_dir():
        return [path]
    images = sorted(p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
    if not images:
        raise InputError(f"no images in {path}; known are {' '.join(IMAGE_SUFFIXES)}")
    return images


def _describe(image: Path) -> np.ndarray:
    import cv2

    pixels = cv2.imread(os.fspath(image), cv2.IMREAD_GRAYSCALE)
    if pixels is None:
        raise InputError(f"cannot read {image} as an image; remove it from the list")
    keypoints, descriptors = cv2.SIFT.create().detectAndCompute(pixels, None)
    if descriptors is None:
        return np.empty((0, DESCRIPTOR_SIZE), np.uint8)
    points = [(*point.pt, point.size) for point in keypoints]
    _, first = np.unique(points, axis=0, return_index=True)
    return descriptors[np.sort(first)].astype(np.uint8)
