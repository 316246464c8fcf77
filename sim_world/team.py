"""One scenario for all nodes of a simulated team."""

import yaml

from msg_defs import scenario_file
from sim_world.scenario import SECTION, Scenario
from sim_world.simulator import Simulation

ESTIMATE = "multi_robot_slam"
"""The section of the scenario that the fusion reads."""


def team_scenario(
    name: str,
    robots: int | None = None,
    rate_hz: float | None = None,
    laps: int | None = None,
    images: bool = False,
    start_offset: float | None = None,
) -> str:
    """The scenario `name` as YAML, with what the fusion must know about the simulated team in it.

    These are the robots' names and true start poses, and where the camera sits. All else in the
    fusion's section stays as it is, unchecked: only the fusion knows what belongs there.

    `robots`, `laps` and `start_offset` replace the scenario's. At `rate_hz` frames of each robot in
    a second a lap takes as long as at the scenario's rate: of more and smaller movements, or fewer
    and larger. With `images` robots publish pictures whatever the scenario says.
    """
    path = scenario_file.find_scenario(name)
    sections = scenario_file.sections(scenario_file.read(path), str(path))
    world = scenario_file.from_mapping(Scenario, sections[SECTION], f"{path}: {SECTION}")
    wanted: dict[str, float | None] = {"robots": robots, "laps": laps, "start_offset": start_offset}
    if rate_hz is not None:
        movements = max(1, round(world.movements * world.period_s * rate_hz))
        wanted |= {"period_s": 1 / rate_hz, "movements": movements}
    values = scenario_file.to_plain(world)
    values |= {name: value for name, value in wanted.items() if value is not None}
    values["images"]["enabled"] |= images
    world = scenario_file.from_mapping(Scenario, values, f"{path}: {SECTION}")
    starts = Simulation(world, seed=0).start_poses
    team = {
        "robots": list(starts),
        "start_poses": [pose.tolist() for pose in starts.values()],
        "mount": scenario_file.to_plain(world.camera.mount),
    }
    sections |= {SECTION: scenario_file.to_plain(world), ESTIMATE: sections[ESTIMATE] | team}
    return yaml.safe_dump(sections, sort_keys=False)
