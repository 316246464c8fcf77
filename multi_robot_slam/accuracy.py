"""How close the filter comes to the best possible answer: particles x proposals x seeds -> table.

The yardstick is batch least squares with the true associations on the same run. All ratios are of
path RMS errors to its path RMS error.
"""

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from msg_defs import settings
from multi_robot_slam import evaluation, experiments, refinement
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.experiments import Base, Exploration
from multi_robot_slam.pipeline import Pipeline
from sim_world.scenario import SECTION as WORLD_SECTION
from sim_world.scenario import Scenario

TEAMS = (1, 2, 3)
PARTICLES = (10, 100, 500, 2000)
PROPOSALS = ("motion", "informed")


@dataclass(frozen=True)
class Row:
    """Figures of one run."""

    proposal: str
    robots: int
    particles: int
    seed: int
    odometry_path_rmse_m: float
    batch_path_rmse_m: float
    path_rmse_m: float
    mean_path_rmse_m: float
    refined_path_rmse_m: float
    online_path_rmse_m: float
    association_precision: float
    association_recall: float
    pose_nees: float
    landmark_nees: float
    ancestors: int
    """Distinct ancestors at a tenth of the run, of the particles at its end."""


@dataclass(frozen=True)
class Job:
    """One exploration, estimated by every filter."""

    robots: int
    seed: int
    particles: tuple[int, ...]
    resample_below: float


def study(
    repeats: int,
    particles: tuple[int, ...],
    resample_below: float,
    execute: Callable[[Callable[[Job], list[Row]], list[Job]], Iterator[tuple[Job, list[Row]]]],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Row]:
    """All rows, in a fixed order."""
    jobs = [
        Job(robots, seed, particles, resample_below) for robots in TEAMS for seed in range(repeats)
    ]
    rows = []
    for done, (_, answer) in enumerate(execute(compute, jobs), start=1):
        rows += answer
        on_progress(done, len(jobs))
    return sorted(rows, key=lambda row: (row.proposal, row.robots, row.particles, row.seed))


def compute(job: Job) -> list[Row]:
    """Simulate a team in the calibrated scenario, and estimate with every filter."""
    path = settings.find_scenario("calibrated")
    world = settings.from_file(Scenario, path, WORLD_SECTION)
    own = settings.from_file(Config, path, SECTION).filter
    own = replace(own, threads=1, resample_below=job.resample_below)
    base = Base(replace(world, robots=job.robots), {p: replace(own, proposal=p) for p in PROPOSALS})
    trial = experiments.usual(base, job.robots, PROPOSALS[0], job.seed)
    exploration = experiments.explore(base, trial)
    return [
        _row(exploration, base, proposal, count)
        for proposal in PROPOSALS
        for count in job.particles
    ]


def _row(exploration: Exploration, base: Base, proposal: str, particles: int) -> Row:
    filter_settings = replace(base.filters[proposal], particles=particles)
    run, pipeline = experiments.estimate(exploration, filter_settings)
    figures = evaluation.evaluate(refinement.complete(run, pipeline, with_refined=True))
    own = {
        "proposal": proposal,
        "robots": len(run.robots),
        "particles": particles,
        "seed": exploration.seed,
        "ancestors": _early_ancestors(pipeline),
    }
    return Row(**own, **{f.name: figures[f.name] for f in fields(Row) if f.name not in own})


def _early_ancestors(pipeline: Pipeline) -> int:
    counts = pipeline.distinct_ancestors()
    return int(counts[len(counts) // 10])


def write(rows: list[Row], folder: Path) -> None:
    """`accuracy.csv`, a row a run, and `accuracy.md`, mean and standard deviation over seeds."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [field.name for field in fields(Row)]
    with (folder / "accuracy.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows([_plain(getattr(row, name)) for name in names] for row in rows)
    (folder / "accuracy.md").write_text(markdown(rows))


def markdown(rows: list[Row]) -> str:
    """The table of `docs/results.md`: mean ± standard deviation over the seeds, NEES the median.

    The NEES of a particle set that has collapsed to a point is beyond all bounds, so its mean over
    seeds would say nothing.
    """
    head = (
        "proposal",
        "K",
        "M",
        "yardstick [m]",
        "odometry",
        "best particle",
        "mean",
        "refined",
        "published",
        "recall",
        "pose NEES",
        "landmark NEES",
        "ancestors",
    )
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 1)]
    groups = {(row.proposal, row.robots, row.particles): [] for row in rows}
    for row in rows:
        groups[row.proposal, row.robots, row.particles].append(row)
    for key, group in groups.items():
        lines.append("| " + " | ".join([*map(str, key), *_cells(group)]) + " |")
    return "\n".join(lines) + "\n"


def _cells(group: list[Row]) -> list[str]:
    batch = _column(group, "batch_path_rmse_m")
    ratios = ("odometry", "", "mean", "refined", "online")
    names = [f"{ratio}_path_rmse_m".removeprefix("_") for ratio in ratios]
    return [
        _spread(batch, ".3f"),
        *(_spread(_column(group, name) / batch, ".2f") for name in names),
        _spread(_column(group, "association_recall"), ".3f"),
        f"{np.nanmedian(_column(group, 'pose_nees')):.3g}",
        f"{np.nanmedian(_column(group, 'landmark_nees')):.3g}",
        _spread(_column(group, "ancestors"), ".1f"),
    ]


def _column(group: list[Row], name: str) -> np.ndarray:
    values = [getattr(row, name) for row in group]
    return np.array([np.nan if value is None else value for value in values], float)


def _spread(values: np.ndarray, form: str) -> str:
    return f"{np.nanmean(values):{form}} ± {np.nanstd(values):{form}}"


def _plain(value: object) -> object:
    return f"{value:.6g}" if isinstance(value, float) else value
