"""The paper's experiments: runs that differ in the filter alone share their simulation.

A run that several figures need is done once.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from msg_defs import scenario_file
from msg_defs.errors import InputError
from msg_defs.types import Trajectory
from multi_robot_slam.runs import evaluation
from multi_robot_slam.studies import experiment_table, exploration, table
from multi_robot_slam.studies.experiment_table import RESULTS, Key, Result, Rows, Trial
from multi_robot_slam.studies.exploration import Base, Exploration
from sim_world.scenario import SECTION as WORLD_SECTION
from sim_world.trajectories import TOURS


@dataclass(frozen=True)
class Job:
    """Runs that share one simulation."""

    base: Base
    trials: tuple[Trial, ...]

    @property
    def cost(self) -> float:
        """Rough duration, in units of a run with hardly any particles."""
        return 3 + sum(1 + trial.particles / 500 for trial in self.trials)


def run(
    wanted: Sequence[Key],
    base: Base,
    folder: Path,
    execute: table.Execute,
    on_progress: Callable[[float, float], None] = lambda done, total: None,
) -> Rows:
    """Bring `folder/table.csv` to hold the wanted rows; those it has are not computed again.

    `on_progress` is told the share of the work that is done, and all of it.
    """
    table.claim(folder, settings(base))
    kept = experiment_table.opened(folder / "table.csv")
    known = {trial: result for (_, trial), result in kept.rows.items()}
    kept.rows |= {(figure, trial): known[trial] for figure, trial in wanted if trial in known}
    todo: defaultdict[Trial, list[str]] = defaultdict(list)
    for figure, trial in wanted:
        if trial not in known:
            todo[trial].append(figure)

    def rows_of(job: Job, results: list[Result]) -> Rows:
        finished = zip(job.trials, results, strict=True)
        return {(figure, trial): result for trial, result in finished for figure in todo[trial]}

    table.fill(
        kept, jobs(todo, base), compute, rows_of, execute, on_progress, cost=lambda job: job.cost
    )
    return experiment_table.opened(kept.path).rows


def settings(base: Base) -> str:
    """What all rows of a table have in common, as YAML."""
    return scenario_file.to_yaml(
        **{WORLD_SECTION: base.scenario, **base.filters, "keyframe": base.keyframe}
    )


def jobs(trials: Iterable[Trial], base: Base) -> list[Job]:
    """The trials by simulation, the longest job first."""
    groups: defaultdict[Trial, list[Trial]] = defaultdict(list)
    for trial in sorted(trials):
        groups[replace(trial, particles=0, proposal="")].append(trial)
    return sorted((Job(base, tuple(g)) for g in groups.values()), key=lambda j: -j.cost)


def compute(job: Job) -> list[Result]:
    """The result of each of the job's trials."""
    explored = exploration.explore(job.base, job.trials[0])
    batch = exploration.batch_paths(explored, job.base)
    return [_result(explored, batch, job.base, trial) for trial in job.trials]


def _result(
    explored: Exploration, batch: dict[str, Trajectory], base: Base, trial: Trial
) -> Result:
    run, _ = exploration.estimate(explored, exploration.filter_of(base, trial))
    figures = evaluation.evaluate(run.with_paths(yardstick=batch))
    return {name: figures[name] for name in RESULTS}


def repeat(line: str, base: Base, execute: table.Execute) -> str:
    """The row of table.csv that `line` is, computed again."""
    (figure, trial), _ = experiment_table.from_line(line)
    if trial.proposal not in base.filters or trial.trajectory not in TOURS:
        raise InputError(
            f"proposal = '{trial.proposal}', trajectory = '{trial.trajectory}': use "
            f"{' or '.join(base.filters)}, and {', '.join(TOURS)}"
        )
    ((_, (result,)),) = execute(compute, [Job(base, (trial,))])
    return experiment_table.to_line((figure, trial), result)
