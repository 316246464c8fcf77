"""How close the filter comes to the best possible answer: particles x filters x seeds -> table.

The yardstick is batch least squares with the true associations on the same run, and for the poses
as published the same over what was known at each instant. All ratios are of RMS errors of position.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from msg_defs import scenario_file
from msg_defs.errors import InputError
from msg_defs.types import Trajectory
from multi_robot_slam.config import shipped
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.pipeline import refinement
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs import Run, evaluation
from multi_robot_slam.runs.trajectory_errors import at, rmse
from multi_robot_slam.studies import (
    accuracy_table,
    experiment_grid,
    experiments,
    exploration,
    filtering_optimum,
    table,
)
from multi_robot_slam.studies.accuracy_table import COLUMNS, REJUVENATED, Key, Row, key_of
from multi_robot_slam.studies.exploration import Base, Exploration
from sim_world.scenario import SECTION as WORLD_SECTION
from sim_world.scenario import Scenario

TEAMS = (1, 2, 3)
PARTICLES = {
    "motion": (10, 100, 500, 2000),
    "informed": (10, 100, 500, 2000),
    REJUVENATED: (100, 500),
}
"""Of the two proposals without rejuvenation, and of the scenario's filter with it.

Drawing 2000 whole paths again and again would take longer than all the rest.
"""

OPTIMUM_EVERY = 10
"""Steps between two instants at which the filtering optimum is computed."""


@dataclass(frozen=True)
class Job:
    """One exploration, and the runs over it."""

    base: Base
    robots: int
    seed: int
    runs: tuple[tuple[str, int], ...]
    """Filter and particles of each."""


def calibrated(resample_below: float = 0.5) -> Base:
    """The calibrated scenario, and the filters that are compared in it, one thread each."""
    path = scenario_file.find_scenario("calibrated")
    config = shipped("calibrated")
    own = replace(config.filter, threads=1, resample_below=resample_below)
    never = replace(own.rejuvenation, ancestors_below=0.0)
    filters = {p: replace(own, proposal=p, rejuvenation=never) for p in ("motion", "informed")}
    filters[REJUVENATED] = own
    scenario = scenario_file.from_file(Scenario, path, WORLD_SECTION)
    return Base(scenario, filters, config.keyframe)


def filters_of(names: str) -> tuple[str, ...]:
    """Filters from text such as informed,rejuvenated."""
    chosen = tuple(dict.fromkeys(names.split(",")))
    if unknown := [name for name in chosen if name not in PARTICLES]:
        raise InputError(f"no filter '{unknown[0]}'; there are {', '.join(PARTICLES)}")
    return chosen


def study(
    folder: Path,
    base: Base,
    seeds: Sequence[int],
    particles: Mapping[str, Sequence[int]],
    execute: table.Execute,
    on_progress: Callable[[float, float], None] = lambda done, total: None,
) -> list[Row]:
    """Bring `folder/accuracy.csv` to hold the runs of every filter in `particles` for all `seeds`.

    Rows it has are not computed again. Returns the rows asked for, in a fixed order, which
    `folder/accuracy.md` summarises.
    """
    table.claim(folder, experiments.settings(base))
    kept = accuracy_table.opened(folder / "accuracy.csv")
    wanted = [
        (name, robots, count, seed)
        for name in particles
        for robots in TEAMS
        for count in particles[name]
        for seed in seeds
    ]
    jobs = _jobs(base, [key for key in wanted if key not in kept.rows])
    table.fill(kept, jobs, compute, _rows_of, execute, on_progress)
    rows = [kept.rows[key] for key in sorted(wanted)]
    (folder / "accuracy.md").write_text(accuracy_table.markdown(rows))
    return rows


def _rows_of(job: Job, rows: list[Row]) -> dict[Key, Row]:
    return {key_of(row): row for row in rows}


def _jobs(base: Base, keys: list[Key]) -> list[Job]:
    """The runs by exploration."""
    runs: defaultdict[tuple[int, int], list[tuple[str, int]]] = defaultdict(list)
    for name, robots, count, seed in keys:
        runs[robots, seed].append((name, count))
    return [Job(base, robots, seed, tuple(own)) for (robots, seed), own in runs.items()]


def compute(job: Job) -> list[Row]:
    """Simulate the team, and estimate with every filter."""
    base = replace(job.base, scenario=replace(job.base.scenario, robots=job.robots))
    trial = experiment_grid.usual(base, job.robots, "informed", job.seed)
    explored = exploration.explore(base, trial)
    anyone, pipeline = exploration.estimate(
        explored, replace(base.filters["informed"], particles=1)
    )
    optimum = filtering_optimum.poses(
        pipeline.lineage(), anyone.observation_truth, anyone.config, OPTIMUM_EVERY
    )
    return [
        _row(explored, optimum, name, replace(base.filters[name], particles=count))
        for name, count in job.runs
    ]


def _row(
    explored: Exploration,
    optimum: Mapping[str, Trajectory],
    name: str,
    filter_settings: FilterSettings,
) -> Row:
    run, pipeline = exploration.estimate(explored, filter_settings)
    figures = evaluation.evaluate(
        refinement.complete(run, pipeline, with_refined=True, with_yardstick=True)
    )
    own: dict[str, Any] = {
        "filter": name,
        "robots": len(run.robots),
        "particles": filter_settings.particles,
        "seed": explored.seed,
        "optimum_ratio": optimum_ratio(run, optimum),
        "ancestors": _early_ancestors(pipeline),
    }
    return Row(**own, **{column: figures[column] for column in COLUMNS if column not in own})


def optimum_ratio(run: Run, optimum: Mapping[str, Trajectory]) -> float:
    """RMS error of position of the published poses over that of the `optimum`, at its stamps.

    Robots without ground truth are left out; NaN when none has any.
    """
    published, best = [], []
    for name, path in optimum.items():
        robot = run.robots[name]
        if robot.truth is None:
            continue
        truth = at(robot.truth, path.stamps_ns)[:, :2]
        published.append(at(robot.online, path.stamps_ns)[:, :2] - truth)
        best.append(path.poses[:, :2] - truth)
    error, least = (rmse(np.concatenate(e)) if e else None for e in (published, best))
    return error / least if error is not None and least else np.nan


def _early_ancestors(pipeline: Pipeline) -> int:
    counts = pipeline.distinct_ancestors()
    return int(counts[len(counts) // 10])
