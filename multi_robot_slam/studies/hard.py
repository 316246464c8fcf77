"""Worlds that differ from what the fusion is told: worlds x teams x seeds -> table."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from msg_defs.errors import InputError
from multi_robot_slam import runs
from multi_robot_slam.pipeline import map_files, offline
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs.associations import associations, origins
from multi_robot_slam.studies import (
    accuracy,
    experiments,
    filtering_optimum,
    hard_figures,
    hard_table,
    hard_worlds,
    table,
)
from multi_robot_slam.studies.exploration import Base
from multi_robot_slam.studies.hard_changes import Loaded, Told
from multi_robot_slam.studies.hard_figures import Outcome
from multi_robot_slam.studies.hard_table import Key, Row, key_of
from multi_robot_slam.studies.hard_worlds import WORLDS

TOGETHER = 9
"""Most worlds of a job: each job makes the exact run for itself, and its rows come at its end."""


@dataclass(frozen=True)
class Job:
    """Runs of one team that are compared with the same exact run."""

    base: Base
    exact: str
    robots: int
    seed: int
    worlds: tuple[str, ...]

    @property
    def cost(self) -> float:
        """Rough duration, in units of a run of one round."""
        return (1 + len(self.worlds)) * WORLDS[self.exact].rounds


def teams_of(text: str) -> tuple[int, ...]:
    """Numbers of robots from text such as 2,3."""
    try:
        numbers = tuple(sorted({int(word) for word in text.split(",")}))
    except ValueError:
        numbers = ()
    if not numbers or numbers[0] < 2:
        raise InputError(f"robots = '{text}': give numbers from 2 on, such as 2,3")
    return numbers


def study(
    folder: Path,
    base: Base,
    worlds: Sequence[str],
    teams: Sequence[int],
    seeds: Sequence[int],
    execute: table.Execute,
    on_progress: Callable[[float, float], None] = lambda done, total: None,
) -> list[Row]:
    """Bring `folder/hard.csv` to hold a run in each of the `worlds` for all teams and seeds.

    Rows it has are not computed again. Returns the rows asked for, in the table's order, which
    `folder/hard.md` summarises.
    """
    table.claim(folder, experiments.settings(base))
    kept = hard_table.opened(folder / "hard.csv")
    wanted = [(name, robots, seed) for name in worlds for robots in teams for seed in seeds]
    jobs = _jobs(base, [key for key in wanted if key not in kept.rows])
    table.fill(kept, jobs, compute, _rows_of, execute, on_progress, cost=lambda job: job.cost)
    rows = [kept.rows[key] for key in sorted(wanted, key=hard_table.order_of)]
    (folder / "hard.md").write_text(hard_table.markdown(rows))
    return rows


def _rows_of(job: Job, rows: list[Row]) -> dict[Key, Row]:
    return {key_of(row): row for row in rows}


def _jobs(base: Base, keys: Sequence[Key]) -> list[Job]:
    """The runs by the exact run that they are compared with, the longest job first."""
    worlds: defaultdict[tuple[str, int, int], list[str]] = defaultdict(list)
    for name, robots, seed in keys:
        worlds[hard_worlds.exact_of(name), robots, seed].append(name)
    jobs = [
        Job(base, *group, tuple(names[i : i + TOGETHER]))
        for group, names in worlds.items()
        for i in range(0, len(names), TOGETHER)
    ]
    return sorted(jobs, key=lambda job: -job.cost)


def compute(job: Job) -> list[Row]:
    """Simulate the team in each world, and estimate."""
    with_optimum = any(WORLDS[name].has_optimum for name in job.worlds)
    told = {
        name: hard_worlds.simulated(job.base, name, job.robots, job.seed)
        for name in {hard_worlds.simulation_of(name) for name in (job.exact, *job.worlds)}
    }
    exact = run(told[job.exact], with_optimum)
    loaded = None
    if any(WORLDS[name].is_next_day for name in job.worlds):
        loaded = mapped(hard_worlds.day_before(job.base, job.robots, job.seed))
    rows = []
    for name in job.worlds:
        found = exact
        if name != job.exact:
            own = hard_worlds.changed(name, told[hard_worlds.simulation_of(name)])
            if WORLDS[name].is_next_day:
                own = replace(own, loaded=loaded)
            found = run(own, WORLDS[name].has_optimum)
        rows.append(hard_figures.row(name, found, exact))
    return rows


def run(told: Told, with_optimum: bool) -> Outcome:
    """The run of a fusion that is told this."""
    kept = None if told.loaded is None else told.loaded.kept
    pipeline = Pipeline(told.config, keeps_frames=with_optimum, kept=kept)
    pipeline.warm_up()
    predictions = runs.Predictions()
    steps = offline.run_through(pipeline, told.events, on_prediction=predictions.add)
    made = offline.assemble(pipeline, told.recorded, steps, predictions)
    optimum = None
    if with_optimum:
        optimum = filtering_optimum.poses(
            pipeline.lineage(), made.observation_truth, made.config, accuracy.OPTIMUM_EVERY
        )
    pipeline.close()
    return Outcome(told, made, optimum, pipeline.noise.factors)


def mapped(told: Told) -> Loaded:
    """The map that a team leaves."""
    pipeline = Pipeline(told.config, keeps_frames=False)
    pipeline.warm_up()
    steps = offline.run_through(pipeline, told.events)
    made = offline.assemble(pipeline, told.recorded, steps, runs.Predictions())
    kept = map_files.closed(pipeline)
    pipeline.close()
    sources = origins(associations(made)).landmarks
    return Loaded(kept, {n: sources[n] for n in kept.ids.tolist() if n in sources})
