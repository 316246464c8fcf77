"""The grids of the paper's experiments, their runs, and the table these leave."""

import dataclasses
from collections import Counter

import numpy as np
import pytest
import small_experiment
from hypothesis import given
from hypothesis import strategies as st

from msg_defs.errors import InputError
from multi_robot_slam.studies import experiment_grid, experiment_table, experiments, exploration
from multi_robot_slam.studies.experiment_grid import FIGURES, Grid
from multi_robot_slam.studies.experiment_table import RESULTS, Trial

FULL = experiment_grid.plan(FIGURES, Grid(), range(20), experiment_grid.paper())


def of_figure(figure):
    return [trial for name, trial in FULL if name == figure]


def counted(log):
    """A serial execution that notes every trial it computes."""

    def execute(function, jobs):
        for job in jobs:
            log.extend(job.trials)
            yield job, function(job)

    return execute


def fake_results(job):
    """Numbers that depend on the trial alone."""
    return [dict.fromkeys(RESULTS, trial.seed + trial.particles / 7) for trial in job.trials]


def fake_execute(function, jobs):
    return ((job, fake_results(job)) for job in jobs)


def test_usual_run_has_the_parameters_of_table_2():
    base = experiment_grid.paper()
    (usual,) = {dataclasses.replace(t, seed=0) for t in of_figure("fig3")}
    assert (usual.particles, usual.observations, usual.d_max_m) == (500, 15, 10.0)
    assert (usual.descriptor_noise, usual.robots, usual.proposal) == (0.01, 3, "motion")
    assert base.scenario.camera.sigma_disparity_px == 0.1
    assert base.filters["motion"].resample_below == 1.0
    assert [filters.proposal for filters in base.filters.values()] == list(base.filters)


@pytest.mark.parametrize(
    ("figure", "column", "values"),
    [
        ("fig5", "particles", {1, 10, 50, 100, 200, 300, 400, 500, 1000, 1500, 2000}),
        ("fig8", "observations", {0, 1, 5, 10, 15, 20, 25}),
        ("fig6", "d_max_m", set(Grid().d_max_m)),
        ("fig7", "descriptor_noise", set(Grid().descriptor_noise)),
    ],
)
def test_figure_varies_one_thing_for_every_team_proposal_and_seed(figure, column, values):
    trials = of_figure(figure)
    assert {getattr(trial, column) for trial in trials} == values
    assert len(set(trials)) == len(trials) == len(values) * 3 * 2 * 20
    assert len({dataclasses.replace(t, **{column: 0}) for t in trials}) == 3 * 2 * 20


def test_figure_9_gives_each_robot_b_or_its_share():
    shares = {(trial.robots, trial.observations) for trial in of_figure("fig9")}
    assert shares == {(1, 15), (2, 15), (2, 7), (3, 15), (3, 5)}


def test_seed_decides_tour_and_start_whatever_else_varies():
    starts = {(t.seed, t.trajectory, t.start_offset) for _, t in FULL}
    assert len(starts) == 20
    assert len({start[1:] for start in starts}) == 20
    assert max(Counter(tour for _, tour, _ in starts).values()) == 7


def test_teams_share_one_world_and_one_tour():
    base = small_experiment.base()
    one, three = (
        exploration.explore(base, trial)
        for _, trial in small_experiment.wanted([4])
        if trial.particles == 1 and trial.proposal == "motion" and trial.robots != 2
    )
    np.testing.assert_array_equal(one.landmarks.positions, three.landmarks.positions)
    np.testing.assert_array_equal(one.landmarks.descriptors, three.landmarks.descriptors)
    assert (len(one.instants), len(three.instants)) == (31, 11)
    (whole,) = (path.poses for path in one.truth.values())
    parts = [path.poses for path in three.truth.values()]
    np.testing.assert_allclose(parts[0], whole[:11], atol=1e-9)
    np.testing.assert_allclose(parts[2], whole[20:], atol=1e-9)


def test_jobs_cover_every_trial_once_and_one_simulation_each():
    base, trials = experiment_grid.paper(), {trial for _, trial in FULL}
    jobs = experiments.jobs(trials, base)
    assert sorted(trial for job in jobs for trial in job.trials) == sorted(trials)
    simulations = [
        {dataclasses.replace(trial, particles=0, proposal="") for trial in job.trials}
        for job in jobs
    ]
    assert all(len(one) == 1 for one in simulations)
    assert len(set.union(*simulations)) == len(jobs)
    assert [job.cost for job in jobs] == sorted((job.cost for job in jobs), reverse=True)


def test_run_that_figures_share_is_computed_once_and_has_a_row_in_each(tmp_path):
    grid = Grid((5,), (10.0,), (0.01,), (15,))
    base = small_experiment.base()
    filters = {name: dataclasses.replace(f, particles=5) for name, f in base.filters.items()}
    base = dataclasses.replace(base, filters=filters)
    wanted = experiment_grid.plan(("fig5", "fig6", "fig7", "fig8"), grid, [0], base)
    done = []
    rows = experiments.run(wanted, base, tmp_path, counted(done))
    assert (len(done), len(rows)) == (6, 24)
    for trial in done:
        assert len({str(rows[figure, trial]) for figure in ("fig5", "fig6", "fig7", "fig8")}) == 1
    more = experiment_grid.plan(("fig9",), dataclasses.replace(grid, particles=(5,)), [0], base)
    experiments.run(more, base, tmp_path, counted(done))
    assert len(done) == 6 + 4


def test_interrupted_table_goes_on_and_ends_the_same_in_any_order(tmp_path):
    base, wanted = small_experiment.base(), small_experiment.wanted()
    experiments.run(wanted, base, tmp_path / "whole", fake_execute)
    whole = (tmp_path / "whole" / "table.csv").read_text()

    def broken(function, jobs):
        for count, job in enumerate(reversed(jobs)):
            if count == 3:
                raise KeyboardInterrupt
            yield job, fake_results(job)

    with pytest.raises(KeyboardInterrupt):
        experiments.run(wanted, base, tmp_path / "parts", broken)
    path = tmp_path / "parts" / "table.csv"
    path.write_text(path.read_text()[:-7])  # killed while it wrote
    seen = []

    def rest(function, jobs):
        seen.extend(trial for job in jobs for trial in job.trials)
        return fake_execute(function, jobs)

    experiments.run(wanted, base, tmp_path / "parts", rest)
    assert path.read_text() == whole
    assert len(seen) == len(wanted) - 3 * 4 + 1


def test_progress_ends_at_its_total(tmp_path):
    told = []
    experiments.run(
        small_experiment.wanted([0]),
        small_experiment.base(),
        tmp_path,
        fake_execute,
        lambda *progress: told.append(progress),
    )
    assert told[0][0] == 0
    assert told[-1][0] == pytest.approx(told[-1][1])
    assert sorted(told) == told


def test_table_of_other_settings_is_refused(tmp_path):
    base, wanted = small_experiment.base(), small_experiment.wanted([0])
    experiments.run(wanted, base, tmp_path, fake_execute)
    other = dataclasses.replace(base, scenario=dataclasses.replace(base.scenario, landmarks=9))
    with pytest.raises(InputError, match="other settings"):
        experiments.run(wanted, other, tmp_path, fake_execute)


def test_row_is_computed_again_from_itself_alone(tmp_path):
    base, wanted = small_experiment.base(), small_experiment.wanted([3])
    experiments.run(wanted, base, tmp_path, small_experiment.serially)
    path = tmp_path / "table.csv"
    timing = experiment_table.COLUMNS.index(experiment_table.TIMING)
    for line in path.read_text().splitlines()[1:]:
        again = experiments.repeat(line, base, small_experiment.serially).split(",")
        given = line.split(",")
        assert again[:timing] + again[timing + 1 :] == given[:timing] + given[timing + 1 :]


def test_result_is_the_error_of_what_the_robots_reported():
    base = small_experiment.base()
    _, trial = small_experiment.wanted([5])[-1]
    (result,) = experiments.compute(experiments.Job(base, (trial,)))
    explored = exploration.explore(base, trial)
    squares = []
    for name, path in explored.truth.items():
        x0, y0, yaw = explored.start_poses[name]
        turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        reported = [
            robot.odometry.pose[:2]
            for instant in explored.instants
            for robot in instant
            if robot.odometry.robot == name
        ]
        squares.append(((x0, y0) + reported @ turn.T - path.poses[:, :2]) ** 2)
    expected = np.sqrt(np.concatenate(squares).sum(axis=1).mean())
    assert result["odometry_path_rmse_m"] == pytest.approx(expected, rel=1e-9)
    assert result["association_precision"] > 0.9
    assert 0 < result["path_rmse_m"] < 10
    assert result["step_ms_mean"] > 0


def test_batch_solution_is_the_same_for_every_filter_and_better_than_odometry():
    base = experiment_grid.paper()
    trials = [t for t in of_figure("fig5") if t.seed == 1 and t.robots == 3 and t.particles == 10]
    results = experiments.compute(experiments.Job(base, tuple(trials)))
    one, other = (result["batch_path_rmse_m"] for result in results)
    assert one == other
    assert one == experiments.compute(experiments.Job(base, trials[1:]))[0]["batch_path_rmse_m"]
    assert one < 0.5 * results[0]["odometry_path_rmse_m"]


def test_without_observations_the_batch_solution_is_odometry():
    base = small_experiment.base()
    (trial,) = (
        t
        for t in of_figure("fig8")
        if (t.observations, t.robots, t.proposal, t.seed) == (0, 2, "motion", 3)
    )
    (result,) = experiments.compute(experiments.Job(base, (trial,)))
    assert result["batch_path_rmse_m"] == pytest.approx(result["odometry_path_rmse_m"])
    assert result["map_rmse_m"] is None


numbers = st.floats(1e-6, 1e6) | st.none()


@given(
    st.integers(1, 9),
    st.floats(0, 1).map(lambda x: round(x, 3)),
    st.lists(numbers, min_size=len(RESULTS), max_size=len(RESULTS)),
)
def test_line_of_the_table_round_trips(robots, offset, values):
    trial = Trial(robots, 500, 15, 10.0, 0.0125, "motion", "ring", offset, 7)
    line = experiment_table.to_line(("fig5", trial), dict(zip(RESULTS, values, strict=True)))
    key, result = experiment_table.from_line(line)
    assert key == ("fig5", trial)
    assert experiment_table.to_line(key, result) == line
    for value, read in zip(values, result.values(), strict=True):
        assert read == (value if value is None else pytest.approx(value, rel=1e-5))


@pytest.mark.parametrize("text", ["0", "", "1,,2", "-5,10", "many", "1.5"])
def test_particle_numbers_below_one_are_refused(text):
    with pytest.raises(InputError, match="particles = "):
        experiment_grid.particle_numbers(text)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("fig2",), "no experiment 'fig2'"),
        ((), "name the experiment"),
        (("fig5", "--particles", "0,10"), "particles = '0,10'"),
        (("--row", "fig5,1,2"), "not a row of the table"),
        (("--row", ",".join(["x"] * len(experiment_table.COLUMNS))), "robots = 'x'"),
        (("fig3", "--out", "/dev/null/out"), "cannot write"),
    ],
)
def test_bad_argument_is_told_in_a_line(command, tmp_path, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    code, out, err = command("study", "experiment", *words)
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert said in err


def test_command_leaves_table_settings_pictures_and_statements(command, tmp_path):
    words = ("fig4", "--repeats", "3", "--out", tmp_path)
    assert command("study", "experiment", *words)[0] == 0
    assert {p.name for p in tmp_path.iterdir()} == {"table.csv", "settings.yaml", "fig4.png"}
    (row,) = (tmp_path / "table.csv").read_text().splitlines()[1:]
    code, printed, _ = command("study", "experiment", "--row", row)
    timing = experiment_table.COLUMNS.index(experiment_table.TIMING)
    again, given = printed.strip().split(","), row.split(",")
    again[timing] = given[timing]
    assert (code, again) == (0, given)
