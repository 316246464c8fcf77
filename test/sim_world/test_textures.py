"""What is painted on the walls."""

from itertools import pairwise

import cv2
import numpy as np
import pytest

from msg_defs.types import Walls
from sim_world.rendering import textures
from sim_world.rendering.pictures import KINDS
from sim_world.rendering.settings import WallSettings
from sim_world.world import HEIGHT_M, building

WALLS = Walls(building().segments[9:33], HEIGHT_M)
"""130 m of them, some long and some short."""


def paint(world_seed=0, **settings):
    return textures.paint(WALLS, WallSettings(**settings), np.random.SeedSequence(world_seed))


@pytest.fixture(scope="module")
def painted():
    return paint()


def test_each_wall_has_texels_of_one_size(painted):
    lengths = np.hypot(*(WALLS.segments[:, 2:] - WALLS.segments[:, :2]).T)
    np.testing.assert_allclose(painted.counts * textures.TEXEL_M, lengths, atol=textures.TEXEL_M)
    assert painted.texels.shape == (painted.counts.sum(), 2.0 / textures.TEXEL_M)
    for (first, following), count in zip(pairwise(painted.firsts), painted.counts, strict=False):
        assert following == first + count
    assert painted.of(3).shape == (500, painted.counts[3])


def test_the_same_seed_paints_the_same_and_another_something_else(painted):
    np.testing.assert_array_equal(paint().texels, painted.texels)
    other = paint(world_seed=1).texels
    assert np.mean(other != painted.texels) > 0.9


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.draw.__name__)
def test_no_two_pictures_of_a_kind_are_alike(kind):
    drawn = [kind.draw(np.random.default_rng(seed), 220, 240) for seed in range(4)]
    for picture in drawn:
        assert picture.shape == (220, 240)
        assert picture.std() > 5
    correlations = np.corrcoef([picture[20:-20, 20:-20].ravel() for picture in drawn])
    assert np.abs(correlations - np.eye(4)).max() < 0.8


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.draw.__name__)
def test_every_kind_has_many_features(kind):
    picture = kind.draw(np.random.default_rng(1), 225, 225)
    keypoints = cv2.SIFT_create().detect(np.clip(picture, 0, 255).astype(np.uint8), None)
    assert len(keypoints) > 25


def occurrences(painted, row, pattern):
    """How often a pattern is in one row of the walls."""
    text = painted.texels[:, row].tobytes()
    return text.count(pattern)


def rows_of_copies(painted, perfect, width=60):
    """Rows of texels that a copy has painted over: (row, bytes)."""
    row = 150
    changed = np.flatnonzero(painted.texels[:, row] != perfect.texels[:, row])
    for first in changed[::25]:
        pattern = painted.texels[first : first + width, row]
        if len(np.unique(pattern)) > 25:
            yield row, pattern.tobytes()


def test_repeated_things_are_the_same_texels_on_several_walls(painted):
    copied = paint(repeated=1.0)
    counts = [occurrences(copied, row, p) for row, p in rows_of_copies(copied, painted)]
    own = [occurrences(painted, row, p) for row, p in rows_of_copies(painted, copied)]
    assert np.median(counts) > 5
    assert max(own) == 1


def test_a_share_of_the_things_is_repeated(painted):
    few, many = (np.mean(paint(repeated=share).texels != painted.texels) for share in (0.2, 1.0))
    assert 0.1 < few / many < 0.35


def plain_columns(painted):
    """(C,) bool: the column looks like the one before it."""
    same = (np.diff(painted.texels.astype(int), axis=0) == 0).all(1)
    return np.concatenate([[False], same])


def test_the_stated_share_of_the_walls_is_plain(painted):
    """Bays are 3 to 7 m long, so the share of 260 m is a matter of chance."""
    assert plain_columns(painted).mean() < 0.01
    some, most, all_ = (plain_columns(paint(plain=share)) for share in (0.3, 0.7, 1.0))
    assert some.mean() == pytest.approx(0.3, abs=0.12)
    assert most.mean() == pytest.approx(0.7, abs=0.12)
    assert all_.mean() > 0.97
    assert not (some & ~most).any()


def test_what_is_not_plain_stays_as_it_was(painted):
    emptier = paint(plain=0.3)
    kept = (emptier.texels == painted.texels).all(1)
    assert kept.mean() == pytest.approx(0.7, abs=0.12)
    assert not (kept & plain_columns(emptier))[1:].mean() > 0.01


def test_without_posters_walls_have_their_material_alone(painted):
    bare = paint(posters_per_m=0)
    changed = (bare.texels != painted.texels).any(1).mean()
    assert 0.2 < changed < 0.8
    assert not plain_columns(bare).mean() > 0.01
