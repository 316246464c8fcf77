"""Laws of absolute, aligned and relative errors; evo judges the written files alike."""

import numpy as np
import pytest
from evo.core import metrics, sync
from evo.tools import file_interface
from hypothesis import given
from hypothesis import strategies as st

from msg_defs.types import Trajectory
from multi_robot_slam import runs
from multi_robot_slam.runs.evaluation import evaluate
from multi_robot_slam.runs.trajectory_errors import (
    aligned,
    alignment,
    covers,
    pose_errors,
    relative_errors,
    rmse,
    rotation,
)
from test.helpers import fake_run

SEEDS = st.integers(0, 2**32 - 1)


def wandering(seed: int, poses: int = 300, step_m: float = 0.2) -> Trajectory:
    """A path of uneven steps and turns."""
    rng = np.random.default_rng(seed)
    yaw = np.cumsum(rng.normal(0, 0.2, poses))
    lengths = rng.uniform(0, 2 * step_m, poses)
    places = np.cumsum(lengths[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=0)
    stamps = 1_700_000_000_000_000_000 + np.cumsum(rng.integers(50, 150, poses)) * 1_000_000
    return Trajectory(stamps, np.column_stack([places, (yaw + np.pi) % (2 * np.pi) - np.pi]))


def disturbed(path: Trajectory, seed: int, sigma: float = 0.1) -> Trajectory:
    noise = np.random.default_rng(seed).normal(0, sigma, path.poses.shape)
    return Trajectory(path.stamps_ns, path.poses + noise)


def matrices(poses: np.ndarray) -> np.ndarray:
    """(n, 3) -> (n, 3, 3) homogeneous."""
    result = np.tile(np.eye(3), (len(poses), 1, 1))
    for matrix, (x, y, yaw) in zip(result, poses, strict=True):
        matrix[:2, :2] = rotation(yaw)
        matrix[:2, 2] = x, y
    return result


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    """A run with truth at another rate and with a gap: its figures and its folder."""
    folder = tmp_path_factory.mktemp("judged")
    run = fake_run(robots=2)
    robots = {}
    for seed, (name, robot) in enumerate(run.robots.items()):
        truth = wandering(seed, poses=3000, step_m=0.02)
        keep = np.r_[0:1000, 1100:3000]
        path = disturbed(Trajectory(truth.stamps_ns[5::10] + 7, truth.poses[5::10]), seed)
        gapped = Trajectory(truth.stamps_ns[keep], truth.poses[keep])
        changes = {"path": path, "truth": gapped, "odometry": path, "online": path}
        robots[name] = robot.__class__(**{**vars(robot), **changes})
    run = run.__class__(**{**vars(run), "robots": robots, "steps": [], "observation_truth": {}})
    figures = evaluate(run)
    runs.write(run, figures, folder)
    return figures, folder


@pytest.mark.parametrize("robot", ["robot_1", "robot_2"])
def test_evo_gives_the_same_figures_of_the_written_files(judged, robot):
    figures, folder = judged
    own = figures["robots"][robot]
    files = (folder / f"{kind}_{robot}.tum" for kind in ("truth", "trajectory"))
    pair = sync.associate_trajectories(*map(file_interface.read_tum_trajectory_file, files))
    assert 250 < pair[0].num_poses < 300
    degrees = np.deg2rad(evo(metrics.APE(metrics.PoseRelation.rotation_angle_deg), pair))
    assert own["heading_rmse_rad"] == pytest.approx(degrees, abs=1e-6)
    place = metrics.PoseRelation.translation_part
    assert own["path_rmse_m"] == pytest.approx(evo(metrics.APE(place), pair), abs=1e-6)
    for distance in (1, 10):
        relation = metrics.PoseRelation.rotation_angle_rad
        of_place = metrics.RPE(place, distance, metrics.Unit.meters)
        of_heading = metrics.RPE(relation, distance, metrics.Unit.meters)
        assert own[f"rte_{distance}m_rmse_m"] == pytest.approx(evo(of_place, pair), abs=1e-6)
        assert own[f"rte_{distance}m_rmse_rad"] == pytest.approx(evo(of_heading, pair), abs=1e-6)
    pair[1].align(pair[0])
    assert own["path_aligned_rmse_m"] == pytest.approx(evo(metrics.APE(place), pair), abs=1e-6)


def evo(metric, pair) -> float:
    metric.process_data(pair)
    return metric.get_statistic(metrics.StatisticsType.rmse)


@given(SEEDS, st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.1, 3.1))
def test_alignment_finds_the_motion_between_two_frames(seed, x, y, angle):
    points = wandering(seed, 20).poses[:, :2]
    found, shift = alignment(points, points @ rotation(angle).T + (x, y))
    assert found == pytest.approx(angle, abs=1e-6)
    np.testing.assert_allclose(shift, (x, y), atol=1e-5)


@given(SEEDS)
def test_no_motion_aligns_better(seed):
    truth = wandering(seed, 30)
    rng = np.random.default_rng(seed)
    errors = pose_errors(disturbed(truth, seed), truth)
    best = rmse(aligned([errors])[0].errors[:, :2])
    estimate = (errors.truth + errors.errors)[:, :2]
    angle, shift = alignment(estimate, errors.truth[:, :2])
    for _ in range(5):
        other = estimate @ rotation(angle + rng.normal(0, 0.01)).T + shift + rng.normal(0, 0.01, 2)
        assert best <= rmse(other - errors.truth[:, :2])


def test_a_robot_that_stood_still_is_aligned_by_a_shift():
    still = Trajectory(np.arange(5), np.tile([1.0, 2.0, 0.5], (5, 1)))
    elsewhere = Trajectory(np.arange(5), still.poses + np.array([3, 4, 0]))
    (left,) = aligned([pose_errors(elsewhere, still)])
    np.testing.assert_allclose(left.errors, 0, atol=1e-12)


@given(SEEDS, st.sampled_from([0.5, 1.0, 10.0]))
def test_relative_errors_are_those_of_motions_as_matrices(seed, distance):
    truth = wandering(seed, 60)
    path = pose_errors(disturbed(truth, seed), truth)
    estimate = path.truth + path.errors
    true_poses, poses = matrices(path.truth), matrices(estimate)
    expected, start, travelled = [], 0, 0.0
    for row in range(1, len(estimate)):
        travelled += np.linalg.norm(estimate[row, :2] - estimate[row - 1, :2])
        if travelled >= distance:
            true_motion = np.linalg.solve(true_poses[start], true_poses[row])
            motion = np.linalg.solve(poses[start], poses[row])
            error = np.linalg.solve(true_motion, motion)
            expected.append([*error[:2, 2], np.arctan2(error[1, 0], error[0, 0])])
            start, travelled = row, 0.0
    found = relative_errors(path, distance)
    np.testing.assert_allclose(found, np.reshape(expected, (-1, 3)), atol=1e-9)


@given(SEEDS)
def test_relative_errors_do_not_change_when_aligned(seed):
    truth = wandering(seed, 60)
    path = pose_errors(disturbed(truth, seed), truth)
    (moved,) = aligned([path])
    np.testing.assert_allclose(relative_errors(moved, 1.0), relative_errors(path, 1.0), atol=1e-9)


def test_truth_is_known_at_its_samples_and_between_them_but_not_in_a_gap():
    truth = Trajectory(np.r_[0:100:10, 200:300:10], np.zeros((20, 3)))
    stamps = np.array([-1, 0, 5, 90, 91, 199, 200, 255, 290, 291])
    known = [False, True, True, True, False, False, True, True, True, False]
    assert covers(truth, stamps).tolist() == known
    one = Trajectory(np.array([5]), np.zeros((1, 3)))
    assert covers(one, np.array([4, 5, 6])).tolist() == [False, True, False]
    assert not covers(Trajectory(np.empty(0, np.int64), np.empty((0, 3))), stamps).any()


def test_poses_in_a_gap_of_the_truth_do_not_count():
    truth = wandering(3)
    keep = np.r_[0:100, 150:300]
    gapped = Trajectory(truth.stamps_ns[keep], truth.poses[keep])
    far = truth.poses.copy()
    far[100:150] += 1000
    errors = pose_errors(Trajectory(truth.stamps_ns, far), gapped)
    np.testing.assert_array_equal(errors.stamps_ns, gapped.stamps_ns)
    np.testing.assert_allclose(errors.errors, 0, atol=1e-9)
