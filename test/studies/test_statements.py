"""Tests of significance, on data whose answer is known."""

import numpy as np
import pytest

from multi_robot_slam.studies import statements
from multi_robot_slam.studies.experiment_grid import Grid, paper, plan
from multi_robot_slam.studies.experiment_table import RESULTS

SEEDS = range(12)
GRID = Grid((1, 50, 500), (6.0, 8.0, 10.0), (0.01, 0.012, 0.014), (0, 1, 5, 15))
NAMES = ("fig5", "fig6", "fig7", "fig8", "fig9")


def rows(error, time=lambda trial: 1.0):
    """Runs whose errors and times are what the functions say, times some noise of 2 %."""
    rng = np.random.default_rng(5)
    table = {}
    for key in plan(NAMES, GRID, SEEDS, paper()):
        trial, noise = key[1], np.exp(0.02 * rng.normal(size=4))
        table[key] = dict.fromkeys(RESULTS, 1.0) | {
            "path_rmse_m": error(trial) * noise[0],
            "map_rmse_m": error(trial) * noise[1] if trial.observations else None,
            "odometry_path_rmse_m": 50.0 * noise[2],
            "step_ms_mean": time(trial) * noise[3],
        }
    return table


def as_the_paper_says(trial):
    noise = 1 + 100 * (trial.descriptor_noise - 0.01) / trial.robots
    usual = 10 / (1 + np.log10(trial.particles)) / trial.d_max_m / (1 + trial.observations)
    return usual * noise / trial.robots


def verdicts(table):
    found = {}
    for finding in statements.findings(table):
        found.setdefault(finding.statement, set()).add(finding.verdict)
    return found


def said_of(found, word):
    (verdict,) = (v for statement, v in found.items() if word in statement)
    return verdict


def test_world_as_the_paper_says_is_recognised():
    table = rows(as_the_paper_says, lambda t: t.particles * t.robots * t.observations + 1)
    found = verdicts(table)
    for word in (
        "(figure 4)",
        "d_max",
        "M grows",
        "grows with the noise",
        "more robust",
        "B grows",
    ):
        assert said_of(found, word) == {"holds"}, word
    for word in ("with M", "with K"):
        assert said_of(found, word) == {"holds"}, word


def test_opposite_of_the_paper_is_recognised():
    found = verdicts(rows(lambda trial: 1 / as_the_paper_says(trial)))
    for word in ("d_max", "M grows", "grows with the noise", "B grows"):
        assert said_of(found, word) == {"the opposite holds"}, word


def test_times_are_alike_only_within_the_margins():
    alike = verdicts(rows(as_the_paper_says, lambda t: 3.0 + 0.1 * t.robots))
    assert said_of(alike, "alike") == {"holds"}
    apart = verdicts(rows(as_the_paper_says, lambda t: 3.0 * t.robots))
    assert said_of(apart, "alike") == {"the opposite holds"}


@pytest.mark.parametrize("rising", [True, False])
def test_pure_noise_is_rarely_called_a_trend(rising):
    rng = np.random.default_rng(2)
    claims = [
        statements.trend(rng.normal(size=(20, 7)), rising).verdict == "holds" for _ in range(400)
    ]
    assert np.mean(claims) == pytest.approx(statements.LEVEL, abs=0.035)


def test_trend_knows_its_direction_in_spite_of_seeds_that_differ():
    rng = np.random.default_rng(3)
    data = np.arange(5) + 100 * rng.normal(size=(10, 1)) + 0.1 * rng.normal(size=(10, 5))
    assert statements.trend(data, rising=True).verdict == "holds"
    assert statements.trend(data, rising=False).verdict == "the opposite holds"


def test_too_little_data_claims_nothing():
    assert statements.trend(np.ones((1, 5)), rising=True).p is None
    assert statements.trend(np.ones((5, 2)), rising=True).p is None
    assert statements.alike(np.ones(1)).p is None
    assert statements.less(np.ones(1), np.zeros(1)).p is None


def test_matrix_pools_within_a_seed_and_leaves_out_what_was_not_measured():
    table = {trial: result for (n, trial), result in rows(as_the_paper_says).items() if n == "fig8"}
    one = {t: r for t, r in table.items() if (t.robots, t.proposal) == (2, "motion")}
    observations, data = statements.matrix(one, statements.ERRORS["map"], "observations")
    assert (observations, data.shape) == ([1, 5, 15], (12, 3))
    observations, data = statements.matrix(one, statements.ERRORS["path"], "observations")
    assert observations == [0, 1, 5, 15]
    np.testing.assert_allclose(data[:, 0], 50, rtol=0.1)
    both = {t: r for t, r in table.items() if t.robots == 2 and t.observations == 5}
    _, (pooled,) = statements.matrix(
        {t: {"x": 2.0 if t.proposal == "motion" else 8.0} for t in both if t.seed == 0},
        statements.column("x"),
        "observations",
    )
    np.testing.assert_allclose(pooled, 4.0)


def test_markdown_has_a_section_and_a_count_for_each_statement():
    found = statements.findings(rows(as_the_paper_says))
    text = statements.markdown(found)
    for finding in found:
        assert f"### {finding.statement}" in text
    assert text.count("\n### ") + 1 == len({finding.statement for finding in found})
    assert text.count("| Page, 12 seeds |") == sum("Page" in f.test for f in found)
