"""One run of the filter over what cameras saw, in this process, and the figures of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from msg_defs.types import Event
from multi_robot_slam import runs
from multi_robot_slam.config import Config
from multi_robot_slam.pipeline import offline, refinement
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs import consistency
from multi_robot_slam.studies.cameras_table import TEAM, Row
from multi_robot_slam.studies.front_end import PoseSigma
from multi_robot_slam.studies.revisits import Revisits, revisits

EXACT = PoseSigma()


@dataclass(frozen=True, eq=False)
class Session:
    """What a team reported, and what is true of it."""

    config: Config
    events: Sequence[Event]
    """By time."""
    recorded: runs.Recorded


def estimate(session: Session, with_batch: bool) -> runs.Run:
    """The filter's run, with the mean path, and with least squares where it is wanted."""
    pipeline = Pipeline(session.config, keeps_frames=with_batch)
    pipeline.warm_up()
    predictions = runs.Predictions()
    steps = offline.run_through(pipeline, session.events, on_prediction=predictions.add)
    run = offline.assemble(pipeline, session.recorded, steps, predictions)
    return refinement.complete(run, pipeline, with_yardstick=with_batch)


def rows_of(run: runs.Run, setup: str, truth: PoseSigma = EXACT) -> list[Row]:
    """A row for each robot, and one for a team of several.

    `truth` is how far the true poses may be off: an error is then due to both.
    """
    result = runs.evaluate(run)
    of_truth = np.diag([truth.place_m, truth.place_m, truth.angle_rad]) ** 2
    errors = {
        robot: (error, covariance + of_truth)
        for robot, (error, covariance) in consistency.published_errors(run).items()
    }
    found = revisits(run, dict(enumerate(_places(run))))
    figures = {TEAM: result} if len(run.robots) > 1 else {}
    figures |= result["robots"]
    return [
        _row(run, setup, robot, values, _nees(errors, robot), found)
        for robot, values in figures.items()
    ]


def _places(run: runs.Run) -> np.ndarray:
    landmarks = run.true_landmarks
    return np.empty((0, 3)) if landmarks is None else landmarks.positions


def _nees(errors: dict[str, tuple[np.ndarray, np.ndarray]], robot: str) -> np.ndarray:
    own = errors.values() if robot == TEAM else [errors[robot]]
    return np.concatenate([consistency.normalised(*parts) for parts in own])


def _row(
    run: runs.Run,
    setup: str,
    robot: str,
    figures: dict[str, Any],
    nees: np.ndarray,
    found: Revisits,
) -> Row:
    names = (
        "odometry_path_rmse_m",
        "online_path_rmse_m",
        "path_rmse_m",
        "batch_path_rmse_m",
        "online_heading_rmse_rad",
        "association_precision",
        "association_recall",
    )
    of_all = robot == TEAM or len(run.robots) == 1
    return Row(
        setup=setup,
        robot=robot,
        seed=run.config.seed,
        particles=run.config.filter.particles,
        **{name: figures[name] for name in names},
        revisits=found.seen if of_all else None,
        revisit_precision=found.precision if of_all else None,
        revisit_recall=found.recall if of_all else None,
        pose_nees=float(nees.mean()) if len(nees) else None,
        pose_nees_median=float(np.median(nees)) if len(nees) else None,
    )


def seeded(config: Config, seed: int, particles: int) -> Config:
    """The configuration of one run of a study: one thread, since there is a process a core."""
    return replace(config, seed=seed, filter=replace(config.filter, particles=particles, threads=1))
