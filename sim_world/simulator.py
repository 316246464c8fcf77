"""Scenario and seed -> everything that happens, in time order."""

from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from msg_defs.errors import InputError
from msg_defs.types import LandmarkMap, Trajectory, Walls
from sim_world import robot, trajectories, world
from sim_world.rendering.level import require_level
from sim_world.robot import RobotStep
from sim_world.scenario import Scenario
from sim_world.trajectories import Drive

if TYPE_CHECKING:
    from sim_world.rendering.renderer import Renderer

__all__ = ["RobotStep", "Simulation"]


class Simulation:
    """A team that drives through the building; the same scenario and seed give the same bytes.

    `only` names the one robot to simulate: it reports what it would in the whole team, because
    every robot has a random stream of its own. The world depends on `scenario.world_seed` alone.
    """

    def __init__(self, scenario: Scenario, seed: int, only: str | None = None) -> None:
        if only is not None and only not in scenario.names:
            raise InputError(f"no robot '{only}'; the team is {', '.join(scenario.names)}")
        self.scenario = scenario
        self.seed = seed
        if scenario.images.enabled:
            require_level(scenario.camera, world.HEIGHT_M)
        self._world = world.build(scenario)
        parts = trajectories.poses(
            scenario.trajectory,
            scenario.robots,
            scenario.movements,
            scenario.start_offset,
            scenario.odometry_per_frame,
        )
        self._index = {n: i for i, n in enumerate(scenario.names) if only in (None, n)}
        self._drives = {
            name: Drive(parts, index, scenario.laps) for name, index in self._index.items()
        }

    @property
    def walls(self) -> Walls:
        """The walls of the building."""
        return self._world.walls

    @property
    def landmarks(self) -> LandmarkMap:
        """The true map: ids 0..N-1, no uncertainty, no observations."""
        return self._world.landmarks

    @property
    def start_poses(self) -> dict[str, np.ndarray]:
        """Name of each simulated robot -> (3,) its true first pose in `map`."""
        return {name: next(iter(drive)) for name, drive in self._drives.items()}

    @cached_property
    def renderer(self) -> "Renderer | None":
        """What makes the robots' pictures, where `scenario.images` are enabled."""
        if not self.scenario.images.enabled:
            return None
        from sim_world.rendering import renderer  # compiles, which landmarks do not need

        return renderer.of_building(self.scenario, self.seed)

    @property
    def instants(self) -> int:
        """How many `steps` there are."""
        return len(next(iter(self._drives.values())))

    def truth_path(self, name: str) -> Trajectory:
        """The true path of a robot."""
        path = np.array([*self._drives[name]])
        stamps = robot.stamps_ns(len(path), self.scenario.odometry_period_s)
        return Trajectory(np.array(stamps, np.int64), path)

    def steps(self) -> Iterator[tuple[RobotStep, ...]]:
        """One tuple per instant with a step of each robot; the first is the start."""
        seeds = np.random.SeedSequence(self.seed).spawn(self.scenario.robots)
        robots = [
            robot.steps(name, drive, self._world, self.scenario, seeds[self._index[name]])
            for name, drive in self._drives.items()
        ]
        return zip(*robots, strict=True)
