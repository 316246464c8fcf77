"""What the paper states about its figures 5 to 9, tested on the table of an experiment.

Runs with the same seed share tour, start and random numbers, so every test compares within seeds.
Trends: Page's test for ordered alternatives (a seed is a block), in both directions. Pairs:
Wilcoxon's signed-rank test. Alike: two one-sided t tests on the logarithm of the ratio, with the
usual margins of 0.8 and 1.25. p values are not corrected for the number of tests.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from multi_robot_slam.studies.experiment_table import Result, Rows, Trial
from multi_robot_slam.studies.figures import (
    PROPOSALS,
    Value,
    column,
    has_b,
    path_or_odometry,
    shares_b,
)

LEVEL = 0.05
"""Below this p a test counts as significant."""
MARGIN = 1.25
"""Ratios between 1 / MARGIN and MARGIN are alike."""
ERRORS = {"path": path_or_odometry, "map": column("map_rmse_m")}
TIME = column("step_ms_mean")

Runs = dict[Trial, Result]


class Finding(NamedTuple):
    """One test of a statement."""

    statement: str
    case: str
    numbers: str
    test: str
    p: float | None
    verdict: str


class Outcome(NamedTuple):
    """What a test says: its p for the claim, and a verdict."""

    p: float | None
    verdict: str


def trend(data: np.ndarray, rising: bool) -> Outcome:
    """Page's test that the columns of `data` (seeds, conditions) rise, or fall."""
    if data.shape[0] < 2 or data.shape[1] < 3:
        return Outcome(None, "too few runs")
    claimed, opposite = (
        float(stats.page_trend_test(sign * data, method="asymptotic").pvalue)
        for sign in ((1, -1) if rising else (-1, 1))
    )
    return _outcome(claimed, opposite)


def less(first: np.ndarray, second: np.ndarray) -> Outcome:
    """Wilcoxon's test that `first` is less than `second`, seed by seed."""
    if len(first) < 2 or np.array_equal(first, second):
        return Outcome(None, "too few runs")
    return _outcome(
        *(float(stats.wilcoxon(first, second, alternative=a).pvalue) for a in ("less", "greater"))
    )


def alike(ratios: np.ndarray) -> Outcome:
    """Two one-sided tests that the mean ratio lies within the margins."""
    if len(ratios) < 2:
        return Outcome(None, "too few runs")
    logs, margin = np.log(ratios), np.log(MARGIN)
    p = max(
        float(stats.ttest_1samp(logs, bound, alternative=side).pvalue)
        for bound, side in ((-margin, "greater"), (margin, "less"))
    )
    outside = min(
        float(stats.ttest_1samp(logs, bound, alternative=side).pvalue)
        for bound, side in ((-margin, "less"), (margin, "greater"))
    )
    return _outcome(p, outside)


def _outcome(claimed: float, opposite: float) -> Outcome:
    if claimed < LEVEL:
        return Outcome(claimed, "holds")
    return Outcome(claimed, "the opposite holds" if opposite < LEVEL else "not shown")


def matrix(runs: Runs, value: Value, condition: str) -> tuple[list[float], np.ndarray]:
    """The values of `condition`, ascending, and (seeds, conditions) the geometric mean of `value`.

    Seeds without a value under some condition are left out, and conditions without any.
    """
    cells: dict[tuple, list[float]] = {}
    for trial, result in runs.items():
        measured = value(trial, result)
        if measured is not None:
            cells.setdefault((trial.seed, getattr(trial, condition)), []).append(measured)
    seeds, conditions = (sorted({key[i] for key in cells}) for i in (0, 1))
    whole = [seed for seed in seeds if all((seed, c) in cells for c in conditions)]
    data = [[_mean(cells[seed, c]) for c in conditions] for seed in whole]
    return conditions, np.array(data).reshape(len(whole), len(conditions))


def findings(rows: Rows) -> list[Finding]:
    """Every statement, tested as far as the table has its figure."""
    found: list[Finding] = []
    for figure, check in CHECKS.items():
        runs = {trial: result for (name, trial), result in rows.items() if name == figure}
        found += check(runs) if runs else []
    return found


def markdown(found: Sequence[Finding]) -> str:
    """The findings as tables, a section each statement."""
    lines = []
    for statement in dict.fromkeys(finding.statement for finding in found):
        own = [finding for finding in found if finding.statement == statement]
        holds = sum(finding.verdict == "holds" for finding in own)
        lines += [f"### {statement}", "", f"Holds in {holds} of {len(own)} tests.", ""]
        lines += ["| case | geometric means | test | p | verdict |", "|---|---|---|---|---|"]
        lines += [f"| {f.case} | {f.numbers} | {f.test} | {_p(f.p)} | {f.verdict} |" for f in own]
        lines.append("")
    return "\n".join(lines)


def _p(p: float | None) -> str:
    if p is None:
        return "-"
    return "< 0.0001" if p < 1e-4 else f"{p:.2g}"


def _select(runs: Runs, keep: Callable[[Trial], bool]) -> Runs:
    return {trial: result for trial, result in runs.items() if keep(trial)}


def _split(runs: Runs, *names: str) -> Iterator[tuple[str, Runs]]:
    """The runs of each value of the named columns, with a description."""
    groups: dict[tuple, Runs] = {}
    for trial in sorted(runs):
        groups.setdefault(tuple(getattr(trial, n) for n in names), {})[trial] = runs[trial]
    for key, group in sorted(groups.items(), key=lambda item: str(item[0])):
        yield ", ".join(_word(n, value) for n, value in zip(names, key, strict=True)), group


def _word(name: str, value: Any) -> str:
    """A column's value in the description of a case."""
    return f"K = {value}" if name == "robots" else PROPOSALS[value]


def _trends(
    statement: str, runs: Runs, values: dict[str, Value], condition: str, rising: bool
) -> Iterator[Finding]:
    """The trend along a figure's axis, for each proposal and number of robots."""
    for what, value in values.items():
        for case, group in _split(runs, "proposal", "robots"):
            conditions, data = matrix(group, value, condition)
            yield Finding(
                statement,
                f"{what}, {case}",
                _ends(conditions, data),
                f"Page, {len(data)} seeds",
                *trend(data, rising),
            )


def _teams(
    statement: str, runs: Runs, values: dict[str, Value], rising: bool = False
) -> Iterator[Finding]:
    """The trend over the number of robots, over all else in a figure."""
    for what, value in values.items():
        for case, group in _split(runs, "proposal"):
            teams, data = matrix(group, value, "robots")
            numbers = ", ".join(
                f"K = {k}: {_mean(column):.3g}" for k, column in zip(teams, data.T, strict=True)
            )
            yield Finding(
                statement,
                f"{what}, {case}",
                numbers,
                f"Page, {len(data)} seeds",
                *trend(data, rising),
            )


def _ends(conditions: Sequence[float], data: np.ndarray) -> str:
    """The means at the ends of a figure's axis."""
    if not data.size:
        return "-"
    return ", ".join(f"{conditions[i]:g}: {_mean(data[:, i]):.3g}" for i in (0, -1))


def _mean(values: Sequence[float] | np.ndarray) -> float:
    """The geometric mean; NaN of nothing."""
    with np.errstate(divide="ignore"):
        return float(np.exp(np.mean(np.log(values)))) if len(values) else np.nan


def _relative(trial: Trial, result: Result) -> float | None:
    return _ratio(result["path_rmse_m"], result["odometry_path_rmse_m"])


def _ratio(value: float | None, to: float | None) -> float | None:
    return None if value is None or to is None else value / to


def _fig4(runs: Runs) -> Iterator[Finding]:
    """Figure 4's statement, on the runs of figure 5 with the most particles."""
    most = _most_particles(runs)
    for case, group in _split(_select(runs, lambda t: t.particles == most), "proposal", "robots"):
        by_seed = [group[trial] for trial in sorted(group, key=lambda t: t.seed)]
        path, odometry = (
            np.array([result[name] for result in by_seed])
            for name in ("path_rmse_m", "odometry_path_rmse_m")
        )
        yield Finding(
            "The path's error is less than the odometry's (figure 4)",
            f"M = {most}, {case}",
            f"path: {_mean(path):.3g}, odometry: {_mean(odometry):.3g}",
            f"Wilcoxon, {len(path)} seeds",
            *less(path, odometry),
        )


def _most_particles(runs: Runs) -> int:
    return max(trial.particles for trial in runs)


def _fig5(runs: Runs) -> Iterator[Finding]:
    yield from _fig4(runs)
    statement = "The error falls as M grows (figure 5)"
    yield from _trends(statement, runs, ERRORS, "particles", rising=False)
    statement = "For the same M, more robots give smaller errors (figure 5)"
    relative = {"path relative to odometry (not in the paper)": _relative}
    yield from _teams(statement, runs, ERRORS | relative)


def _fig6(runs: Runs) -> Iterator[Finding]:
    statement = "The error falls as d_max grows (figure 6)"
    yield from _trends(statement, runs, ERRORS, "d_max_m", rising=False)


def _fig7(runs: Runs) -> Iterator[Finding]:
    statement = "The error grows with the noise in the descriptor (figure 7)"
    yield from _trends(statement, runs, ERRORS, "descriptor_noise", rising=True)
    quality = {
        "precision": column("association_precision"),
        "recall": column("association_recall"),
    }
    statement = "Noise in the descriptor makes the association worse (figure 7)"
    yield from _trends(statement, runs, quality, "descriptor_noise", rising=False)
    statement = "More robots are more robust to noise in the descriptor (figure 7)"
    grown = _growth(runs, min(trial.descriptor_noise for trial in runs))
    growths = {f"growth of the {what} error": value for what, value in ERRORS.items()}
    yield from _teams(statement, grown, growths)


def _growth(runs: Runs, least: float) -> Runs:
    """Each noisier run with its errors divided by those of the same run with the least noise."""
    grown = {}
    for trial, result in runs.items():
        calm = runs.get(replace(trial, descriptor_noise=least))
        if calm is not None and trial.descriptor_noise > least:
            names = ("path_rmse_m", "map_rmse_m")
            grown[trial] = {name: _ratio(result[name], calm[name]) for name in names}
    return grown


def _fig8(runs: Runs) -> Iterator[Finding]:
    statement = "The error falls as B grows (figure 8)"
    yield from _trends(statement, runs, ERRORS, "observations", rising=False)


def _fig9(runs: Runs) -> Iterator[Finding]:
    each, shared = _select(runs, has_b(runs)), _select(runs, shares_b(runs))
    times = {"ms per step, B each": TIME}
    yield from _trends("Time grows with M (figure 9a)", each, times, "particles", rising=True)
    yield from _teams("Time grows with K (figure 9a)", each, times, rising=True)
    statement, most = "With B/K each, time is alike for all K (figure 9b)", _most_particles(runs)
    yield from _alike(statement, shared, "all M")
    yield from _alike(statement, _select(shared, lambda t: t.particles == most), f"M = {most}")
    statement = "With B/K each, the map's error keeps the trend of figure 5 (figure 9c)"
    errors = {"map, B/K each": ERRORS["map"]}
    yield from _trends(statement, shared, errors, "particles", rising=False)
    yield from _teams(statement, shared, errors)


def _alike(statement: str, runs: Runs, particles: str) -> Iterator[Finding]:
    for case, group in _split(runs, "proposal"):
        teams, data = matrix(group, TIME, "robots")
        for team, times in zip(teams[1:], data.T[1:], strict=True):
            ratios = times / data[:, 0]
            yield Finding(
                statement,
                f"ms per step, {particles}, K = {team} to K = {teams[0]}, {case}",
                f"{_mean(times):.3g} to {_mean(data[:, 0]):.3g}, ratio {_mean(ratios):.3g}",
                f"two one-sided t, {len(ratios)} seeds",
                *alike(ratios),
            )


CHECKS: dict[str, Callable[[Runs], Iterable[Finding]]] = {
    "fig5": _fig5,
    "fig6": _fig6,
    "fig7": _fig7,
    "fig8": _fig8,
    "fig9": _fig9,
}
