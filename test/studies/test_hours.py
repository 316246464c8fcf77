"""The study of hours: what its rows say, its summary, and that it goes on where it stopped."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from msg_defs.errors import InputError
from msg_defs.types import Estimate, StepRecord
from multi_robot_slam.studies import accuracy, hours, hours_table
from multi_robot_slam.studies.hours import Job, Plan
from multi_robot_slam.studies.live_team import Taken
from sim_world.simulator import Simulation

PLAN = Plan(robots=2, particles=40, seconds=20.0, optimum_s=10.0)


def here(function, jobs):
    return ((job, function(job)) for job in jobs)


@pytest.fixture(scope="module")
def base():
    return accuracy.calibrated()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("hours")


@pytest.fixture(scope="module")
def rows(base, folder):
    return hours.study(folder, base, PLAN, range(1), here)


def fake(part, **values):
    usual = dict.fromkeys(hours_table.COLUMNS, 1.0)
    times = {"from_s": 60.0 * part, "to_s": 60.0 * part + 60, "nees_mean": 3.0, "nees_median": 2.4}
    where = {"robots": 3, "particles": 500, "seed": 0, "part": part}
    counts = dict.fromkeys(("steps", "rejuvenations", "landmarks", "settled", "dropped"), 1)
    return hours_table.Row(**usual | times | counts | where | values)


def test_rows_are_the_tenths_of_a_run_one_after_the_other(rows):
    assert [row.part for row in rows] == list(range(10))
    assert [row.to_s for row in rows] == [2.0 * (part + 1) for part in range(10)]
    assert [row.from_s for row in rows[1:]] == [row.to_s for row in rows[:-1]]


def test_rows_hold_what_a_run_is_judged_by(rows):
    assert all(row.steps > 0 and row.step_ms_mean > 0 for row in rows)
    assert sum(row.rejuvenations for row in rows) > 0
    assert all(0 < row.position_rmse_m < 0.3 and 0 < row.heading_rmse_rad < 0.1 for row in rows)
    assert all(row.all_position_rmse_m != row.position_rmse_m for row in rows)
    assert rows[-1].landmarks > rows[0].landmarks > 10
    assert all(50 < row.memory_mb < 5000 for row in rows)
    assert {row.dropped for row in rows} == {0}
    nees = [row.nees_mean for row in rows]
    assert 0.2 < np.mean(nees) < 15
    assert all(row.step_ms_mean * row.steps <= 1e3 * row.cpu_s_per_s * 2.0 + 1e-6 for row in rows)


def test_the_optimum_is_there_as_far_as_it_was_asked_for_and_hard_to_beat(rows):
    known = [row for row in rows if row.optimum_m is not None]
    assert [row.part for row in known] == [0, 1, 2, 3, 4]
    published, optimum = (
        np.sqrt(np.mean(np.square([getattr(row, name) for row in known])))
        for name in ("published_m", "optimum_m")
    )
    assert 0 < optimum < 1.2 * published


def test_rows_that_are_there_are_not_computed_again(base, folder, rows, capsys):
    def never(function, jobs):
        raise AssertionError(jobs)

    again = hours.study(folder, base, PLAN, range(1), never)
    assert [row.part for row in again] == [row.part for row in rows]
    assert again[3].position_rmse_m == pytest.approx(rows[3].position_rmse_m, rel=1e-5)
    assert (folder / "hours.md").read_text() == hours_table.markdown(again)
    with pytest.raises(InputError, match="other settings"):
        hours.study(folder, base, replace(PLAN, seconds=30.0), range(1), never)


def test_the_optimum_of_hours_is_refused(base, tmp_path):
    with pytest.raises(InputError, match="30 at most"):
        hours.study(tmp_path, base, replace(PLAN, optimum_s=1801.0), range(1), here)


@pytest.mark.parametrize(
    ("seconds", "parts"), [(60, 10), (6000, 10), (6001, 20), (4 * 3600, 30), (30 * 60, 10)]
)
def test_a_part_is_a_share_of_a_tenth_and_ten_minutes_at_most(seconds, parts):
    assert hours.parts_of(seconds) == parts


def test_errors_are_against_the_truth_of_their_stamp(base):
    simulation = Simulation(replace(base.scenario, robots=1), 0)
    judge = hours._Judge()
    moments = simulation.steps()
    poses = []
    for _ in range(5):
        instant = next(moments)
        judge.learn(instant)
        poses.append(instant[0].truth)
    off, covariance = np.array([0.3, -0.4, 2 * np.pi + 0.1]), np.diag([0.09, 0.16, 0.01])
    at = Estimate("robot_1", poses[1].stamp_ns, poses[1].pose + off, covariance)
    start = Estimate("robot_1", poses[0].stamp_ns, poses[0].pose, np.zeros((3, 3)))
    step = StepRecord(at.stamp_ns, 1, (), (start, at), 1.0, False, 1.0, rejuvenated=5.0)
    ahead = Estimate("robot_1", poses[4].stamp_ns, poses[4].pose + off / 2, covariance)
    judge.hear(Taken([step], ahead))
    errors = judge.taken()
    assert errors.position(errors.at_steps) == pytest.approx(0.5 / np.sqrt(2))
    assert errors.heading(errors.at_steps) == pytest.approx(0.1 / np.sqrt(2))
    assert len(errors.everywhere) == 3
    assert errors.nees == pytest.approx([3.0])  # the start claims certainty
    assert errors.rejuvenations == 1
    assert len(judge.taken().at_steps) == 0


def test_old_truth_is_forgotten_and_what_may_still_come_is_not(base):
    simulation = Simulation(replace(base.scenario, robots=3, movements=900), 0)
    judge = hours._Judge()
    for instant in simulation.steps():
        judge.learn(instant)
    assert len(judge._truth) == 3 * hours.KNOWN
    assert ("robot_3", instant[2].truth.stamp_ns) in judge._truth


@pytest.mark.parametrize("runs", [1, 10])
def test_bounds_hold_the_mean_of_honest_runs(runs):
    low, high = hours_table.bounds(runs)
    inside = chi2.cdf([low * runs, high * runs], 3 * runs)
    assert inside == pytest.approx([0.025, 0.975])


def test_the_summary_compares_the_last_tenth_with_the_second():
    grown = [fake(p, step_ms_mean=4.0 if p in (2, 3) else 5.0, memory_mb=300.0) for p in range(20)]
    text = hours_table.markdown(grown)
    assert "| step time, last tenth over the second | 1.25 | <= 1.1 | **no** |" in text
    assert "| memory, last tenth over the second | 1.00 | <= 1.1 | yes |" in text
    assert "| most memory [MB] | 300 | <= 500 | yes |" in text
    assert "| parts with their mean NEES inside | 20 of 20 | all | yes |" in text


def test_the_summary_pools_seeds():
    rows = [fake(p, seed=s, position_rmse_m=3.0 + s) for p in range(10) for s in range(2)]
    rows[0] = replace(rows[0], nees_mean=40.0, published_m=3.0, optimum_m=2.0)
    rows[1] = replace(rows[1], published_m=1.0, optimum_m=1.0)
    others = [replace(row, published_m=None, optimum_m=None) for row in rows[2:]]
    text = hours_table.markdown([*rows[:2], *others])
    first = text.splitlines()[2]
    assert first.startswith(f"| 0 .. 1 | {np.sqrt((9 + 16) / 2):.4f} | 1.00000 | 1.0000 | 21.50 |")
    assert "| parts with their mean NEES inside | 9 of 10 | all | **no** |" in text
    ratio = np.sqrt((9 + 1) / (4 + 1))
    assert (
        f"published over the filtering optimum, 2 instants | {ratio:.3f} | <= 1.1 | **no**" in text
    )


def test_command_hands_over_what_it_was_told(command, monkeypatch, tmp_path):
    asked = []

    def study(out, base, plan, seeds, execute):
        asked.append((out, plan, list(seeds)))
        return [fake(part) for part in range(10)]

    monkeypatch.setattr(hours, "study", study)
    options = ("--hours", 0.5, "--robots", 10, "--seeds", 2, "--first-seed", 5, "--optimum", 30)
    code, out, _ = command("study", "hours", *options, "--out", tmp_path)
    assert code == 0
    assert asked == [(tmp_path, Plan(10, 500, 1800.0, 1800.0), [5, 6])]
    assert "| step time, last tenth over the second |" in out


def test_a_run_is_the_same_twice(base, rows):
    again = hours.compute(Job(base, PLAN, 0))
    assert [r.position_rmse_m for r in again] == pytest.approx(
        [r.position_rmse_m for r in rows], rel=1e-12
    )


def test_nothing_to_average_is_nan_and_no_warning():
    assert np.isnan(hours._average(np.mean, np.empty(0)))
    assert hours._average(np.median, np.array([1.0, 2.0, 9.0])) == 2.0
