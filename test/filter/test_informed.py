"""The informed proposal: against its literal twin, and against exact Gaussians."""

import literal_algorithm1 as literal
import literal_informed
import numpy as np
import pytest
import worlds

from multi_robot_slam.filter import informed_kernels, rbpf
from multi_robot_slam.filter.association import Candidates
from multi_robot_slam.filter.kernels import Matches, Observed
from multi_robot_slam.models.symmetric import pack, unpack


@pytest.mark.parametrize("seed", [1, 2])
def test_equals_the_literal_twin_draw_for_draw(seed):
    steps = worlds.drive(seed, steps=15, alike=0.3)
    settings = worlds.settings(particles=6, proposal="informed", resample_below=0.7)
    rng = np.random.default_rng(seed)
    state = rbpf.init(worlds.START, settings, np.float64)
    infos = [rbpf.step(state, frames, settings, rng) for frames in steps]

    rng, mount = np.random.default_rng(seed), worlds.MOUNT
    sigmas = tuple(vars(settings.motion).values())[:4]
    place = (mount.forward_m, mount.left_m, mount.up_m)
    model = literal.Model(settings.gate, settings.descriptor_gate, place, sigmas)
    S = [literal.Particle([p.copy() for p in worlds.START]) for _ in range(6)]
    origin = {}
    for t, (frames, info) in enumerate(zip(steps, infos, strict=True)):
        for frame, seen in zip(frames, info.frames, strict=True):
            origin |= {int(n): (t, frame.robot, b) for b, n in enumerate(seen.new_ids)}
            z = frame.observations.positions.astype(float), frame.observations.descriptors
            R = unpack(frame.observations.covariances)
            normals = rng.standard_normal((3, 6))
            expected = literal_informed.fast_slam_2(
                S, frame.robot, z, R, frame.motion, normals, model, t
            )
            assert [[origin[int(n)] for n in column] for column in seen.matches.T] == expected
        if info.ancestors is not None:
            S, chosen = literal.importance_resampling(S, rng.random())
            assert chosen == info.ancestors.tolist()
    assert any(info.ancestors is not None for info in infos)
    for m, particle in enumerate(S):
        np.testing.assert_allclose(state.poses[:, :, m], particle.poses, atol=1e-5)
        _, values = state.landmarks.of_particle(m)
        np.testing.assert_allclose(values[:, :3], [n.mu for n in particle.landmarks], atol=1e-5)
    constant = 1.5 * np.log(2 * np.pi) * sum(len(f.matches) for i in infos for f in i.frames)
    sums = [p.log_weight_sum for p in S]
    np.testing.assert_allclose(state.log_weight_sum - constant, sums, atol=1e-2)


def believe(landmarks, sigma, spread, v, R):
    """One particle at the origin with yaw 0; landmarks (B, 3), sigma (B, 6): belief, D, |S|."""
    count = len(landmarks)
    planes = np.concatenate([landmarks, sigma], axis=1)[:, :, None].copy()
    beliefs = np.empty((9, 1))
    matches = Matches(np.empty((count, 1), np.int32), np.empty((count, 1)), np.empty((count, 1)))
    columns = np.arange(count, dtype=np.int32)
    each = Candidates(np.arange(count + 1, dtype=np.int32), columns, np.zeros(count, np.float32))
    poses = np.array([[1.0], [0.0], [0.0], [0.0]])
    prior = np.empty((6, 1))
    informed_kernels.spread_in_map(poses, spread, prior)
    informed_kernels.associate_and_believe(
        0, 1, planes, each, poses, prior, Observed(v, R), 1e9, False, beliefs, matches
    )
    assert matches.columns[:, 0].tolist() == columns.tolist()
    return beliefs[:, 0], matches.mahalanobis_sq[:, 0], matches.determinants[:, 0]


def test_belief_is_the_exact_posterior_of_a_linear_world():
    """Without doubt about the yaw the world is linear: compare with one dense Gaussian update."""
    rng = np.random.default_rng(0)
    count = 7
    landmarks = rng.normal(0, 3, (count, 3))
    roots = rng.normal(0, 0.3, (2, count, 3, 3))
    full = roots @ roots.swapaxes(-1, -2) + 0.01 * np.eye(3)
    v = landmarks + rng.normal(0, 0.3, (count, 3))
    P = np.array([[0.05, 0.01, 0], [0.01, 0.02, 0], [0, 0, 0]])
    belief, D, S = believe(
        landmarks, pack(full[0]), P[[0, 0, 1, 2], [0, 1, 1, 2]], v, pack(full[1])
    )

    H = np.tile(np.eye(3) * [1, 1, 0], (count, 1))
    noise = np.zeros((3 * count, 3 * count))
    for b in range(count):
        noise[3 * b : 3 * b + 3, 3 * b : 3 * b + 3] = full[0, b] + full[1, b]
    joint = H @ P @ H.T + noise
    nu = (v - landmarks).ravel()
    K = P @ H.T @ np.linalg.inv(joint)
    np.testing.assert_allclose(belief[:3], -K @ nu, atol=1e-12)
    posterior = P - K @ H @ P
    expected = posterior[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    np.testing.assert_allclose(belief[3:], expected, atol=1e-12)
    log_density = nu @ np.linalg.inv(joint) @ nu + np.linalg.slogdet(joint)[1]
    np.testing.assert_allclose(D.sum() + np.log(S).sum(), log_density, rtol=1e-10)


def test_belief_about_the_yaw_is_the_linearised_update():
    v, R = np.array([[4.0, 2.0, 1.0]]), np.array([[1e-4, 0, 0, 1e-4, 0, 1e-4]])
    P = np.diag([1e-4, 1e-4, 1e-4])
    landmark = v + np.array([0.001, -0.002, 0.0005])
    belief, _, _ = believe(landmark, np.zeros((1, 6)), P[[0, 0, 1, 2], [0, 1, 1, 2]], v, R)
    H = np.array([[1.0, 0, -2.0], [0, 1.0, 4.0], [0, 0, 0]])
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + 1e-4 * np.eye(3))
    np.testing.assert_allclose(belief[:3], -K @ (v - landmark)[0], rtol=1e-9, atol=1e-15)


def test_draws_have_the_belief_s_mean_and_covariance():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(3, 3))
    covariance = root @ root.T
    belief = np.concatenate([[1.0, -2.0, 0.5], covariance[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]])
    poses = np.zeros((3, 200_000))
    beliefs = np.repeat(belief[:, None], 200_000, axis=1)
    informed_kernels.draw(poses, beliefs, rng.standard_normal(poses.shape))
    np.testing.assert_allclose(poses.mean(1), belief[:3], atol=0.02)
    np.testing.assert_allclose(np.cov(poses), covariance, atol=0.05)


def test_a_robot_that_cannot_have_moved_stays():
    poses = np.array([[3.0], [2.0], [1.0]])
    informed_kernels.draw(poses, np.zeros((9, 1)), np.ones((3, 1)))
    assert poses[:, 0].tolist() == [3.0, 2.0, 1.0]
