"""One candidate list for all particles finds what Algorithm 1's loop over the map finds."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from multi_robot_slam.filter.association import find_candidates, squared_distances


def unit(rng, count):
    descriptors = rng.random((count, 128)).astype(np.float32)
    return descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)


def test_squared_distances_are_the_definition():
    rng = np.random.default_rng(0)
    a, b = unit(rng, 7), unit(rng, 11)
    expected = ((a[:, None].astype(float) - b) ** 2).sum(-1)
    np.testing.assert_allclose(squared_distances(a, b), expected, atol=2e-6)


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 0.9))
def test_first_inside_the_gate_is_the_argmin_over_the_gate(seed, threshold):
    rng = np.random.default_rng(seed)
    observed, known = unit(rng, 5), unit(rng, 30)
    distances = ((observed[:, None] - known) ** 2).sum(-1)
    inside = rng.random((5, 30)) < 0.3
    candidates = find_candidates(observed, known, threshold)
    for b in range(5):
        listed = candidates.columns[candidates.starts[b] : candidates.starts[b + 1]]
        found = next((n for n in listed if n >= 0 and inside[b, n]), None)
        gated = np.where(inside[b], distances[b], np.inf)
        best = gated.argmin()
        assert found == (best if gated[best] <= threshold else None)


def test_an_observation_may_be_what_an_earlier_one_creates():
    rng = np.random.default_rng(1)
    observed = unit(rng, 3)
    observed[2] = observed[0]
    candidates = find_candidates(observed, np.empty((0, 128), np.float32), 1e-4)
    assert candidates.starts.tolist() == [0, 0, 0, 1]
    assert candidates.columns.tolist() == [-1]


def test_no_observations_no_candidates():
    nothing = np.empty((0, 128), np.float32)
    candidates = find_candidates(nothing, unit(np.random.default_rng(2), 4), 0.5)
    assert candidates.starts.tolist() == [0]
    assert len(candidates.columns) == 0
