"""Keypoints: spread over the image, the strongest first, and none that has a double."""

import numpy as np
from front_end import planes
from hypothesis import given
from hypothesis import strategies as st

from multi_robot_slam.front_end.features import PER_CELL, Keypoints, distinct, spread
from multi_robot_slam.front_end.settings import FeatureSettings

SETTINGS = FeatureSettings()
SHAPE = (240, 320)
pixels = st.lists(st.tuples(st.floats(0, 319.5), st.floats(0, 239.5)), min_size=0, max_size=60).map(
    lambda rows: np.array(rows).reshape(-1, 2)
)


def test_descriptors_have_unit_norm_and_places_one_keypoint():
    found = Keypoints.of(planes.pair()[0], SETTINGS)
    assert len(found.pixels) > 100
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-5)
    places = np.column_stack([found.pixels, found.sizes])
    assert len(np.unique(places, axis=0)) == len(places)


def test_keypoints_are_where_the_image_has_them():
    """Of a mirrored image they are mirrored: no side is favoured by a fraction of a pixel."""
    image = planes.pair(noise=0.0)[0]
    found = Keypoints.of(image, SETTINGS).pixels
    mirrored = Keypoints.of(np.ascontiguousarray(image[:, ::-1]), SETTINGS).pixels
    mirrored[:, 0] = image.shape[1] - 1 - mirrored[:, 0]
    distances = np.linalg.norm(found[:, None] - mirrored, axis=2)
    nearest = distances.argmin(axis=1)
    pairs = distances[np.arange(len(found)), nearest] < 1
    shift = (found - mirrored[nearest])[pairs]
    assert pairs.mean() > 0.8
    np.testing.assert_allclose(np.median(shift, axis=0), 0, atol=0.02)


@given(pixels, st.integers(1, 50))
def test_the_strongest_of_every_cell_comes_before_the_second_of_any(points, most):
    kept = spread(points, SHAPE, most)
    side = np.sqrt(SHAPE[0] * SHAPE[1] * PER_CELL / most)
    cells = [tuple(cell) for cell in (points // side).astype(int)]
    ranks = [cells[:n].count(cell) for n, cell in enumerate(cells)]
    assert len(kept) == min(most, len(points))
    assert (np.diff(kept) > 0).all()
    dropped = np.setdiff1d(np.arange(len(points)), kept)
    if len(dropped):
        assert max(ranks[n] for n in kept) <= min(ranks[n] for n in dropped)


def test_what_an_image_shows_twice_is_not_distinct():
    left = planes.pair(noise=1.0)[0]
    doubled = left.copy()
    doubled[:100, 300:400] = left[:100, 100:200]
    found = Keypoints.of(doubled, SETTINGS)
    alone = distinct(found, np.arange(len(found.pixels)), 0.15)
    column, row = found.pixels.T
    inside = (row < 85) & (((column > 115) & (column < 185)) | ((column > 315) & (column < 385)))
    assert inside.sum() > 20
    assert alone[inside].mean() < 0.1
    assert alone[row > 120].mean() > 0.9
    assert distinct(found, np.arange(len(found.pixels)), 0.0).all()


def test_a_flat_image_has_none():
    found = Keypoints.of(np.full(SHAPE, 255, np.uint8), SETTINGS)
    assert found.pixels.shape == (0, 2)
    assert found.descriptors.shape == (0, 128)
    assert distinct(found, np.arange(0), 0.15).shape == (0,)
