"""Simulated teams: the settings of all that take part, and bags of them made without ROS."""

from dataclasses import replace
from pathlib import Path

from msg_defs import scenario_file, topics, wire
from multi_robot_slam.bags import BagWriter
from multi_robot_slam.cli.configuration import merged, of_pictures
from multi_robot_slam.cli.terminal import countdown
from multi_robot_slam.config import SECTION, UNKNOWN, Config, StartPose
from sim_world import messages
from sim_world.robot import START_NS
from sim_world.scenario import SECTION as WORLD_SECTION
from sim_world.scenario import Scenario
from sim_world.simulator import Simulation
from sim_world.team import team_scenario

OTHER_DAY = 0.6
"""Where along the tour robots start that come into a map [share of it]: between where three, four
or five did the day before."""


def configure(
    scenario: str,
    robots: int | None = None,
    seed: int = 0,
    rate_hz: float | None = None,
    laps: int | None = None,
    images: bool = False,
    start_offset: float | None = None,
) -> tuple[Scenario, Config]:
    """Every setting of both packages for a simulated team.

    What is None is the scenario's; `seed` is the filter's. Where robots send pictures, what the
    scenario leaves out is what pictures need. See `team_scenario`.
    """
    team = team_scenario(scenario, robots, rate_hz, laps, images, start_offset)
    world = scenario_file.from_yaml(Scenario, team, WORLD_SECTION, scenario)
    stated = scenario_file.sections(team, scenario)[SECTION]
    if world.images.enabled:
        stated = merged(of_pictures(), stated)
    config = scenario_file.from_mapping(Config, stated, f"{scenario}: {SECTION}")
    return world, replace(config, seed=seed)


def with_unknown_starts(config: Config, are_told: int) -> Config:
    """Nobody tells where the robots start, but of so many of the first."""
    unknown: list[StartPose] = [UNKNOWN for _ in config.robots[are_told:]]
    return replace(config, start_poses=(*config.start_poses[:are_told], *unknown))


def to_yaml(world: Scenario, config: Config) -> str:
    """The settings of both packages as one scenario."""
    return scenario_file.to_yaml(**{WORLD_SECTION: world, SECTION: config})


def write_bag(world: Scenario, config: Config, bag: Path) -> None:
    """Simulate the team into the new `bag`, one instant after the other, with a progress bar.

    The bag has what a recorder of the robots and their fusion's configuration would leave, each
    message at its stamp. Pictures are PNG unless the scenario says otherwise.
    """
    simulation = Simulation(world, config.seed)
    text = wire.encode_text(scenario_file.to_yaml(**{SECTION: config}))
    with BagWriter(bag) as writer, countdown() as progress:
        for topic, data in [*messages.of_world(simulation), (topics.FUSION_CONFIG, text)]:
            writer.write(topic, START_NS, data)
        say = messages.teller(simulation, "png")
        steps = progress.track(simulation.steps(), simulation.instants, description=f"{bag}")
        for instant in steps:
            for step in instant:
                for topic, data in say(step):
                    writer.write(topic, step.odometry.stamp_ns, data)
