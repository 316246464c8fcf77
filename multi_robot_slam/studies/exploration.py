"""One exploration: a simulated team and its filter, in this process and without ROS."""

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from msg_defs.types import LandmarkMap, Trajectory, Walls
from multi_robot_slam import runs
from multi_robot_slam.config import Config, Keyframe
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.pipeline import offline, refinement
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.studies.experiment_table import Trial
from sim_world.scenario import Scenario, Tour
from sim_world.simulator import RobotStep, Simulation


@dataclass(frozen=True)
class Base:
    """What all runs have in common: the world, and the filter behind each proposal."""

    scenario: Scenario
    filters: dict[str, FilterSettings]
    """motion: the paper's. informed: this package's own, with its defaults."""
    keyframe: Keyframe
    """Which frames become steps."""


@dataclass(frozen=True, eq=False)
class Exploration:
    """A simulated exploration: all that the robots reported, and the truth."""

    scenario: Scenario
    seed: int
    keyframe: Keyframe
    """Which frames become steps."""
    start_poses: dict[str, np.ndarray]
    instants: list[tuple[RobotStep, ...]]
    truth: dict[str, Trajectory]
    landmarks: LandmarkMap
    walls: Walls


def explore(base: Base, trial: Trial) -> Exploration:
    """Simulate the exploration of a trial."""
    scenario = replace(
        base.scenario,
        robots=trial.robots,
        observations=trial.observations,
        d_max_m=trial.d_max_m,
        descriptor_noise=trial.descriptor_noise,
        trajectory=cast(Tour, trial.trajectory),
        start_offset=trial.start_offset,
    )
    simulation = Simulation(scenario, trial.seed)
    return Exploration(
        scenario,
        trial.seed,
        base.keyframe,
        simulation.start_poses,
        list(simulation.steps()),
        {name: simulation.truth_path(name) for name in scenario.names},
        simulation.landmarks,
        simulation.walls,
    )


def configure(
    simulated: Exploration | Simulation, keyframe: Keyframe, filter_settings: FilterSettings
) -> Config:
    """The estimate's configuration for a simulated team, whose start poses are known."""
    starts = simulated.start_poses
    return Config(
        robots=tuple(starts),
        start_poses=tuple((float(x), float(y), float(yaw)) for x, y, yaw in starts.values()),
        start_sigma=(0.0, 0.0),
        seed=simulated.seed,
        mount=simulated.scenario.camera.mount,
        keyframe=keyframe,
        filter=filter_settings,
    )


def estimate(
    exploration: Exploration, filter_settings: FilterSettings
) -> tuple[runs.Run, Pipeline]:
    """The filter's run over the exploration, and the pipeline at its end."""
    pipeline = Pipeline(configure(exploration, exploration.keyframe, filter_settings))
    pipeline.warm_up()
    sent = (
        event for instant in exploration.instants for robot in instant for event in robot.events
    )
    predictions = runs.Predictions()
    steps = offline.run_through(pipeline, sent, on_prediction=predictions.add)
    run = offline.assemble(pipeline, recorded(exploration), steps, predictions)
    return run, pipeline


def recorded(exploration: Exploration) -> runs.Recorded:
    """What is known of it beside the estimate: odometry, and the truth."""
    by_robot = list(zip(*exploration.instants, strict=True))
    truths = [t for steps in by_robot for robot in steps if (t := robot.observation_truth)]
    return runs.Recorded(
        odometry={
            steps[0].odometry.robot: runs.trajectory(step.odometry for step in steps)
            for steps in by_robot
        },
        truth=exploration.truth,
        true_landmarks=exploration.landmarks,
        walls=exploration.walls,
        observation_truth={(truth.robot, truth.stamp_ns): truth.landmarks for truth in truths},
    )


def filter_of(base: Base, trial: Trial) -> FilterSettings:
    """The settings of a trial's filter."""
    return replace(base.filters[trial.proposal], particles=trial.particles)


def batch_paths(exploration: Exploration, base: Base) -> dict[str, Trajectory]:
    """The paths by least squares with the true associations, for comparison.

    The search starts from the path of one particle, so that the answer is the same to the last
    digit whichever filters it is compared with.
    """
    run, pipeline = estimate(exploration, replace(base.filters["informed"], particles=1))
    paths = refinement.yardstick(
        pipeline.lineage(), run.observation_truth, run.config, pipeline.team
    )
    if paths is None:
        raise ValueError("an exploration without frames has no solution")
    return paths
