"""The study of real robots, on a made-up recording, and its figures."""

import csv

import mrclam_recording
import numpy as np
import pytest

from msg_defs.types import LandmarkMap
from multi_robot_slam.studies import real_robots


def execute(function, jobs):
    return ((job, function(job)) for job in jobs)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    mrclam_recording.write(folder)
    return folder


@pytest.fixture(scope="module")
def rows(original, tmp_path_factory):
    return real_robots.study(original, tmp_path_factory.mktemp("study"), 2, 30, execute)


def test_a_row_for_each_robot_and_the_team_of_every_run(rows):
    together = [(r.setup, r.filter, r.robot, r.seed) for r in rows]
    robots = ("robot_1", "robot_2")
    wanted = [
        (setup, name, robot, seed)
        for setup in real_robots.SETUPS
        for name in real_robots.FILTERS
        for robot in (*robots, *(("team",) if setup != real_robots.ALONE else ()))
        for seed in range(2)
    ]
    assert together == wanted


def test_with_exact_odometry_everything_is_found(rows):
    for row in rows:
        assert row.odometry_path_rmse_m < 1e-3
        assert row.online_path_rmse_m < 0.5
        assert row.refined_path_rmse_m < 0.05
        assert (row.rejected, row.ghosts) == (0, 0)
        is_yardstick = row.seed == 0 and row.filter == "rejuvenated"
        assert (row.batch_path_rmse_m is not None) == is_yardstick


def test_table_and_rows_agree(rows, tmp_path):
    real_robots.write(rows, tmp_path)
    with (tmp_path / "real.csv").open() as file:
        written = list(csv.DictReader(file))
    assert len(written) == len(rows)
    assert float(written[3]["path_rmse_m"]) == pytest.approx(rows[3].path_rmse_m, rel=1e-5)
    table = (tmp_path / "real.md").read_text().splitlines()
    assert len({line.count("|") for line in table}) == 1
    assert len(table) == 2 + len(rows) / 2
    pair = [row.online_path_rmse_m for row in rows[:2]]
    assert f"| {np.mean(pair):.3f} ± {np.std(pair):.3f} |" in table[2]


def landmark_map(positions, identities, observations):
    count = len(positions)
    return LandmarkMap(
        ids=np.arange(count, dtype=np.uint32),
        positions=np.array(positions, np.float32),
        covariances=np.zeros((count, 6), np.float32),
        observations=np.array(observations, np.uint32),
        robots=np.zeros(count, np.uint32),
        descriptors=np.eye(128, dtype=np.float32)[identities],
    )


def test_the_most_observed_landmark_of_an_identity_counts():
    true = landmark_map([[0, 0, 0], [5, 0, 0], [0, 5, 0]], [0, 1, 2], [0, 0, 0])
    found = landmark_map([[9, 9, 0], [1, 0, 0], [5, 1, 0]], [0, 0, 1], [1, 8, 2])
    np.testing.assert_allclose(real_robots.landmark_errors(found, true), [[1, 0], [0, 1]])


def test_alignment_removes_what_a_turn_and_a_shift_explain():
    places = np.random.default_rng(0).uniform(-5, 5, (6, 3))
    turn = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])
    true = landmark_map(places, range(6), [0] * 6)
    found = landmark_map(places @ turn.T + [1, 2, 0], range(6), [1] * 6)
    assert np.abs(real_robots.landmark_errors(found, true)).max() > 1
    aligned = real_robots.landmark_errors(found, true, is_aligned=True)
    np.testing.assert_allclose(aligned, 0, atol=1e-5)
