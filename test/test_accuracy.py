"""The accuracy study: its rows, its table, and what its yardstick is."""

import csv

import numpy as np
import pytest

from multi_robot_slam import accuracy
from multi_robot_slam.accuracy import Job, Row


@pytest.fixture(scope="module")
def rows():
    return accuracy.study(
        1, (20,), 0.5, lambda function, jobs: ((job, function(job)) for job in jobs)
    )


def test_one_row_for_each_run_in_a_fixed_order(rows):
    keys = [(row.proposal, row.robots, row.particles, row.seed) for row in rows]
    assert keys == [(p, k, 20, 0) for p in ("informed", "motion") for k in (1, 2, 3)]


def test_a_run_is_the_same_however_it_is_asked_for(rows):
    again = accuracy.compute(Job(3, 0, (5, 20), 0.5))
    assert next(row for row in again if row.particles == 20 and row.proposal == "motion") == rows[5]


def test_the_yardstick_belongs_to_the_exploration_not_to_the_filter(rows):
    for one, other in zip(rows[:3], rows[3:], strict=True):
        assert one.batch_path_rmse_m == pytest.approx(other.batch_path_rmse_m, rel=1e-3)
        assert one.odometry_path_rmse_m == other.odometry_path_rmse_m
        assert one.batch_path_rmse_m < 0.3 * one.odometry_path_rmse_m


def test_table_and_rows_agree(rows, tmp_path):
    accuracy.write(rows, tmp_path)
    with (tmp_path / "accuracy.csv").open() as file:
        written = list(csv.DictReader(file))
    assert len(written) == len(rows)
    assert float(written[0]["path_rmse_m"]) == pytest.approx(rows[0].path_rmse_m, rel=1e-5)
    table = (tmp_path / "accuracy.md").read_text().splitlines()
    assert len({line.count("|") for line in table}) == 1
    assert len(table) == 2 + len(rows)


def test_cells_are_mean_and_deviation_of_the_ratio_to_the_yardstick():
    values = {"proposal": "motion", "robots": 1, "particles": 10, "ancestors": 2}
    numbers = {name: 1.0 for name in Row.__annotations__ if name not in {*values, "seed"}}
    group = [
        Row(**values, seed=s, **numbers | {"path_rmse_m": r, "batch_path_rmse_m": 0.5})
        for s, r in enumerate((0.5, 1.5))
    ]
    assert "| 2.00 ± 1.00 |" in accuracy.markdown(group)
    assert np.isclose(np.std([1, 3]), 1)
