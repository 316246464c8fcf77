"""The accuracy study: its rows, its table, and what its yardsticks are."""

import csv
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from msg_defs.errors import InputError
from msg_defs.types import Trajectory
from multi_robot_slam.studies import accuracy, accuracy_table
from multi_robot_slam.studies.accuracy import Job, Row

PARTICLES = {"motion": (20,), "informed": (20,)}
SEEDS = range(1)


def here(function, jobs):
    return ((job, function(job)) for job in jobs)


def without_times(rows):
    return [replace(row, step_ms_mean=0.0, step_ms_max=0.0) for row in rows]


@pytest.fixture(scope="module")
def base():
    return accuracy.calibrated()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("accuracy")


@pytest.fixture(scope="module")
def rows(base, folder):
    return accuracy.study(folder, base, SEEDS, PARTICLES, here)


def test_the_seeds_asked_for_are_those_of_the_rows(base, tmp_path):
    def fake(function, jobs):
        for job in jobs:
            yield job, [fake_row(name, job.robots, m, job.seed) for name, m in job.runs]

    rows = accuracy.study(tmp_path, base, range(7, 9), PARTICLES, fake)
    assert {row.seed for row in rows} == {7, 8}
    more = accuracy.study(tmp_path, base, range(8, 10), PARTICLES, fake)
    assert {row.seed for row in more} == {8, 9}
    assert len(accuracy_table.opened(tmp_path / "accuracy.csv").rows) == 3 * len(rows) // 2


def fake_row(name, robots, particles, seed):
    rest = dict.fromkeys(accuracy_table.COLUMNS[4:], 1.0)
    return Row(name, robots, particles, seed, **rest | {"ancestors": 1})


def test_one_row_for_each_run_in_a_fixed_order(rows):
    keys = [(row.filter, row.robots, row.particles, row.seed) for row in rows]
    assert keys == [(p, k, 20, 0) for p in ("informed", "motion") for k in (1, 2, 3)]


def test_a_run_is_the_same_however_it_is_asked_for(rows, base):
    again = accuracy.compute(Job(base, 3, 0, (("motion", 5), ("motion", 20))))
    assert without_times(again[1:]) == without_times(rows[5:])


def test_the_yardstick_belongs_to_the_exploration_not_to_the_filter(rows):
    for one, other in zip(rows[:3], rows[3:], strict=True):
        assert one.batch_path_rmse_m == pytest.approx(other.batch_path_rmse_m, rel=1e-3)
        assert one.odometry_path_rmse_m == other.odometry_path_rmse_m
        assert one.batch_path_rmse_m < 0.3 * one.odometry_path_rmse_m


def test_rejuvenated_particles_come_near_the_optimum_and_keep_their_ancestors(rows, base):
    (row,) = accuracy.compute(Job(base, 3, 0, ((accuracy.REJUVENATED, 20),)))
    assert row.optimum_ratio < 1.5 < rows[2].optimum_ratio
    assert row.ancestors > 3 > rows[2].ancestors


def test_the_resampling_threshold_reaches_the_filters_they_concern():
    base = accuracy.calibrated(0.25)
    assert {own.resample_below for own in base.filters.values()} == {0.25}
    assert base.filters["rejuvenated"].rejuvenation.ancestors_below > 0
    assert base.filters["motion"].rejuvenation.ancestors_below == 0
    assert base.filters["informed"].rejuvenation.ancestors_below == 0


def test_an_interrupted_study_goes_on_where_it_stopped(rows, base, folder, tmp_path):
    def interrupted(function, jobs):
        yield jobs[0], [r for r in rows if r.robots == jobs[0].robots]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        accuracy.study(tmp_path, base, SEEDS, PARTICLES, interrupted)
    with (tmp_path / "accuracy.csv").open("a") as file:
        file.write("informed,2,20")
    computed = []

    def remaining(function, jobs):
        computed.extend(job.robots for job in jobs)
        return here(lambda job: [r for r in rows if r.robots == job.robots], jobs)

    assert len(accuracy.study(tmp_path, base, SEEDS, PARTICLES, remaining)) == len(rows)
    assert computed == [2, 3]
    for name in ("accuracy.csv", "accuracy.md"):
        assert (tmp_path / name).read_text() == (folder / name).read_text()


def test_rows_of_other_settings_are_not_mixed(rows, folder):
    with pytest.raises(InputError, match="other settings"):
        accuracy.study(folder, accuracy.calibrated(0.25), SEEDS, PARTICLES, here)


@pytest.mark.parametrize("text", ["filter,robots\n", "{header}\nmotion,one\n"])
def test_a_table_that_is_none_of_ours_is_refused(text, tmp_path):
    path = tmp_path / "accuracy.csv"
    path.write_text(text.format(header=",".join(accuracy_table.COLUMNS)))
    with pytest.raises(InputError, match=r"accuracy\.csv"):
        accuracy_table.opened(path)


def test_an_unknown_filter_is_refused():
    assert accuracy.filters_of("rejuvenated,motion") == ("rejuvenated", "motion")
    with pytest.raises(InputError, match="'kalman'; there are motion, informed, rejuvenated"):
        accuracy.filters_of("motion,kalman")


def test_table_and_rows_agree(rows, folder):
    with (folder / "accuracy.csv").open() as file:
        written = list(csv.DictReader(file))
    assert len(written) == len(rows)
    assert float(written[0]["path_rmse_m"]) == pytest.approx(rows[0].path_rmse_m, rel=1e-5)
    table = (folder / "accuracy.md").read_text().splitlines()
    assert len({line.count("|") for line in table}) == 1
    assert len(table) == 2 + len(rows)


def test_ratio_to_the_optimum_is_of_root_mean_squares_over_all_robots_at_its_stamps():
    stamps = np.arange(5)

    def moved(distance, stamps):
        return Trajectory(stamps, np.tile([distance, 0.0, 0.0], (len(stamps), 1)))

    robots = {
        name: SimpleNamespace(truth=moved(0, stamps), online=moved(distance, stamps))
        for name, distance in (("one", 3.0), ("two", 4.0))
    }
    robots["one"].online.poses[0] = 100.0
    optimum = {"one": moved(1, stamps[1:3]), "two": moved(-1, stamps[1:3])}
    ratio = accuracy.optimum_ratio(SimpleNamespace(robots=robots), optimum)
    assert ratio == pytest.approx(np.sqrt((9 + 16) / 2))


@pytest.mark.parametrize(("name", "nees"), [("motion", "| 1 |"), ("rejuvenated", "| 7 |")])
def test_cells_are_mean_and_deviation_but_the_nees_of_collapsed_sets_is_the_median(name, nees):
    values = {"filter": name, "robots": 1, "particles": 10}
    numbers = {column: 1.0 for column in accuracy_table.COLUMNS if column not in {*values, "seed"}}
    group = [
        Row(
            **values,
            **numbers | {"seed": s, "path_rmse_m": r, "pose_nees": n, "batch_path_rmse_m": 0.5},
        )
        for s, (r, n) in enumerate(((0.5, 1.0), (1.5, 1.0), (1.0, 19.0)))
    ]
    table = accuracy_table.markdown(group)
    assert f"| 2.00 ± {np.std([1, 3, 2]):.2f} |" in table
    assert nees in table.splitlines()[-1]
