"""Hours of a team that drives round and round: does its filter stay as fast, small and honest?"""

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from msg_defs import scenario_file
from msg_defs.errors import InputError
from msg_defs.types import Estimate
from multi_robot_slam.models.motion import wrap
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs.consistency import normalised
from multi_robot_slam.runs.trajectory_errors import rmse
from multi_robot_slam.studies import accuracy, experiments, filtering_optimum, hours_table, table
from multi_robot_slam.studies.exploration import Base, configure
from multi_robot_slam.studies.hours_table import Key, Row, key_of
from multi_robot_slam.studies.live_team import LiveFilter, Taken, instants, sent, team
from sim_world.robot import RobotStep
from sim_world.simulator import Simulation

RATE_HZ = 10.0
LONGEST_PART_S = 600.0
LONGEST_OPTIMUM_S = 1800.0
PICTURES_EVERY = 10
"""Instants: a second."""
KNOWN = 200
"""Instants whose truth is kept: more than a frame waits for another robot."""


@dataclass(frozen=True)
class Plan:
    """What all runs of a study have in common, beside world and filter."""

    robots: int
    particles: int
    seconds: float
    optimum_s: float = 0.0
    """So far from the start the filtering optimum is computed at the end of each part."""


@dataclass(frozen=True)
class Job:
    """One run."""

    base: Base
    plan: Plan
    seed: int


def study(
    folder: Path, base: Base, plan: Plan, seeds: Sequence[int], execute: table.Execute
) -> list[Row]:
    """Bring `folder/hours.csv` to hold the runs of all `seeds`, with `hours.md` beside it.

    Runs it has are not made again. The rows asked for, by seed and part.
    """
    if plan.optimum_s > LONGEST_OPTIMUM_S:
        raise InputError(
            f"optimum = {plan.optimum_s / 60:g} minutes: use {LONGEST_OPTIMUM_S / 60:g} at most; "
            "its memory grows with the square"
        )
    table.claim(folder, experiments.settings(base) + scenario_file.to_yaml(plan=plan))
    kept = hours_table.opened(folder / "hours.csv")
    parts = range(parts_of(plan.seconds))
    keys = {seed: [(plan.robots, plan.particles, seed, part) for part in parts] for seed in seeds}
    missing = [seed for seed in seeds if not kept.rows.keys() >= set(keys[seed])]
    table.fill(kept, [Job(base, plan, seed) for seed in missing], compute, _rows_of, execute)
    rows = [kept.rows[key] for seed in seeds for key in keys[seed]]
    (folder / "hours.md").write_text(hours_table.markdown(rows))
    return rows


def parts_of(seconds: float) -> int:
    """Rows of a run: tenths of it, or parts of these that are ten minutes at most."""
    of_a_tenth = np.ceil(seconds / hours_table.PARTS / LONGEST_PART_S)
    return int(hours_table.PARTS * max(of_a_tenth, 1))


def _rows_of(job: Job, rows: list[Row]) -> dict[Key, Row]:
    return {key_of(row): row for row in rows}


def compute(job: Job) -> list[Row]:
    """Simulate and estimate, one instant after the other; says how far it is on stderr."""
    plan, base = job.plan, job.base
    scenario = team(base.scenario, plan.robots, RATE_HZ, plan.seconds)
    simulation = Simulation(scenario, job.seed)
    own = replace(base.filters[accuracy.REJUVENATED], particles=plan.particles, threads=0)
    config = configure(simulation, base.keyframe, own)
    pipeline = Pipeline(config, _tell(job), keeps_frames=plan.optimum_s > 0)
    pipeline.warm_up()
    run = _Run(job, pipeline)
    count, parts = round(plan.seconds * RATE_HZ), parts_of(plan.seconds)
    ends = {count * (part + 1) // parts for part in range(parts)}
    _tell(job)(f"{plan.robots} robots for {plan.seconds / 60:.4g} min")
    for i, instant in enumerate(instants(simulation, plan.seconds)):
        run.take(instant, with_pictures=i % PICTURES_EVERY == 0)
        if i + 1 in ends:
            run.end_part((i + 1) / RATE_HZ)
    return run.with_optimum()


def _tell(job: Job) -> Callable[[str], None]:
    return lambda text: print(f"seed {job.seed}: {text}", file=sys.stderr, flush=True)


class _Run:
    """A run as it goes on, and the rows so far."""

    def __init__(self, job: Job, pipeline: Pipeline) -> None:
        self._job = job
        self._live = LiveFilter(pipeline)
        self._judge = _Judge()
        self._optimum = _Optimum()
        self._pictures: list[float] = []
        self._landmarks = 0
        self._began_s = 0.0
        self._rows: list[Row] = []

    def take(self, instant: tuple[RobotStep, ...], with_pictures: bool) -> None:
        """Hand over what the team sends at one instant."""
        self._judge.learn(instant)
        if self._job.plan.optimum_s:
            self._optimum.learn(instant)
        for topic, data in sent(instant):
            taken = self._live.take(topic, data)
            self._judge.hear(taken)
            self._optimum.hear(taken)
        if with_pictures:
            start = perf_counter()
            self._landmarks = self._live.pictures(instant[0].odometry.stamp_ns)
            self._pictures.append(1e3 * (perf_counter() - start))

    def end_part(self, now_s: float) -> None:
        """Add the row of the part that ends at `now_s`."""
        job, spent, errors = self._job, self._live.spent(), self._judge.taken()
        pipeline = self._live.pipeline
        row = Row(
            robots=job.plan.robots,
            particles=job.plan.particles,
            seed=job.seed,
            part=len(self._rows),
            from_s=self._began_s,
            to_s=now_s,
            steps=spent.steps,
            rejuvenations=errors.rejuvenations,
            position_rmse_m=errors.position(errors.at_steps),
            heading_rmse_rad=errors.heading(errors.at_steps),
            all_position_rmse_m=errors.position(errors.everywhere),
            all_heading_rmse_rad=errors.heading(errors.everywhere),
            nees_mean=_average(np.mean, errors.nees),
            nees_median=_average(np.median, errors.nees),
            step_ms_mean=1e3 * spent.stepping / spent.steps,
            step_ms_max=spent.longest_ms,
            cpu_s_per_s=spent.whole / (now_s - self._began_s),
            pictures_ms_mean=float(np.mean(self._pictures)),
            memory_mb=resident_mb(),
            landmarks=self._landmarks,
            settled=pipeline.settled,
            dropped=pipeline.dropped.total(),
            published_m=None,
            optimum_m=None,
        )
        if now_s <= job.plan.optimum_s:
            self._optimum.note(row.part)
        self._rows.append(row)
        self._pictures.clear()
        self._began_s = now_s
        errors_told = f"error {row.position_rmse_m:.3f} m, NEES {row.nees_mean:.2f}"
        times_told = f"step {row.step_ms_mean:.1f} ms, longest {row.step_ms_max:.0f} ms"
        how_far = f"{now_s / 60:.4g} of {job.plan.seconds / 60:.4g} min"
        _tell(job)(f"{how_far}: {errors_told}, {times_told}, {row.memory_mb:.0f} MB")

    def with_optimum(self) -> list[Row]:
        """The rows, with the optimum where it is wanted."""
        pipeline = self._live.pipeline
        for part, published_m, optimum_m in self._optimum.compute(pipeline):
            row = self._rows[part]
            self._rows[part] = replace(row, published_m=published_m, optimum_m=optimum_m)
            ratio = published_m / optimum_m
            _tell(self._job)(f"at {row.to_s / 60:.4g} min published over optimum {ratio:.3f}")
        return self._rows


@dataclass(frozen=True, eq=False)
class _Errors:
    """Of the poses published in one part."""

    at_steps: np.ndarray
    """(n, 3): x, y [m], yaw [rad]."""
    everywhere: np.ndarray
    """(n + p, 3): the same, and of predictions."""
    nees: np.ndarray
    """(n,)"""
    rejuvenations: int

    @staticmethod
    def position(errors: np.ndarray) -> float:
        """RMS [m]."""
        return rmse(errors[:, :2]) or 0.0

    @staticmethod
    def heading(errors: np.ndarray) -> float:
        """RMS [rad]."""
        return rmse(errors[:, 2]) or 0.0


class _Judge:
    """Compares what is published with the truth."""

    def __init__(self) -> None:
        self._truth: dict[tuple[str, int], np.ndarray] = {}
        self._begin()

    def _begin(self) -> None:
        self._at_steps: list[np.ndarray] = []
        self._covariances: list[np.ndarray] = []
        self._predicted: list[np.ndarray] = []
        self._rejuvenations = 0

    def learn(self, instant: tuple[RobotStep, ...]) -> None:
        """The truth at one instant; what is long ago is forgotten."""
        for step in instant:
            self._truth[step.truth.robot, step.truth.stamp_ns] = step.truth.pose
        while len(self._truth) > KNOWN * len(instant):
            del self._truth[next(iter(self._truth))]

    def hear(self, taken: Taken) -> None:
        """What came of a message."""
        for step in taken.steps:
            self._rejuvenations += step.rejuvenated is not None
            for estimate in step.estimates:
                self._at_steps.append(self._error(estimate))
                self._covariances.append(estimate.covariance)
        if taken.prediction:
            self._predicted.append(self._error(taken.prediction))

    def taken(self) -> _Errors:
        """The errors since this was last asked."""
        at_steps = np.array(self._at_steps).reshape(-1, 3)
        found = _Errors(
            at_steps,
            np.concatenate([at_steps, np.array(self._predicted).reshape(-1, 3)]),
            normalised(at_steps, np.array(self._covariances).reshape(-1, 3, 3)),
            self._rejuvenations,
        )
        self._begin()
        return found

    def _error(self, estimate: Estimate) -> np.ndarray:
        error = estimate.pose - self._truth[estimate.robot, estimate.stamp_ns]
        error[2] = wrap(error[2])
        return error


class _Optimum:
    """What least squares with the true associations would have published."""

    def __init__(self) -> None:
        self._associations: dict[tuple[str, int], np.ndarray] = {}
        self._truth: dict[tuple[str, int], np.ndarray] = {}
        self._frames = 0
        self._latest: dict[str, Estimate] = {}
        self._noted: dict[int, tuple[int, dict[str, Estimate]]] = {}
        """Part -> frames known at its end, and the last estimate of each robot."""

    def learn(self, instant: tuple[RobotStep, ...]) -> None:
        """The truth at one instant."""
        for step in instant:
            key = step.truth.robot, step.truth.stamp_ns
            self._truth[key] = step.truth.pose
            if step.observation_truth is not None:
                self._associations[key] = step.observation_truth.landmarks

    def hear(self, taken: Taken) -> None:
        """What came of a message."""
        for step in taken.steps:
            self._frames += len(step.frames)
            self._latest |= {estimate.robot: estimate for estimate in step.estimates}

    def note(self, part: int) -> None:
        """Compare at the end of this part."""
        self._noted[part] = self._frames, dict(self._latest)

    def compute(self, pipeline: Pipeline) -> list[tuple[int, float, float]]:
        """Part, RMS error as published and of the optimum [m], for each part noted."""
        if not self._noted:
            return []
        lineage, found = pipeline.lineage(), []
        for part, (frames, latest) in self._noted.items():
            best = filtering_optimum.last_poses(
                lineage[:frames], self._associations, pipeline.config
            )
            published = {name: estimate.pose for name, estimate in latest.items()}
            stamps = {name: estimate.stamp_ns for name, estimate in latest.items()}
            published_m, optimum_m = (
                rmse(np.array([p[:2] - self._truth[n, stamps[n]][:2] for n, p in poses.items()]))
                for poses in (published, best)
            )
            assert published_m is not None
            assert optimum_m is not None
            found.append((part, published_m, optimum_m))
        return found


def _average(function: Callable[[np.ndarray], np.floating], values: np.ndarray) -> float:
    """NaN of nothing: a single particle claims certainty throughout."""
    return float(function(values)) if len(values) else np.nan


def resident_mb() -> float:
    """Memory of this process that is in use [MB]."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
