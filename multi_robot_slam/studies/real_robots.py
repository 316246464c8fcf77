"""How well a team of real robots is located: set-ups x filters x seeds -> table.

A recording with known truth (`datasets.mrclam`) is estimated by the team together, with and without
the robots' sightings of each other, and by each robot alone. A robot alone drifts with its map as a
whole, so it is judged after alignment, too.
"""

import csv
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from multi_robot_slam import runs
from multi_robot_slam.config import Config
from multi_robot_slam.datasets import bag, mrclam
from multi_robot_slam.filter.settings import NO_REJUVENATION, FilterSettings
from multi_robot_slam.pipeline import offline, refinement
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs.trajectory_errors import rmse, sampled
from multi_robot_slam.studies import filtering_optimum

SIGHTINGS, LANDMARKS, ALONE = "together, sightings", "together", "alone"
SETUPS = (SIGHTINGS, LANDMARKS, ALONE)
REJUVENATED = "rejuvenated"
PROPOSALS: dict[str, Literal["motion", "informed"]] = {"informed": "informed", "motion": "motion"}
FILTERS = (REJUVENATED, *PROPOSALS)
"""The bag's own, and both proposals without rejuvenation, which takes the odometry as it is."""
TEAM = "team"
OPTIMUM_EVERY = 10
RATE_HZ = 1.0
"""Frames of each robot: at 2 and 4 Hz the same readings, correlated as they are, tell no more."""


@dataclass(frozen=True)
class Job:
    """One run of the filter over the bag."""

    bag: Path
    config: Config
    setup: str
    filter: str
    with_yardstick: bool
    """The yardstick is that of the recording and the same for all seeds: one run computes it."""


@dataclass(frozen=True)
class Row:
    """Figures of one robot in one run, or of the whole team."""

    setup: str
    filter: str
    robot: str
    seed: int
    particles: int
    odometry_path_rmse_m: float
    online_path_rmse_m: float
    optimum_rmse_m: float | None
    """Of the filtering optimum, every OPTIMUM_EVERY steps: with the true identities, and all of
    what was known at that instant."""
    online_path_aligned_rmse_m: float
    online_heading_rmse_rad: float
    online_mean_path_rmse_m: float
    path_rmse_m: float
    mean_path_rmse_m: float
    refined_path_rmse_m: float
    refined_path_aligned_rmse_m: float
    batch_path_rmse_m: float | None
    batch_path_aligned_rmse_m: float | None
    landmark_rmse_m: float
    """Of the map, one landmark for each true one: `map_rmse_m` of `result.json`."""
    landmark_aligned_rmse_m: float
    refined_landmark_rmse_m: float
    rejected: int
    """Observations outside the gate of what they look like."""
    duplicates: int
    """Landmarks beyond the first of each true one."""


Execute = Callable[[Callable[[Job], list[Row]], list[Job]], Iterator[tuple[Job, list[Row]]]]
"""Runs a function on jobs: `scheduling.local`."""


def study(
    folder: Path,
    out: Path,
    seeds: int,
    particles: int,
    execute: Execute,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    first_seed: int = 0,
) -> list[Row]:
    """All rows of `seeds` seeds from the first on, in a fixed order.

    The recording in `folder` becomes the new bag `out`/bag.
    """
    path = out / "bag"
    bag.write(mrclam.read(folder), path, RATE_HZ)
    config = offline.recorded_config(path)
    if config is None:
        raise AssertionError("what was just converted has its configuration")
    jobs = plan(path, config, range(first_seed, first_seed + seeds), particles)
    rows: list[Row] = []
    for done, (_, answer) in enumerate(execute(compute, jobs), start=1):
        rows += answer
        on_progress(done, len(jobs))

    def order(row: Row) -> tuple[int, int]:
        return SETUPS.index(row.setup), FILTERS.index(row.filter)

    return sorted(rows, key=lambda row: (*order(row), row.robot, row.seed))


def plan(path: Path, config: Config, seeds: range, particles: int) -> list[Job]:
    """Every run of the study."""
    jobs = []
    for seed in seeds:
        for name in FILTERS:
            own = replace(config, seed=seed, filter=_filter(name, config.filter, particles))
            teams = [(SIGHTINGS, own), (LANDMARKS, replace(own, sightings=False))]
            teams += [(ALONE, _alone(own, robot)) for robot in range(len(own.robots))]
            is_first = seed == seeds[0] and name == REJUVENATED
            jobs += [Job(path, team, setup, name, is_first) for setup, team in teams]
    return jobs


def _filter(name: str, own: FilterSettings, particles: int) -> FilterSettings:
    own = replace(own, particles=particles, threads=1)
    if name == REJUVENATED:
        return own
    return replace(own, proposal=PROPOSALS[name], rejuvenation=NO_REJUVENATION)


def _alone(config: Config, robot: int) -> Config:
    return replace(
        config,
        robots=(config.robots[robot],),
        start_poses=(config.start_poses[robot],),
        mounts=config.mounts[robot : robot + 1],
        sightings=False,
    )


def compute(job: Job) -> list[Row]:
    """Run the filter over the bag, refine, and judge."""
    pipeline = Pipeline(job.config)
    steps = offline.run_through(pipeline, offline.events(job.bag, job.config))
    run = offline.assemble(pipeline, runs.recorded(job.bag, job.config.robots), steps)
    lineage = pipeline.lineage()
    refined = refinement.refine(lineage, run.landmarks, job.config)
    run = run.with_paths(mean=pipeline.mean_trajectories(), refined=refined.paths)
    run = replace(run, refined_landmarks=refined.landmarks)
    optimum: dict[str, np.ndarray] = {}
    if job.with_yardstick:
        run = refinement.with_yardstick(run, lineage)
        optimum = optimum_errors(run, lineage)
    return rows_of(run, job.setup, job.filter, optimum)


def optimum_errors(run: runs.Run, lineage: refinement.Lineage) -> dict[str, np.ndarray]:
    """(T, 2) [m] of each robot, and of all under TEAM."""
    paths = filtering_optimum.poses(lineage, run.observation_truth, run.config, OPTIMUM_EVERY)
    errors = {}
    for name, path in paths.items():
        truth = run.robots[name].truth
        if truth is not None:
            known = sampled(truth, path.stamps_ns)
            own = path.poses[np.isin(path.stamps_ns, known.stamps_ns)]
            errors[name] = (own - known.poses)[:, :2]
    return errors | {TEAM: np.concatenate(list(errors.values()))}


def rows_of(
    run: runs.Run, setup: str, filter_name: str, optimum: Mapping[str, np.ndarray]
) -> list[Row]:
    """A row for each robot, and one for a team of several."""
    result = runs.evaluate(run)
    frames = [frame for step in run.steps for frame in step.frames]
    places = {
        "landmark_rmse_m": result["map_rmse_m"],
        "landmark_aligned_rmse_m": result["map_aligned_rmse_m"],
        "refined_landmark_rmse_m": result["refined_map_rmse_m"],
        "rejected": sum(int(frame.is_rejected.sum()) for frame in frames),
        "duplicates": result["duplicates"],
    }
    own: dict[str, Any] = {"setup": setup, "filter": filter_name, "seed": run.config.seed}
    own |= {"particles": run.config.filter.particles} | places
    figures = result["robots"] | ({TEAM: result} if len(run.robots) > 1 else {})
    names = [
        field.name for field in fields(Row) if field.name not in {*own, "robot", "optimum_rmse_m"}
    ]
    return [
        Row(
            robot=robot,
            optimum_rmse_m=rmse(optimum[robot]) if optimum else None,
            **own,
            **{name: values[name] for name in names},
        )
        for robot, values in figures.items()
    ]


def write(rows: list[Row], folder: Path) -> None:
    """`real.csv`, a row a robot and run, and `real.md`, mean and deviation over seeds."""
    names = [field.name for field in fields(Row)]
    with (folder / "real.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows([_plain(getattr(row, name)) for name in names] for row in rows)
    (folder / "real.md").write_text(markdown(rows))


COLUMNS = {
    "online_path_rmse_m": "live",
    "online_path_aligned_rmse_m": "live, aligned",
    "online_heading_rmse_rad": "live heading [rad]",
    "online_mean_path_rmse_m": "live mean",
    "optimum_rmse_m": "filtering optimum",
    "path_rmse_m": "after the run",
    "mean_path_rmse_m": "after the run, mean",
    "refined_path_rmse_m": "refined",
    "refined_path_aligned_rmse_m": "refined, aligned",
    "batch_path_rmse_m": "yardstick",
    "batch_path_aligned_rmse_m": "yardstick, aligned",
    "odometry_path_rmse_m": "odometry",
    "landmark_rmse_m": "landmarks",
    "landmark_aligned_rmse_m": "landmarks, aligned",
    "refined_landmark_rmse_m": "landmarks, refined",
    "rejected": "rejected",
    "duplicates": "duplicates",
}
"""Figures of the table, RMS errors in metres but where it says otherwise."""


def markdown(rows: list[Row]) -> str:
    """A table of mean ± standard deviation over the seeds, for each set-up, filter and robot."""
    head = ("set-up", "filter", "robot", *COLUMNS.values())
    lines = ["| " + " | ".join(head) + " |", "|---|---|---|" + "---:|" * len(COLUMNS)]
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.setup, row.filter, row.robot), []).append(row)
    for key, group in groups.items():
        cells = [_cell([getattr(row, name) for row in group]) for name in COLUMNS]
        lines.append("| " + " | ".join([*key, *cells]) + " |")
    return "\n".join(lines) + "\n"


def _cell(values: list[float | None]) -> str:
    known = np.array([value for value in values if value is not None], float)
    if not len(known):
        return "-"
    form = ".0f" if all(isinstance(value, int) for value in values) else ".3f"
    return (
        f"{known.mean():{form}} ± {known.std():{form}}" if len(known) > 1 else f"{known[0]:{form}}"
    )


def _plain(value: object) -> object:
    return f"{value:.6g}" if isinstance(value, float) else value
