"""Robots that see robots: against the exact Kalman answer, and the pipeline's bookkeeping."""

from dataclasses import replace

import numpy as np
import pytest

from msg_defs.types import CameraMount, ObservationSet, PoseSample, Sightings
from multi_robot_slam.config import EVERY_FRAME, Config
from multi_robot_slam.filter import rbpf, resampling, sightings
from multi_robot_slam.filter.settings import NO_REJUVENATION, FilterSettings
from multi_robot_slam.models.frames import BodySightings, RobotFrame
from multi_robot_slam.models.motion import MotionSettings
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.pipeline.reorder import UNPLACED

PARTICLES, STEPS = 20_000, 6
SIGMA_MOVE, SIGMA_SEE, SIGMA_SIGHT = 0.1, 0.2, 0.2
MOUNT = CameraMount(forward_m=0.0, left_m=0.0, up_m=0.0)
STARTS = np.array([[0.0, 0.0, 0.0], [0.0, 3.0, 0.0], [-2.0, 1.0, 0.0]])
LOOKS = ((0, 1), (1, 0), (0, 2), (2, 1))
"""Who sees whom, each step: loops, and two that see each other."""


def in_camera(body):
    """(n, 3) of the body axes in those of the camera."""
    return np.stack([-body[:, 1], body[:, 2], body[:, 0]], axis=1)


def isotropic(count, sigma):
    return np.tile(np.array([1, 0, 0, 1, 0, 1]) * sigma**2, (count, 1))


def world(seed):
    """Robots that move along x and never turn: what they measure of motion, a landmark, others."""
    rng = np.random.default_rng(seed)
    landmark, count = np.array([6.0, 1.0, 1.0]), len(STARTS)
    places = STARTS[:, :2].copy()
    for t in range(STEPS):
        moved = np.array([1.0, 0.0]) * (t > 0)
        places += moved + rng.normal(0, SIGMA_MOVE, (count, 2)) * (t > 0)
        seen = landmark - np.pad(places, ((0, 0), (0, 1))) + rng.normal(0, SIGMA_SEE, (count, 3))
        looks = np.array([places[j] - places[i] for i, j in LOOKS])
        yield moved, seen, looks + rng.normal(0, SIGMA_SIGHT, looks.shape)


def exact(seed):
    """Kalman filter over the three robots and the landmark: mean and covariance (9,), (9, 9)."""
    mean = np.append(STARTS[:, :2].ravel(), np.zeros(3))
    covariance = np.diag([0.0] * 6 + [1e8] * 3)
    rows, noise = [], []
    for robot in range(3):
        for axis in range(3):
            row = np.zeros(9)
            row[6 + axis] = 1
            if axis < 2:
                row[2 * robot + axis] = -1
            rows.append(row)
            noise.append(SIGMA_SEE**2)
    for i, j in LOOKS:
        for axis in range(2):
            row = np.zeros(9)
            row[2 * j + axis], row[2 * i + axis] = 1, -1
            rows.append(row)
            noise.append(SIGMA_SIGHT**2)
    H, R = np.array(rows), np.diag(noise)
    for t, (moved, seen, looks) in enumerate(world(seed)):
        mean[:6] += np.tile(moved, 3)
        covariance[:6, :6] += SIGMA_MOVE**2 * np.eye(6) * (t > 0)
        S = H @ covariance @ H.T + R
        K = np.linalg.solve(S, H @ covariance).T
        mean = mean + K @ (np.concatenate([seen.ravel(), looks.ravel()]) - H @ mean)
        covariance = covariance - K @ H @ covariance
    return mean, covariance


def frames_of(t, moved, seen, looks):
    descriptor = np.eye(1, 128, dtype=np.float32)
    for robot in range(3):
        mine = [n for n, (i, _) in enumerate(LOOKS) if i == robot]
        others = np.array([LOOKS[n][1] for n in mine], np.uint32)
        body = np.pad(looks[mine], ((0, 0), (0, 1)))
        yield RobotFrame.from_camera(
            robot,
            np.array([*moved, 0.0]),
            0.0,
            ObservationSet("", t, in_camera(seen[[robot]]), isotropic(1, SIGMA_SEE), descriptor),
            MOUNT,
            Sightings("", t, others, in_camera(body), isotropic(len(mine), SIGMA_SIGHT)),
        )


@pytest.mark.parametrize("proposal", ["motion", "informed"])
def test_posterior_is_the_kalman_filter_s(proposal):
    noise = MotionSettings(SIGMA_MOVE, SIGMA_MOVE, 0.0, 0.0)
    settings = FilterSettings(
        particles=PARTICLES,
        gate=1e6,
        rejuvenation=NO_REJUVENATION,
        sighting_gate=1e6,
        proposal=proposal,
        motion=noise,
    )
    rng = np.random.default_rng(3)
    state = rbpf.init(STARTS, settings, np.float64)
    for t, measured in enumerate(world(5)):
        info = rbpf.step(state, list(frames_of(t, *measured)), settings, rng)
    weights = resampling.normalise(state.log_weights)
    state.landmarks.bring_up_to_date(state.landmarks.alive())
    (planes,) = state.landmarks.planes[state.landmarks.alive()]
    places = np.concatenate([state.poses[:, :2].reshape(6, -1), planes[:3]])
    mean, covariance = exact(5)
    estimate = places @ weights
    spread = (places - estimate[:, None]) * weights @ (places - estimate[:, None]).T
    xx, xy, xz, yy, yz, zz = planes[3:] @ weights
    spread[6:, 6:] += [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
    assert info.effective_particles > 100
    error = np.sqrt(np.diag(covariance) / (PARTICLES / 20))
    assert (np.abs(estimate - mean) < 5 * error).all()
    np.testing.assert_allclose(spread, covariance, atol=0.25 * np.diag(covariance).max())


def test_one_sighting_informs_both_as_one_dense_update_would():
    rng = np.random.default_rng(0)
    root = rng.normal(0, 0.1, (2, 3, 3))
    P = np.zeros((6, 6))
    P[:3, :3], P[3:, 3:] = root[0] @ root[0].T, root[1] @ root[1].T
    x = np.array([0.0, 0.0, 0.4, 3.0, 1.0, -2.0])
    s, R = np.array([2.9, -0.3]), np.array([[0.02, 0.005], [0.005, 0.01]])
    packed = np.array([P[:3, :3], P[3:, 3:]])[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    joint = sightings.JointBelief([0, 1], x.reshape(2, 3, 1).copy(), packed[:, :, None])
    worth = joint.see(0, BodySightings(np.array([1]), s[None], R[[0, 0, 1], [0, 1, 1]][None]), 1e9)

    def residual(x):
        c, s_ = np.cos(x[2]), np.sin(x[2])
        return x[3:5] - x[:2] - np.array([[c, -s_], [s_, c]]) @ s

    H = np.stack([(residual(x + h) - residual(x - h)) / 2e-6 for h in 1e-6 * np.eye(6)], axis=1)
    c, s_ = np.cos(x[2]), np.sin(x[2])
    turn = np.array([[c, -s_], [s_, c]])
    S = H @ P @ H.T + turn @ R @ turn.T
    K = P @ H.T @ np.linalg.inv(S)
    r = residual(x)
    np.testing.assert_allclose(joint.mean[:, 0], x - K @ r, atol=1e-8)
    np.testing.assert_allclose(joint.covariance[:, :, 0], P - K @ H @ P, atol=1e-8)
    D = r @ np.linalg.inv(S) @ r
    np.testing.assert_allclose(worth.mahalanobis_sq[0, 0], D, rtol=1e-6)
    np.testing.assert_allclose(worth.log_factor, -0.5 * (D + np.log(np.linalg.det(S))), rtol=1e-6)


def test_a_gross_error_changes_no_belief_and_weighs_as_the_gate():
    means, covariances = np.zeros((2, 3, 4)), np.full((2, 6, 4), [[0.1], [0], [0], [0.1], [0], [0]])
    joint = sightings.JointBelief([0, 1], means.copy(), covariances)
    before = joint.covariance.copy()
    seen = BodySightings(np.array([1]), np.array([[50.0, 0.0]]), np.array([[0.01, 0.0, 0.01]]))
    worth = joint.see(0, seen, 9.0)
    assert (worth.mahalanobis_sq > 9.0).all()
    assert (joint.mean == 0).all()
    assert (joint.covariance == before).all()
    np.testing.assert_allclose(worth.log_factor, -0.5 * (9.0 + 2 * np.log(0.21)))


def test_fixing_a_robot_conditions_the_others():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 6))
    joint = sightings.JointBelief([4, 2], np.zeros((2, 3, 1)), np.zeros((2, 6, 1)))
    joint.mean[:, 0], joint.covariance[:, :, 0] = rng.normal(size=6), root @ root.T
    mean, P = joint.mean[:, 0].copy(), joint.covariance[:, :, 0].copy()
    drawn = rng.normal(size=3)
    joint.fix(4, drawn[:, None])
    gain = P[3:, :3] @ np.linalg.inv(P[:3, :3])
    np.testing.assert_allclose(joint.of(2)[0][:, 0], mean[3:] + gain @ (drawn - mean[:3]))
    expected = (P[3:, 3:] - gain @ P[:3, 3:])[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    np.testing.assert_allclose(joint.of(2)[1][:, 0], expected)


NAMES = ("a", "b")


def pipeline(**changes):
    starts = ((0, 0, 0), (2, 0, 0))
    config = Config(robots=NAMES, start_poses=starts, sightings=True, keyframe=EVERY_FRAME)
    return Pipeline(replace(config, filter=replace(config.filter, particles=20), **changes))


def odometry(robot, stamp, x=0.0):
    return PoseSample(robot, stamp, np.array([x, 0.0, 0.0]))


def empty(robot, stamp):
    return ObservationSet(robot, stamp, np.empty((0, 3)), np.empty((0, 6)), np.empty((0, 128)))


def sees(robot, stamp, other):
    position = np.array([[0.0, 0.0, 2.0]])
    return Sightings(robot, stamp, np.array([other], np.uint32), position, isotropic(1, 0.1))


def nobody(robot, stamp):
    return Sightings(robot, stamp, np.empty(0, np.uint32), np.empty((0, 3)), np.empty((0, 6)))


def test_a_frame_waits_for_its_sightings_whatever_comes_first():
    def steps(order):
        team, done = pipeline(), []
        for stamp in range(10, 60, 10):
            events = [
                odometry("a", stamp),
                odometry("b", stamp),
                empty("a", stamp),
                empty("b", stamp),
                sees("a", stamp, 1),
                nobody("b", stamp),
            ]
            for index in order:
                done += team.handle(events[index])
        return done + team.finish()

    one, other = steps(range(6)), steps([4, 5, 0, 1, 2, 3])
    assert [len(s.frames[0].others) for s in one] == [1] * 5
    for a, b in zip(one, other, strict=True):
        for x, y in zip(a.estimates, b.estimates, strict=True):
            assert x.pose.tobytes() == y.pose.tobytes()


def test_a_robot_that_is_seen_between_its_frames_gets_one():
    team = pipeline()
    for event in [odometry("a", 10), odometry("b", 5), odometry("b", 15, x=0.2)]:
        team.handle(event)
    team.handle(sees("a", 10, 1))
    team.handle(empty("a", 10))
    (step,) = team.finish()
    assert [frame.robot for frame in step.frames] == ["a", "b"]
    assert not team.dropped


def test_a_sighting_of_a_robot_without_odometry_is_counted_and_dropped():
    team = pipeline()
    team.handle(odometry("a", 10))
    team.handle(sees("a", 10, 1))
    team.handle(empty("a", 10))
    (step,) = team.finish()
    assert [frame.robot for frame in step.frames] == ["a"]
    assert len(step.frames[0].others) == 0
    assert team.dropped == {UNPLACED: 1}


@pytest.mark.parametrize("other", [0, 7])
def test_who_sees_itself_or_a_stranger_is_told(other):
    team = pipeline()
    assert team.handle(sees("a", 10, other)) + team.finish() == []
    assert team.dropped == {"sighting of nobody": 1}


def test_sightings_that_never_come_hold_nothing_for_longer_than_the_window():
    team = pipeline(reorder_window_s=1.0)
    done = []
    for second in range(1, 6):
        for robot in NAMES:
            done += team.handle(odometry(robot, second * 10**9))
            done += team.handle(empty(robot, second * 10**9))
    assert [step.stamp_ns // 10**9 for step in done] == [1, 2, 3, 4]
