"""The SIFT database: what it holds, how it is built, how far apart descriptors are."""

import cv2
import numpy as np
import pytest

from msg_defs.errors import InputError
from sim_world import descriptors
from sim_world.descriptors import NEAR_IDENTICAL, SHIPPED


@pytest.fixture
def texture(tmp_path):
    """An image full of blobs, and its path."""
    pixels = np.random.default_rng(0).integers(0, 256, (40, 40), np.uint8)
    pixels = cv2.resize(pixels, (240, 240), interpolation=cv2.INTER_CUBIC)
    path = tmp_path / "texture.png"
    cv2.imwrite(str(path), pixels)
    return path


def squared_distances(rows):
    return ((rows[:, None, :] - rows[None, :, :]) ** 2).sum(2)


def test_shipped_database_is_large_enough_and_small_enough():
    rows = descriptors.load()
    assert rows.shape[0] >= 2000
    assert rows.shape[1] == 128
    assert rows.dtype == np.float32
    assert SHIPPED.stat().st_size < 600_000


def test_descriptors_have_unit_norm():
    np.testing.assert_allclose(np.linalg.norm(descriptors.load(), axis=1), 1, atol=1e-6)


def test_shipped_descriptors_are_all_different():
    rows = descriptors.load()
    cosines = rows @ rows.T
    np.fill_diagonal(cosines, -1)
    assert (2 - 2 * cosines.max(1) > NEAR_IDENTICAL * 0.999).all()


def test_near_identical_rows_are_dropped_and_nothing_else():
    rng = np.random.default_rng(1)
    base = rng.integers(0, 150, (20, 128)).astype(np.uint8)
    copies = base + rng.integers(0, 2, base.shape).astype(np.uint8)
    kept = descriptors.drop_near_identical(np.concatenate([base, copies, base]))
    np.testing.assert_array_equal(kept, base)


def test_each_image_point_is_described_once(texture):
    points = cv2.SIFT_create().detect(cv2.imread(str(texture), cv2.IMREAD_GRAYSCALE), None)
    places = {(p.pt, p.size) for p in points}
    assert len(places) < len(points)
    built = descriptors.build([texture])
    assert 50 < len(built) <= len(places)
    assert built.dtype == np.uint8


def test_an_image_given_twice_adds_nothing(texture):
    once, twice = descriptors.build([texture]), descriptors.build([texture, texture])
    np.testing.assert_array_equal(once, twice)


def test_what_is_saved_is_loaded(texture, tmp_path):
    raw = descriptors.build([texture])
    descriptors.save(raw, tmp_path / "d.npz")
    loaded = descriptors.load(tmp_path / "d.npz")
    np.testing.assert_allclose(
        loaded, raw / np.linalg.norm(raw.astype(float), axis=1)[:, None], 1e-5
    )


def test_nothing_is_overwritten(tmp_path):
    (tmp_path / "d.npz").write_text("precious")
    with pytest.raises(InputError, match=r"d\.npz exists"):
        descriptors.save(np.ones((1, 128), np.uint8), tmp_path / "d.npz")
    assert (tmp_path / "d.npz").read_text() == "precious"


def test_an_image_without_texture_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((100, 100), 128, np.uint8))
    with pytest.raises(InputError, match="no SIFT features"):
        descriptors.build([tmp_path / "grey.png"])


def test_a_folder_gives_its_images_in_order(tmp_path):
    for name in ("b.png", "a.JPG", "notes.txt"):
        (tmp_path / name).touch()
    assert [p.name for p in descriptors.find_images([tmp_path])] == ["a.JPG", "b.png"]


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no archive",
        {"other": np.ones((3, 128))},
        {"descriptors": np.ones(128, np.uint8)},
        {"descriptors": np.ones((3, 64), np.uint8)},
        {"descriptors": np.ones((3, 128), np.float32)},
        {"descriptors": np.zeros((3, 128), np.uint8)},
        {"descriptors": np.array([{}])},
    ],
)
def test_a_bad_database_is_refused(tmp_path, content):
    path = tmp_path / "bad.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.savez(path, **content)
    with pytest.raises(InputError, match=r"bad\.npz.*sim_world descriptors"):
        descriptors.load(path)


def test_a_missing_database_is_named():
    with pytest.raises(InputError, match=r"/nowhere\.npz: No such file"):
        descriptors.load("/nowhere.npz")


def test_spread_without_noise_is_the_distance_between_descriptors():
    rows = descriptors.load()[:60]
    spread = descriptors.distance_spread(rows, 0.0, np.random.default_rng(0))
    others = squared_distances(rows) + np.diag(np.full(60, np.inf))
    np.testing.assert_allclose(spread.equal, 0, atol=1e-6)
    np.testing.assert_allclose(
        spread.nearest_other, np.quantile(others.min(1), spread.quantiles), atol=1e-6
    )


def test_spread_of_equal_descriptors_is_that_of_the_noise():
    """E of two noisy copies is 2 sigma^2 times chi-squared with 128 degrees of freedom."""
    rows = descriptors.load()[:2000]
    spread = descriptors.distance_spread(rows, 0.02, np.random.default_rng(0))
    median = spread.equal[spread.quantiles.index(0.5)]
    deviation = (spread.equal[spread.quantiles.index(0.95)] - median) / 1.645
    assert median == pytest.approx(2 * 128 * 0.02**2, rel=0.02)
    assert deviation == pytest.approx(2 * 0.02**2 * np.sqrt(2 * 128), rel=0.1)
