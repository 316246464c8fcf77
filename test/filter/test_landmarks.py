"""The lazy ancestry of landmark columns against an eager copy of everything."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from multi_robot_slam.filter import kernels
from multi_robot_slam.filter.landmarks import FREE, MOST_IDS, Landmarks
from multi_robot_slam.filter.reserved import reserved

PARTICLES = 6


class Eager:
    """The obvious twin: one dict id -> (9,) per particle, copied at every resampling."""

    def __init__(self):
        self.maps = [{} for _ in range(PARTICLES)]

    def resample(self, ancestors):
        self.maps = [dict(self.maps[a]) for a in ancestors]


def create(lazy, eager, owners, rng):
    """One observation that creates a landmark in the particles marked in `owners`."""
    (column,) = lazy.reserve(1)
    values = rng.normal(size=(9, PARTICLES)).astype(np.float32)
    lazy.planes[column] = values
    lazy.planes[column, 0, ~owners] = kernels.FAR
    landmark = int(lazy.ids[column])
    lazy.commit(np.array([column]), np.array([owners.sum()]), np.ones((1, 128), np.float32))
    for m in np.flatnonzero(owners):
        eager.maps[m][landmark] = values[:, m]


def observe(lazy, eager, column):
    """Gather one column and add 1 to all its numbers where they exist."""
    lazy.bring_up_to_date(np.array([column]))
    exists = lazy.planes[column, 0] < kernels.FAR / 2
    lazy.planes[column][:, exists] += 1
    landmark = int(lazy.ids[column])
    for m in np.flatnonzero(exists):
        eager.maps[m][landmark] = eager.maps[m][landmark] + np.float32(1)


def assert_same(lazy, eager):
    for m in range(PARTICLES):
        columns, values = lazy.of_particle(m)
        assert lazy.ids[columns].tolist() == sorted(eager.maps[m])
        for landmark, value in zip(lazy.ids[columns], values, strict=True):
            np.testing.assert_array_equal(value, eager.maps[m][int(landmark)])


actions = st.lists(st.tuples(st.sampled_from("cor"), st.integers(0, 2**32 - 1)), max_size=60)


@settings(max_examples=150)
@given(actions)
def test_lazy_equals_eager(sequence):
    lazy, eager = Landmarks(PARTICLES, capacity=2), Eager()
    for action, seed in sequence:
        rng = np.random.default_rng(seed)
        alive = lazy.alive()
        if action == "c":
            create(lazy, eager, rng.random(PARTICLES) < 0.6, rng)
        elif action == "o" and len(alive):
            observe(lazy, eager, rng.choice(alive))
        elif action == "r":
            ancestors = np.sort(rng.integers(0, PARTICLES, PARTICLES)).astype(np.int32)
            lazy.resample(ancestors)
            eager.resample(ancestors)
        assert_same(lazy, eager)


@settings(max_examples=50)
@given(actions)
def test_a_column_lives_exactly_as_long_as_some_particle_has_it(sequence):
    lazy, eager = Landmarks(PARTICLES, capacity=2), Eager()
    for action, seed in sequence:
        rng = np.random.default_rng(seed)
        if action == "c":
            create(lazy, eager, rng.random(PARTICLES) < 0.3, rng)
        else:
            ancestors = np.sort(rng.integers(0, PARTICLES, PARTICLES)).astype(np.int32)
            lazy.resample(ancestors)
            eager.resample(ancestors)
        held = set().union(*eager.maps)
        assert set(lazy.ids[lazy.alive()].tolist()) == held


def test_freed_columns_are_used_again():
    lazy = Landmarks(PARTICLES)
    first = lazy.reserve(3)
    lazy.commit(first, np.array([0, PARTICLES, 0]), np.zeros((3, 128), np.float32))
    again = lazy.reserve(2)
    assert set(again) == {first[0], first[2]}
    assert lazy.ids[again].tolist() == [3, 4]
    assert lazy.top == 3


def test_growth_keeps_what_was_there():
    lazy = Landmarks(PARTICLES, capacity=2)
    columns = lazy.reserve(2)
    lazy.planes[columns] = 7
    lazy.bound(columns, 9.0)
    lazy.commit(columns, np.array([PARTICLES] * 2), np.ones((2, 128), np.float32))
    lazy.reserve(50)
    assert (lazy.planes[columns] == 7).all()
    assert (lazy.descriptors[columns] == 1).all()
    assert (lazy.boxes[columns, 0] < 7).all()
    assert (lazy.ids[52:] == FREE).all()


def test_mixture_is_the_moments_of_the_particles_that_have_the_landmark():
    rng = np.random.default_rng(0)
    lazy, eager = Landmarks(PARTICLES, np.float64), Eager()
    owners = np.array([True, True, False, True, True, True])
    create(lazy, eager, owners, rng)
    root = rng.normal(size=(PARTICLES, 3, 3))
    full = root @ root.transpose(0, 2, 1)
    lazy.planes[0, 3:] = full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].T
    ancestors = np.array([0, 0, 2, 3, 5, 5])
    lazy.resample(ancestors)
    weights = rng.dirichlet(np.ones(PARTICLES))
    (mixed,) = lazy.mixture(np.array([0]), weights)
    share = weights * owners[ancestors] / (weights * owners[ancestors]).sum()
    means = lazy.planes[0, :3, ancestors]
    mean = share @ means
    second = sum(
        w * (full[a] + np.outer(mu, mu)) for w, a, mu in zip(share, ancestors, means, strict=True)
    )
    np.testing.assert_allclose(mixed[:3], mean)
    expected = (second - np.outer(mean, mean))[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    np.testing.assert_allclose(mixed[3:], expected)


def test_growth_moves_no_plane():
    particles = 2000
    lazy = Landmarks(particles)
    columns = lazy.reserve(3)
    lazy.planes[columns] = 7
    begin, capacity = lazy.planes.ctypes.data, len(lazy.planes)
    lazy.reserve(3 * capacity)
    assert lazy.planes.ctypes.data == begin
    assert len(lazy.planes) > 3 * capacity
    assert (lazy.planes[columns] == 7).all()


def grown(owners, values, descriptors):
    """A map built by creating one landmark after the other, and the boxes measured."""
    lazy = Landmarks(PARTICLES, capacity=2)
    for own, value, descriptor in zip(owners, values, descriptors, strict=True):
        (column,) = lazy.reserve(1)
        lazy.planes[column] = np.where(own, value, kernels.NO_LANDMARK[:, None])
        lazy.bound(np.array([column]), 9.0)
        lazy.commit(np.array([column]), np.array([own.sum()]), descriptor[None])
    return lazy


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1), actions)
def test_a_map_that_is_handed_whole_arrays_is_the_one_that_grew(seed, sequence):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 6))
    owners = rng.random((count, PARTICLES)) < rng.choice([0.3, 1.0], (count, 1))
    owners[~owners.any(axis=1), 0] = True
    values = rng.normal(size=(count, 9, PARTICLES)).astype(np.float32)
    descriptors = rng.normal(size=(count, 128)).astype(np.float32)
    one = grown(owners, values, descriptors)
    planes = np.where(owners[:, None], values, kernels.NO_LANDMARK[:, None]).astype(np.float32)
    other = Landmarks.holding(np.arange(count), planes, descriptors.copy(), count)
    assert count == 0 or np.shares_memory(other.planes, planes)
    other.bound(np.arange(count), 9.0)
    for action, action_seed in [("", 0), *sequence]:
        both_do(one, other, action, action_seed)
        assert one.alive().tolist() == other.alive().tolist()
        for m in range(PARTICLES):
            (columns, expected), (same, got) = one.of_particle(m), other.of_particle(m)
            assert one.ids[columns].tolist() == other.ids[same].tolist()
            np.testing.assert_array_equal(got, expected)
        alive = one.alive()
        np.testing.assert_array_equal(other.descriptors[alive], one.descriptors[alive])
        np.testing.assert_array_equal(other.boxes[alive], one.boxes[alive])


def both_do(one, other, action, seed):
    """Resample, observe or create on two maps with the same random numbers."""
    for lazy in (one, other):
        rng = np.random.default_rng(seed)
        alive = lazy.alive()
        if action == "r":
            lazy.resample(np.sort(rng.integers(0, PARTICLES, PARTICLES)).astype(np.int32))
        elif action == "o" and len(alive):
            lazy.bring_up_to_date(alive[:2])
            lazy.bound(alive[:2], 9.0)
        elif action == "c":
            (column,) = lazy.reserve(1)
            lazy.planes[column] = rng.normal(size=(9, PARTICLES))
            lazy.bound(np.array([column]), 9.0)
            lazy.commit(np.array([column]), np.array([PARTICLES]), np.ones((1, 128), np.float32))


def test_a_column_that_no_particle_has_is_handed_over_free():
    planes = np.tile(kernels.NO_LANDMARK[:, None], (3, 1, PARTICLES)).astype(np.float32)
    planes[1, 0, 2] = 1
    lazy = Landmarks.holding(np.array([4, 5, 9]), planes, np.ones((3, 128), np.float32), 10)
    assert lazy.ids[lazy.alive()].tolist() == [5]
    lazy.resample(np.full(PARTICLES, 3, np.int32))
    assert not len(lazy.alive())
    assert lazy.ids[lazy.reserve(1)].tolist() == [10]


def test_planes_handed_over_from_reserved_grow_in_place():
    planes = reserved((40, 9, 2000), np.float32)
    planes[:] = 1
    lazy = Landmarks.holding(np.arange(40), planes, np.ones((40, 128), np.float32), 40)
    lazy.reserve(100)
    assert lazy.planes.ctypes.data == planes.ctypes.data
    assert (lazy.planes[:40] == 1).all()


def test_ids_do_not_begin_again():
    full = Landmarks(2)
    full._next_id = MOST_IDS - 3
    full.reserve(3)
    with pytest.raises(OverflowError, match="anew"):
        full.reserve(1)
