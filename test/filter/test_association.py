"""One candidate list for all particles finds what Algorithm 1's loop over the map finds."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from multi_robot_slam.filter import kernels
from multi_robot_slam.filter.association import (
    field_of_search,
    find_candidates,
    landmarks_among,
)
from multi_robot_slam.models.descriptors import squared_distances
from multi_robot_slam.models.symmetric import unpack


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
    candidates = find_candidates(observed, known, np.arange(30), threshold)
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
    candidates = find_candidates(observed, np.empty((0, 128), np.float32), np.empty(0, int), 1e-4)
    assert candidates.starts.tolist() == [0, 0, 0, 1]
    assert candidates.columns.tolist() == [-1]


@given(st.integers(0, 2**32 - 1), st.integers(0, 6), st.integers(0, 9), st.booleans())
def test_the_list_is_that_of_sorting_all_pairs(seed, count, known_count, are_alike):
    """To the bit, and where distances are equal in the order of the columns."""
    rng = np.random.default_rng(seed)
    everything = unit(rng, 3 if are_alike else 20)
    observed = everything[rng.integers(0, len(everything), count)]
    known = everything[rng.integers(0, len(everything), known_count)]
    columns = np.sort(rng.choice(50, known_count, replace=False))
    threshold = float(rng.choice([0.0, 0.3, 0.5, 3.0]))
    rows = np.concatenate(
        [squared_distances(observed, known), squared_distances(observed, observed)], axis=1
    )
    rows[:, known_count:][np.triu(np.ones((count, count), bool))] = np.inf
    found, places = np.nonzero(rows <= threshold)
    order = np.lexsort((rows[found, places], found))
    expected = np.concatenate([columns, -1 - np.arange(count)])[places[order]]
    candidates = find_candidates(observed, known, columns, threshold)
    assert candidates.columns.tolist() == expected.tolist()
    assert candidates.starts.tolist() == np.searchsorted(found, np.arange(count + 1)).tolist()
    np.testing.assert_array_equal(candidates.distances, rows[found, places][order])
    assert {a.dtype for a in candidates} == {np.dtype(np.int32), np.dtype(np.float32)}
    distinct = np.unique(expected[expected >= 0])
    assert landmarks_among(candidates.columns).tolist() == distinct.tolist()


def test_no_observations_no_candidates():
    nothing = np.empty((0, 128), np.float32)
    candidates = find_candidates(nothing, unit(np.random.default_rng(2), 4), np.arange(4), 0.5)
    assert candidates.starts.tolist() == [0]
    assert len(candidates.columns) == 0


def test_nothing_inside_the_gate_lies_outside_the_field_of_search():
    """Particles, landmarks and noise at random: compare with D itself, one at a time."""
    rng = np.random.default_rng(3)
    particles, landmarks, gate = 40, 60, 11.345
    found = 0
    for _ in range(20):
        poses = rng.normal([[3.0], [-2.0], [rng.uniform(-9, 9)]], 0.1, (3, particles))
        v = rng.uniform(-6, 6, (4, 3))
        noise = np.tile([0.3, 0.05, 0.0, 0.2, 0.0, 0.1], (4, 1))
        box = field_of_search(poses, v, noise, gate, np.zeros(2))
        planes = np.zeros((landmarks, 9, particles), np.float32)
        planes[:, :3] = rng.uniform(-10, 10, (landmarks, 3, 1))
        planes[:, :3] += rng.normal(0, 0.1, (landmarks, 3, particles))
        planes[:, [3, 6, 8]] = rng.uniform(0, 0.3, (landmarks, 3, particles))
        boxes = np.empty((landmarks, 4))
        kernels.bound(planes, np.arange(landmarks), np.sqrt(gate), boxes)
        near = (boxes[:, 0] <= box[1]) & (boxes[:, 1] >= box[0])
        near &= (boxes[:, 2] <= box[3]) & (boxes[:, 3] >= box[2])
        for n, m in np.ndindex(landmarks, particles):
            c, s = np.cos(poses[2, m]), np.sin(poses[2, m])
            turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            nu = v @ turn.T + [poses[0, m], poses[1, m], 0] - planes[n, :3, m]
            S = unpack(planes[n, 3:, m]) + turn @ unpack(noise[0]) @ turn.T
            inside = np.einsum("bi,ij,bj->b", nu, np.linalg.inv(S), nu) <= gate
            found += inside.any()
            assert near[n] or not inside.any()
        assert not near.all()
    assert found > 50
