"""The study of real robots, on a made-up recording, and its figures."""

import csv

import mrclam_recording
import numpy as np
import pytest

from msg_defs.errors import InputError
from multi_robot_slam import runs
from multi_robot_slam.config import Config
from multi_robot_slam.studies import real_robots, real_table


def execute(function, jobs):
    return ((job, function(job)) for job in jobs)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    mrclam_recording.write(folder)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("study")


@pytest.fixture(scope="module")
def rows(original, folder):
    return real_robots.study(original, folder, range(2), 30, execute)


def test_a_row_for_each_robot_and_the_team_of_every_run(rows):
    together = [(r.setup, r.filter, r.robot, r.seed) for r in rows]
    robots = ("robot_1", "robot_2")
    wanted = [
        (setup, name, robot, seed)
        for setup in real_table.SETUPS
        for name in real_table.FILTERS
        for robot in (*robots, *(("team",) if setup != real_table.ALONE else ()))
        for seed in range(2)
    ]
    assert together == wanted


def test_with_exact_odometry_everything_is_found(rows):
    for row in rows:
        assert row.odometry_path_rmse_m < 1e-3
        assert row.online_path_rmse_m < 0.5
        assert row.refined_path_rmse_m < 0.05
        assert (row.rejected, row.duplicates) == (0, 0)
        is_yardstick = row.seed == 0 and row.filter == "rejuvenated"
        assert (row.batch_path_rmse_m is not None) == is_yardstick


def test_table_and_rows_agree(rows, folder):
    with (folder / "real.csv").open() as file:
        written = list(csv.DictReader(file))
    assert len(written) == len(rows)
    assert float(written[3]["path_rmse_m"]) == pytest.approx(rows[3].path_rmse_m, rel=1e-5)
    table = (folder / "real.md").read_text().splitlines()
    assert len({line.count("|") for line in table}) == 1
    assert len(table) == 2 + len(rows) / 2
    pair = [row.online_path_rmse_m for row in rows[:2]]
    assert f"| {np.mean(pair):.3f} ± {np.std(pair):.3f} |" in table[2]


def test_seeds_are_counted_from_the_first(tmp_path):
    config = Config(robots=("a", "b"), start_poses=((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
    jobs = real_robots.plan(tmp_path, config, range(7, 9), particles=3)
    assert {job.config.seed for job in jobs} == {7, 8}
    first = {job.config.seed for job in jobs if job.with_yardstick}
    assert first == {7}


def test_the_studys_rows_are_of_its_seeds(original, tmp_path):
    seeds = []

    def only_note(function, jobs):
        seeds.extend(job.config.seed for job in jobs)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        real_robots.study(original, tmp_path, range(5, 7), 30, only_note)
    assert set(seeds) == {5, 6}


def test_an_interrupted_study_goes_on_where_it_stopped(original, rows, folder, tmp_path):
    def known(job):
        return [row for row in rows if real_table.key_of(row) in job.keys]

    def interrupted(function, jobs):
        yield jobs[3], known(jobs[3])
        raise KeyboardInterrupt

    def remaining(function, jobs):
        left.extend(jobs)
        return ((job, known(job)) for job in jobs)

    left = []
    with pytest.raises(KeyboardInterrupt):
        real_robots.study(original, tmp_path, range(2), 30, interrupted)
    bag = (tmp_path / "bag" / "metadata.yaml").stat().st_mtime_ns
    again = real_robots.study(original, tmp_path, range(2), 30, remaining)
    assert len(left) == 2 * 3 * 4 - 1
    assert [real_table.key_of(row) for row in again] == [real_table.key_of(row) for row in rows]
    assert (tmp_path / "bag" / "metadata.yaml").stat().st_mtime_ns == bag
    for name in ("real.csv", "real.md"):
        assert (tmp_path / name).read_text() == (folder / name).read_text()


def test_a_folder_that_holds_no_recording_leaves_the_study_to_another(original, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(InputError, match="Barcodes"):
        real_robots.study(tmp_path / "nowhere", out, range(1), 30, execute)
    assert not out.exists()

    def end(function, jobs):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        real_robots.study(original, out, range(1), 30, end)
    assert (out / "bag").exists()


def test_rows_of_another_recording_are_not_mixed(original, rows, folder, tmp_path):
    with pytest.raises(InputError, match="other settings"):
        real_robots.study(tmp_path, folder, range(2), 30, execute)


def test_each_robot_alone_keeps_its_own_camera(tmp_path):
    mounts = ((0.1, 0, 0, 0, 0, 0), (0.2, 0, 0, 0, 0, 0))
    starts = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    config = Config(robots=("a", "b"), start_poses=starts, mounts=mounts)
    jobs = real_robots.plan(tmp_path, config, range(1), particles=3)
    own = {job.config.robots: job.config.mount_of(0).forward_m for job in jobs}
    assert (own["a",], own["b",]) == (0.1, 0.2)


def test_the_maps_error_is_the_one_that_every_run_has(original, tmp_path):
    """One word, one figure: the study's and that of the run it comes from."""
    from multi_robot_slam.datasets import bag, mrclam
    from multi_robot_slam.pipeline import offline

    bag.write(mrclam.read(original), tmp_path / "bag", real_robots.RATE_HZ)
    config = offline.recorded_config(tmp_path / "bag")
    (job, *_) = real_robots.plan(tmp_path / "bag", config, range(1), particles=20)
    run = offline.estimate(job.bag, job.config, warn=pytest.fail, refine=True)
    result = runs.evaluate(run)
    row = real_robots.compute(job)[0]
    assert row.landmark_rmse_m == result["map_rmse_m"]
    assert row.landmark_aligned_rmse_m == result["map_aligned_rmse_m"]
    assert row.refined_landmark_rmse_m == result["refined_map_rmse_m"]
