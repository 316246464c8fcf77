"""How well a team of real robots is located: set-ups x filters x seeds -> table.

A recording with known truth (`datasets.mrclam`) is estimated by the team together, with and without
the robots' sightings of each other, and by each robot alone. A robot alone drifts with its map as a
whole, so it is judged after alignment, too.
"""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from multi_robot_slam import runs
from multi_robot_slam.config import Config
from multi_robot_slam.datasets import bag, mrclam
from multi_robot_slam.datasets.recording import Recording
from multi_robot_slam.filter.settings import NO_REJUVENATION, FilterSettings
from multi_robot_slam.pipeline import offline, refinement
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs.trajectory_errors import rmse, sampled
from multi_robot_slam.studies import filtering_optimum, real_table, table
from multi_robot_slam.studies.real_table import (
    ALONE,
    FILTERS,
    LANDMARKS,
    REJUVENATED,
    SIGHTINGS,
    TEAM,
    Key,
    Row,
)

PROPOSALS: dict[str, Literal["motion", "informed"]] = {"informed": "informed", "motion": "motion"}
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

    @property
    def keys(self) -> set[Key]:
        """Those of its rows."""
        robots = self.config.robots
        names = (*robots, TEAM) if len(robots) > 1 else robots
        seed, particles = self.config.seed, self.config.filter.particles
        return {(self.setup, self.filter, name, seed, particles) for name in names}


def study(
    folder: Path,
    out: Path,
    seeds: range,
    particles: int,
    execute: table.Execute,
    on_progress: Callable[[float, float], None] = lambda done, total: None,
) -> list[Row]:
    """Bring `out/real.csv` to hold every run of the `seeds`; rows it has are not computed again.

    The recording in `folder` becomes the bag `out/bag`. Returns the rows asked for, in a fixed
    order, which `out/real.md` summarises.
    """
    path = out / "bag"
    # Read before the folder is claimed: one that holds no recording leaves nothing behind.
    recording = None if path.exists() else mrclam.read(folder)
    source = {"recording": str(folder.resolve()), "rate_hz": RATE_HZ}
    table.claim(out, yaml.safe_dump(source, sort_keys=False))
    if recording is not None:
        _convert(recording, path)
    config = offline.recorded_config(path)
    if config is None:
        raise AssertionError("what was just converted has its configuration")
    jobs = plan(path, config, seeds, particles)
    kept = real_table.opened(out / "real.csv")
    todo = [job for job in jobs if not job.keys <= kept.rows.keys()]
    table.fill(kept, todo, compute, _keyed, execute, on_progress)
    wanted = set().union(*(job.keys for job in jobs))
    rows = [kept.rows[key] for key in sorted(wanted, key=real_table.order)]
    (out / "real.md").write_text(real_table.markdown(rows))
    return rows


def _convert(recording: Recording, path: Path) -> None:
    """Make the bag of the recording, which is there whole or not at all."""
    new = path.parent / "converting" / "bag"
    shutil.rmtree(new.parent, ignore_errors=True)
    bag.write(recording, new, RATE_HZ)
    new.rename(path)
    new.parent.rmdir()


def _keyed(job: Job, rows: list[Row]) -> dict[Key, Row]:
    return {real_table.key_of(row): row for row in rows}


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
        start_sigmas=config.start_sigmas[robot : robot + 1],
        mounts=config.mounts[robot : robot + 1],
        sightings=False,
    )


def compute(job: Job) -> list[Row]:
    """Run the filter over the bag, refine, and judge."""
    pipeline = Pipeline(job.config)
    predictions = runs.Predictions()
    sent = offline.events(job.bag, job.config)
    steps = offline.run_through(pipeline, sent, on_prediction=predictions.add)
    recorded = runs.recorded(job.bag, job.config.robots)
    run = offline.assemble(pipeline, recorded, steps, predictions)
    lineage = pipeline.lineage()
    refined = refinement.refine(lineage, run.landmarks, job.config, pipeline.team)
    run = run.with_paths(mean=pipeline.mean_trajectories(), refined=refined.paths)
    run = replace(run, refined_landmarks=refined.landmarks)
    optimum: dict[str, np.ndarray] = {}
    if job.with_yardstick:
        run = refinement.measured(run, lineage)
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
