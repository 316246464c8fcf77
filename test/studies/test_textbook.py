"""The benchmark's textbook FastSLAM does what Algorithm 1 says."""

import literal_algorithm1 as literal
import numpy as np
import pytest
import worlds

from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.studies import textbook

PARTICLES = 4


@pytest.fixture(scope="module", params=[1, 2])
def both(request):
    """Particles of both, and what they matched, after the same frames with the same draws."""
    settings, mount = worlds.settings(PARTICLES), worlds.MOUNT
    model = literal.Model(
        settings.gate,
        settings.descriptor_gate,
        (mount.forward_m, mount.left_m, mount.up_m),
        tuple(vars(settings.motion).values())[:4],
    )
    S = [literal.Particle([p.copy() for p in worlds.START]) for _ in range(PARTICLES)]
    particles = [textbook.Particle([p.copy() for p in worlds.START]) for _ in range(PARTICLES)]
    rng = np.random.default_rng(request.param)
    choices, indices = [], []
    for t, frames in enumerate(worlds.drive(request.param, steps=12, alike=0.3)):
        for frame in frames:
            seen, normals = frame.observations, rng.standard_normal((3, PARTICLES))
            z = seen.positions.astype(float), seen.descriptors.astype(float)
            R = unpack(seen.covariances)
            choices.append(
                literal.fast_slam_mr(S, frame.robot, z, R, frame.motion, normals, model, t)
            )
            indices.append(textbook.update_particles(particles, frame, settings, normals))
    return S, particles, choices, indices


def test_matches_are_those_of_algorithm_1(both):
    S, _, choices, indices = both
    new = 0
    for choice, index in zip(choices, indices, strict=True):
        for particle, origins, numbers in zip(S, choice, index, strict=True):
            assert [particle.landmarks[n].origin for n in numbers] == [c for c, _, _ in origins]
            new += sum(np.isnan(D) for _, D, _ in origins)
    assert 0 < new < 0.9 * sum(len(row) for choice in choices for row in choice)


def test_particles_are_those_of_algorithm_1(both):
    S, particles, _, _ = both
    for one, other in zip(S, particles, strict=True):
        np.testing.assert_allclose(other.poses, one.poses, rtol=0, atol=1e-9)
        np.testing.assert_allclose(other.log_weight, one.log_weight, rtol=0, atol=1e-4)
        assert len(other.landmarks) == len(one.landmarks)
        for a, b in zip(one.landmarks, other.landmarks, strict=True):
            np.testing.assert_allclose(b.mean, a.mu, rtol=0, atol=1e-6)
            np.testing.assert_allclose(b.covariance, a.sigma, rtol=1e-5, atol=1e-9)
            np.testing.assert_allclose(b.descriptor, a.d, rtol=0, atol=1e-7)
