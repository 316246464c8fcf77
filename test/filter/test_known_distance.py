"""Frames whose covariances are those at the landmarks that are known."""

import numpy as np
import pytest
import worlds

from multi_robot_slam.filter import known_distance, matching, rbpf
from multi_robot_slam.filter.kernels import FAR
from multi_robot_slam.models.ranging import at_landmarks


def literal_means(planes, columns):
    result = []
    for column in columns:
        has = planes[column, 0] < FAR / 2
        result.append(planes[column, :3, has].astype(float).mean(axis=0))
    return np.array(result).reshape(-1, 3)


def literal_offsets(candidates, touched, means, poses, frame):
    """From each observation to that of its candidates that is nearest to the line of sight."""
    x, y, yaw = poses.mean(axis=1)
    cos, sin = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    result = np.full(frame.positions.shape, np.nan)
    for b, (v, ray) in enumerate(zip(frame.positions, frame.ranging.rays, strict=True)):
        own = candidates.columns[candidates.starts[b] : candidates.starts[b + 1]]
        offsets = [turn @ (means[list(touched).index(c)] - [x, y, 0]) - v for c in own if c >= 0]
        if offsets:
            unit = ray / np.linalg.norm(ray)
            result[b] = min(offsets, key=lambda o: np.linalg.norm(o - unit * (o @ unit)))
    return result


@pytest.fixture
def matched(monkeypatch):
    """Frames as given and as the filter used them, with what it knew."""
    calls = []
    real = known_distance.at_known

    def noted(frame, landmarks, candidates, touched, poses):
        used = real(frame, landmarks, candidates, touched, poses)
        calls.append((frame, used, landmarks.planes.copy(), candidates, touched, poses.copy()))
        return used

    monkeypatch.setattr(matching, "at_known", noted)
    return calls


@pytest.mark.parametrize("proposal", ["motion", "informed"])
def test_frames_are_what_the_slow_way_makes_of_them(matched, proposal):
    own = worlds.settings(proposal=proposal, noise_at="landmark", gate=1e3)
    state, rng = rbpf.init(worlds.START, own), np.random.default_rng(0)
    for frames in worlds.drive(seed=2, steps=12, alike=0.5):
        rbpf.step(state, frames, own, rng)
    changed = 0
    for frame, used, planes, candidates, touched, poses in matched:
        if not len(touched):
            assert used is frame
            continue
        means = literal_means(planes, touched)
        np.testing.assert_allclose(known_distance.mean_places(planes, touched), means, rtol=1e-6)
        offsets = literal_offsets(candidates, touched, means, poses, frame)
        expected = at_landmarks(frame.covariances, *frame.ranging, offsets)
        np.testing.assert_allclose(used.covariances, expected, rtol=1e-5, atol=1e-12)
        changed += (used.covariances != frame.covariances).any()
    assert changed > 10


def test_by_default_covariances_are_as_they_came(matched):
    own = worlds.settings()
    state, rng = rbpf.init(worlds.START, own), np.random.default_rng(0)
    for frames in worlds.drive(seed=2, steps=3):
        rbpf.step(state, frames, own, rng)
    assert not matched
