"""Resampling: the places where resamplers break, then the law they must keep."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from multi_robot_slam.filter import resampling

ALMOST_ONE = np.nextafter(1.0, 0.0)
uniforms = st.floats(0, 1, exclude_max=True)
weights = arrays(float, st.integers(1, 200), elements=st.floats(0, 1)).filter(lambda w: w.sum() > 0)


@given(weights, uniforms)
def test_every_particle_gets_floor_or_ceil_of_its_share(w, uniform):
    w = w / w.sum()
    copies = np.bincount(resampling.systematic(w, uniform), minlength=len(w))
    share = len(w) * w
    assert copies.sum() == len(w)
    assert (copies >= np.floor(share - 1e-6)).all()
    assert (copies <= np.ceil(share + 1e-6)).all()


@given(weights, uniforms)
def test_ancestors_ascend_and_have_weight(w, uniform):
    ancestors = resampling.systematic(w, uniform)
    assert (np.diff(ancestors) >= 0).all()
    assert (w[ancestors] > 0).all()


@pytest.mark.parametrize("zero", range(5))
@pytest.mark.parametrize("uniform", [0.0, 0.3, ALMOST_ONE])
def test_an_exact_zero_is_never_chosen(zero, uniform):
    w = np.full(5, 0.25)
    w[zero] = 0.0
    assert zero not in resampling.systematic(w, uniform)


@pytest.mark.parametrize("survivor", [0, 3, 6])
@pytest.mark.parametrize("uniform", [0.0, ALMOST_ONE])
def test_one_survivor_becomes_all(survivor, uniform):
    w = np.zeros(7)
    w[survivor] = 1.0
    assert (resampling.systematic(w, uniform) == survivor).all()


@given(st.integers(1, 500), st.floats(1e-6, 1 - 1e-6))
def test_equal_weights_keep_everyone(count, uniform):
    ancestors = resampling.systematic(np.full(count, 1 / count), uniform)
    np.testing.assert_array_equal(ancestors, np.arange(count))


@given(uniforms)
def test_float32_weights_whose_sum_stays_below_one(uniform):
    w = np.full(999, 1 / 999, np.float32)
    assert w.sum(dtype=np.float32) != 1
    ancestors = resampling.systematic(w.astype(float), uniform)
    assert ancestors.min() >= 0
    assert ancestors.max() <= 998


def test_expected_copies_are_proportional_to_the_weights():
    w = np.array([0.05, 0.6, 0.0, 0.35])
    draws = np.random.default_rng(0).random(20_000)
    copies = sum(np.bincount(resampling.systematic(w, u), minlength=4) for u in draws)
    np.testing.assert_allclose(copies / copies.sum(), w, atol=0.005)


def test_compiled_equals_plain_python():
    rng = np.random.default_rng(1)
    for _ in range(50):
        w, u = rng.random(40) ** 4, rng.random()
        plain = resampling.systematic.py_func(w, u)
        np.testing.assert_array_equal(resampling.systematic(w, u), plain)


def test_normalise_stands_any_constant():
    log_weights = np.array([-1e5, -1e5 + np.log(3), -2e5])
    np.testing.assert_allclose(resampling.normalise(log_weights), [0.25, 0.75, 0], atol=1e-10)


def test_effective_sample_size_counts_who_counts():
    assert resampling.effective_sample_size(np.full(8, 1 / 8)) == pytest.approx(8)
    assert resampling.effective_sample_size(np.array([0, 1.0, 0])) == pytest.approx(1)
