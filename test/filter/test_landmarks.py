"""The lazy ancestry of landmark columns against an eager copy of everything."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from multi_robot_slam.filter import kernels
from multi_robot_slam.filter.landmarks import FREE, Landmarks

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
