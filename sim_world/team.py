"""One scenario for all nodes of a simulated team."""

from dataclasses import replace

import yaml

from msg_defs import scenario_file
from sim_world.scenario import SECTION, Scenario
from sim_world.simulator import Simulation

ESTIMATE = "multi_robot_slam"
"""The section of the scenario that the fusion reads."""


def team_scenario(name: str, robots: int | None = None) -> str:
    """The scenario `name` as YAML, with what the fusion must know about the simulated team in it.

    These are the robots' names and true start poses, and where the camera sits. All else in the
    fusion's section stays as it is, unchecked: only the fusion knows what belongs there.
    """
    path = scenario_file.find_scenario(name)
    sections = scenario_file.sections(scenario_file.read(path), str(path))
    world = scenario_file.from_mapping(Scenario, sections[SECTION], f"{path}: {SECTION}")
    if robots is not None:
        world = replace(world, robots=robots)
    starts = Simulation(world, seed=0).start_poses
    team = {
        "robots": list(starts),
        "start_poses": [pose.tolist() for pose in starts.values()],
        "mount": scenario_file.to_plain(world.camera.mount),
    }
    sections |= {SECTION: scenario_file.to_plain(world), ESTIMATE: sections[ESTIMATE] | team}
    return yaml.safe_dump(sections, sort_keys=False)
