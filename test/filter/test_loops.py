"""Compiled loops beside one line of NumPy each, to the bit."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from multi_robot_slam.filter import kernels
from multi_robot_slam.models import motion

seeds = st.integers(0, 2**32 - 1)
sizes = st.sampled_from([1, 2, 31, 255, 256, 257, 600])


@given(seeds, sizes, st.sampled_from([np.float32, np.float64]), st.sampled_from([-1e3, 0, 1e3]))
def test_extremes(seed, size, dtype, offset):
    rng = np.random.default_rng(seed)
    row = (rng.normal(size=size) * 10.0 ** rng.integers(-30, 5) + offset).astype(dtype)
    row[rng.integers(0, size, 2)] = rng.choice([0.0, -0.0, 1e9, -1e9, 1e-40], 2)
    assert kernels.extremes(row) == (row.min(), row.max())


@given(seeds, sizes, st.integers(1, 60), st.booleans())
def test_gather(seed, particles, distinct, has_two_generations):
    """Whether few ancestors are left, and runs are filled, or many."""
    rng = np.random.default_rng(seed)
    planes = rng.normal(size=(5, 9, particles)).astype(np.float32)
    rows = np.sort(
        [rng.choice(rng.integers(0, particles, distinct), particles) for _ in range(2)]
    ).astype(np.int32)
    columns = rng.permutation(5)[:3]
    generations = np.array([0, 1, 1] if has_two_generations else [1, 1, 0], np.int32)
    expected = planes.copy()
    for column, generation in zip(columns, generations, strict=True):
        expected[column] = planes[column][:, rows[generation]]
    kernels.gather(0, 3, planes, columns, rows, generations)
    np.testing.assert_array_equal(planes, expected)


@pytest.mark.parametrize("distinct", [1, 16, 37, 38, 600])
def test_runs_are_found_where_they_are_long(distinct):
    ancestors = np.sort(np.arange(600) % distinct).astype(np.int32)
    begins = np.empty(600 // kernels.LONG + 2, np.int32)
    runs = kernels.find_runs(ancestors, begins)
    assert runs == (distinct if distinct * kernels.LONG <= 600 else 0)
    if runs:
        expected = np.unique(ancestors, return_index=True)[1]
        assert begins[: runs + 1].tolist() == [*expected, 600]


@given(seeds, st.integers(0, 40))
def test_near(seed, count):
    rng = np.random.default_rng(seed)
    boxes = np.sort(rng.integers(-4, 5, (count, 2, 2)).astype(float), axis=2).reshape(count, 4)
    ids = rng.integers(-1, 3, count).astype(np.int32)
    box = np.sort(rng.integers(-4, 5, (2, 2)).astype(float)).ravel()
    meets = (boxes[:, 0] <= box[1]) & (boxes[:, 1] >= box[0])
    meets &= (boxes[:, 2] <= box[3]) & (boxes[:, 3] >= box[2])
    expected = np.flatnonzero(meets & (ids >= 0))
    assert kernels.near(boxes, ids, box).tolist() == expected.tolist()


@given(seeds, sizes, st.integers(0, 17))
def test_log_likelihood(seed, particles, count):
    rng = np.random.default_rng(seed)
    distances, determinants = rng.uniform(1e-6, 20, (2, count, particles)).astype(np.float32)
    expected = np.zeros(particles)
    for first in range(0, count, 8):
        product = np.ones(particles)
        for b in range(first, min(first + 8, count)):
            expected -= 0.5 * distances[b].astype(float)
            product *= determinants[b]
        expected -= 0.5 * np.log(product)
    found = kernels.log_likelihood(distances, determinants)
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)


@given(seeds, sizes, st.integers(0, 5))
def test_name(seed, particles, count):
    rng = np.random.default_rng(seed)
    ids = rng.integers(0, 1000, 30).astype(np.int32)
    columns = rng.integers(0, 30, (count, particles)).astype(np.int32)
    candidates = rng.integers(-count, 30, 12).astype(np.int32)
    new_columns = rng.integers(0, 30, count)
    meant = [c if c >= 0 else new_columns[-1 - c] for c in candidates]
    names, candidate_names = kernels.name(columns, candidates, new_columns, ids)
    np.testing.assert_array_equal(names, ids[columns])
    np.testing.assert_array_equal(candidate_names, ids[meant])


@given(seeds, sizes, st.booleans())
def test_move(seed, particles, is_one_motion):
    rng = np.random.default_rng(seed)
    poses = rng.normal(0, 5, (3, particles))
    motions = rng.normal(size=(3, 1 if is_one_motion else particles))
    cos, sin = np.cos(poses[2]), np.sin(poses[2])
    x = poses[0] + (cos * motions[0] - sin * motions[1])
    y = poses[1] + (sin * motions[0] + cos * motions[1])
    expected = np.array([x, y, poses[2] + motions[2]])
    motion.move(poses, motions)
    np.testing.assert_array_equal(poses, expected)
