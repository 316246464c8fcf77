"""How close the filter comes to the best possible answer: particles x filters x seeds -> table.

The yardstick is batch least squares with the true associations on the same run, and for the poses
as published the same over what was known at each instant. All ratios are of RMS errors of position.
"""

import csv
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path

import numpy as np

from msg_defs import scenario_file
from msg_defs.errors import InputError
from msg_defs.types import Trajectory
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.pipeline import refinement
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs import Run, evaluation
from multi_robot_slam.runs.trajectory_errors import at, rmse
from multi_robot_slam.studies import experiments, filtering_optimum
from multi_robot_slam.studies.experiments import Base, Exploration
from sim_world.scenario import SECTION as WORLD_SECTION
from sim_world.scenario import Scenario

TEAMS = (1, 2, 3)
REJUVENATED = "rejuvenated"
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
class Row:
    """Figures of one run."""

    filter: str
    robots: int
    particles: int
    seed: int
    odometry_path_rmse_m: float
    batch_path_rmse_m: float
    path_rmse_m: float
    mean_path_rmse_m: float
    refined_path_rmse_m: float
    online_path_rmse_m: float
    optimum_ratio: float
    """RMS error of the poses as published over that of the filtering optimum, at its instants."""
    association_precision: float
    association_recall: float
    pose_nees: float
    landmark_nees: float
    ancestors: int
    """Distinct ancestors at a tenth of the run, of the particles at its end."""
    step_ms_mean: float
    step_ms_max: float


HEADER = tuple(field.name for field in fields(Row))
Key = tuple[str, int, int, int]
"""Filter, robots, particles, seed: the first columns."""


@dataclass(frozen=True)
class Job:
    """One exploration, and the runs over it."""

    base: Base
    robots: int
    seed: int
    runs: tuple[tuple[str, int], ...]
    """Filter and particles of each."""


def calibrated(resample_below: float = 0.5, rest: int | None = None) -> Base:
    """The calibrated scenario, and the filters that are compared in it, one thread each.

    `rest` replaces that of the scenario's rejuvenation.
    """
    path = scenario_file.find_scenario("calibrated")
    own = scenario_file.from_file(Config, path, SECTION).filter
    own = replace(own, threads=1, resample_below=resample_below)
    often = own.rejuvenation if rest is None else replace(own.rejuvenation, rest=rest)
    never = replace(own.rejuvenation, ancestors_below=0.0)
    filters = {p: replace(own, proposal=p, rejuvenation=never) for p in ("motion", "informed")}
    filters[REJUVENATED] = replace(own, rejuvenation=often)
    return Base(scenario_file.from_file(Scenario, path, WORLD_SECTION), filters)


def filters_of(names: str) -> tuple[str, ...]:
    """Filters from text such as informed,rejuvenated."""
    chosen = tuple(dict.fromkeys(names.split(",")))
    if unknown := [name for name in chosen if name not in PARTICLES]:
        raise InputError(f"no filter '{unknown[0]}'; there are {', '.join(PARTICLES)}")
    return chosen


def study(
    folder: Path,
    base: Base,
    repeats: int,
    particles: Mapping[str, Sequence[int]],
    execute: Callable[[Callable[[Job], list[Row]], list[Job]], Iterator[tuple[Job, list[Row]]]],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Row]:
    """Bring `folder/accuracy.csv` to hold the runs of every filter in `particles`, seeds 0 on.

    Rows it has are not computed again. Returns the rows asked for, in a fixed order, which
    `folder/accuracy.md` summarises.
    """
    experiments.claim(folder, base)
    path = folder / "accuracy.csv"
    known = {_key(row): row for row in read(path)}
    write(path, known.values())
    wanted = [
        (name, robots, count, seed)
        for name in particles
        for robots in TEAMS
        for count in particles[name]
        for seed in range(repeats)
    ]
    jobs = _jobs(base, [key for key in wanted if key not in known])
    on_progress(0, len(jobs))
    for done, (_, rows) in enumerate(execute(compute, jobs) if jobs else (), start=1):
        append(path, rows)
        known |= {_key(row): row for row in rows}
        on_progress(done, len(jobs))
    write(path, [known[key] for key in sorted(known)])
    rows = [known[key] for key in sorted(wanted)]
    (folder / "accuracy.md").write_text(markdown(rows))
    return rows


def _key(row: Row) -> Key:
    return astuple(row)[:4]


def _jobs(base: Base, keys: list[Key]) -> list[Job]:
    """The runs by exploration."""
    jobs = {}
    for name, robots, count, seed in keys:
        jobs.setdefault((robots, seed), []).append((name, count))
    return [Job(base, *exploration, tuple(runs)) for exploration, runs in jobs.items()]


def compute(job: Job) -> list[Row]:
    """Simulate the team, and estimate with every filter."""
    base = replace(job.base, scenario=replace(job.base.scenario, robots=job.robots))
    trial = experiments.usual(base, job.robots, "informed", job.seed)
    exploration = experiments.explore(base, trial)
    anyone, pipeline = experiments.estimate(
        exploration, replace(base.filters["informed"], particles=1)
    )
    optimum = filtering_optimum.poses(
        pipeline.lineage(), anyone.observation_truth, anyone.config, OPTIMUM_EVERY
    )
    return [
        _row(exploration, optimum, name, replace(base.filters[name], particles=count))
        for name, count in job.runs
    ]


def _row(
    exploration: Exploration,
    optimum: Mapping[str, Trajectory],
    name: str,
    filter_settings: FilterSettings,
) -> Row:
    run, pipeline = experiments.estimate(exploration, filter_settings)
    figures = evaluation.evaluate(refinement.complete(run, pipeline, with_refined=True))
    own = {
        "filter": name,
        "robots": len(run.robots),
        "particles": filter_settings.particles,
        "seed": exploration.seed,
        "optimum_ratio": optimum_ratio(run, optimum),
        "ancestors": _early_ancestors(pipeline),
    }
    return Row(**own, **{column: figures[column] for column in HEADER if column not in own})


def optimum_ratio(run: Run, optimum: Mapping[str, Trajectory]) -> float:
    """RMS error of position of the published poses over that of the `optimum`, at its stamps."""
    published, best = [], []
    for name, path in optimum.items():
        robot = run.robots[name]
        truth = at(robot.truth, path.stamps_ns)[:, :2]
        published.append(at(robot.online, path.stamps_ns)[:, :2] - truth)
        best.append(path.poses[:, :2] - truth)
    return rmse(np.concatenate(published)) / rmse(np.concatenate(best))


def _early_ancestors(pipeline: Pipeline) -> int:
    counts = pipeline.distinct_ancestors()
    return int(counts[len(counts) // 10])


def read(path: Path) -> list[Row]:
    """The rows of the table at `path`, none if it does not exist; a last line cut off is left."""
    try:
        text = path.read_text()
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {error}") from None
    lines = list(csv.reader(text.splitlines(keepends=True)))
    if lines[:1] != [list(HEADER)]:
        raise InputError(f"{path} has other columns than this version writes; use another --out")
    whole = lines[1:] if text.endswith("\n") else lines[1:-1]
    return [_parsed(path, cells) for cells in whole]


def _parsed(path: Path, cells: list[str]) -> Row:
    try:
        return Row(*(f.type(c) for f, c in zip(fields(Row), cells, strict=True)))
    except ValueError:
        raise InputError(f"{path}: '{','.join(cells)}' is no row of it; remove it") from None


def write(path: Path, rows: Sequence[Row]) -> None:
    """Write the whole table in place of the old one."""
    new = path.with_suffix(".new")
    new.write_text("".join([_line(HEADER), *map(_line, map(astuple, rows))]))
    os.replace(new, path)


def append(path: Path, rows: Sequence[Row]) -> None:
    """Add rows to the table, at once and for good."""
    with path.open("a") as file:
        file.writelines(map(_line, map(astuple, rows)))
        file.flush()
        os.fsync(file.fileno())


def _line(cells: Sequence[object]) -> str:
    return ",".join(f"{c:.6g}" if isinstance(c, float) else str(c) for c in cells) + "\n"


def markdown(rows: Sequence[Row]) -> str:
    """The table of `docs/results.md`: mean ± standard deviation over the seeds.

    NEES is the mean over the seeds where particles are rejuvenated, and the median elsewhere: that
    of a particle set that has collapsed to a point is beyond all bounds, and its mean would say
    nothing.
    """
    head = (
        "filter",
        "K",
        "M",
        "yardstick [m]",
        "odometry",
        "best particle",
        "mean",
        "refined",
        "published",
        "published / optimum",
        "recall",
        "pose NEES",
        "landmark NEES",
        "ancestors",
    )
    lines = ["| " + " | ".join(head) + " |", "|---|" + "---:|" * (len(head) - 1)]
    groups = {}
    for row in rows:
        groups.setdefault((row.filter, row.robots, row.particles), []).append(row)
    for key, group in groups.items():
        lines.append("| " + " | ".join([*map(str, key), *_cells(group)]) + " |")
    return "\n".join(lines) + "\n"


def _cells(group: list[Row]) -> list[str]:
    batch = _column(group, "batch_path_rmse_m")
    kinds = ("odometry_", "", "mean_", "refined_", "online_")
    centre = np.mean if group[0].filter == REJUVENATED else np.median
    return [
        _spread(batch, ".3f"),
        *(_spread(_column(group, f"{kind}path_rmse_m") / batch, ".2f") for kind in kinds),
        _spread(_column(group, "optimum_ratio"), ".2f"),
        _spread(_column(group, "association_recall"), ".3f"),
        f"{centre(_column(group, 'pose_nees')):.3g}",
        f"{centre(_column(group, 'landmark_nees')):.3g}",
        _spread(_column(group, "ancestors"), ".1f"),
    ]


def _column(group: list[Row], name: str) -> np.ndarray:
    return np.array([getattr(row, name) for row in group], float)


def _spread(values: np.ndarray, form: str) -> str:
    return f"{values.mean():{form}} ± {values.std():{form}}"
