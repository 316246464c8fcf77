"""The worlds of the study: the exact one, and each with one difference from what is told."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from msg_defs.errors import InputError
from multi_robot_slam.config import Config
from multi_robot_slam.studies import experiment_grid, exploration
from multi_robot_slam.studies import hard_changes as changes
from multi_robot_slam.studies.accuracy_table import REJUVENATED
from multi_robot_slam.studies.experiment_grid import GOLDEN
from multi_robot_slam.studies.experiment_table import Trial
from multi_robot_slam.studies.exploration import Base
from multi_robot_slam.studies.hard_changes import Change, Told

ODOMETRY_PER_FRAME = 10
"""Frames at 2 Hz, as in the scenario, and odometry at 20 Hz."""

EXACTS = EXACT, EXACT_CERTAIN, EXACT_TWICE = "exact", "exact-certain", "exact-2-rounds"
DAY_BEFORE = 1_000_000
"""Added to a seed: no two drives have the same noise."""
NEAR, FAR = (0.05, 2.0), (0.3, 10.0)
"""How far a start is off [m, degrees]."""
FAR_SIGMA = (0.3, 0.175)
"""The same as it is told [m, rad]."""

Judged = Literal["published", "later", "later, aligned", "tied", "found", "found, aligned"]


@dataclass(frozen=True)
class World:
    """How a world differs from the exact one, and what of its runs is judged."""

    change: Change = changes.nothing
    simulated: Mapping[str, Any] = field(default_factory=dict)
    """What the simulation itself has otherwise: fields of `Trial`."""
    rounds: int = 1
    """Of the tour: runs in which something happens after a minute are longer."""
    judged: Judged = "published"
    """All poses as published; from 10 s after the difference can be noticed on, since before that a
    start is what it was told to be; these after the team was aligned as one, where nothing that is
    seen tells where `map` is; each robot's since its place is known; or from 10 s after it was said
    that a robot is lost, those of it that are published, likewise."""
    has_optimum: bool = False
    """Also compared with the filtering optimum."""
    is_next_day: bool = False
    """The fusion begins with the map of the `day_before`."""


WORLDS: dict[str, World] = {
    EXACT: World(),
    EXACT_CERTAIN: World(changes.certain),
    "start-near": World(changes.start_off(1, *NEAR), judged="later"),
    "start-far-told": World(changes.start_off(1, *FAR, FAR_SIGMA), judged="later"),
    "first-near": World(changes.start_off(0, *NEAR), judged="later, aligned"),
    "first-far-told": World(changes.start_off(0, *FAR, FAR_SIGMA), judged="later, aligned"),
    "start-far": World(changes.start_off(1, *FAR), judged="found"),
    "swapped": World(changes.starts_swapped, judged="found, aligned"),
    "unknown-one": World(changes.one_start_unknown, judged="tied"),
    "unknown-one-copies": World(
        changes.in_turn(changes.walls_thrice, changes.one_start_unknown), judged="tied"
    ),
    "unknown-all-but-one": World(changes.one_start_known, judged="tied"),
    "next-day": World(
        changes.in_turn(changes.all_starts_unknown, changes.only_localised),
        judged="tied",
        is_next_day=True,
    ),
    "next-day-tenth-gone": World(
        changes.in_turn(
            changes.landmarks_gone(0.1), changes.all_starts_unknown, changes.only_localised
        ),
        judged="tied",
        is_next_day=True,
    ),
    "next-day-mapping": World(changes.all_starts_unknown, judged="tied", is_next_day=True),
    "odometry-3": World(changes.odometry_noise(3.0)),
    "odometry-3-told": World(changes.odometry_noise(3.0, is_told=True)),
    "odometry-third": World(changes.odometry_noise(1 / 3)),
    "camera-3": World(changes.camera_noise(3.0)),
    "camera-3-told": World(changes.camera_noise(3.0, is_told=True)),
    "camera-third": World(changes.camera_noise(1 / 3)),
    "odometry-biased": World(changes.odometry_biased),
    "silent": World(changes.silent),
    "lost-messages": World(changes.lost(0.3)),
    "no-odometry": World(changes.without_odometry),
    "random-descriptors": World(changes.random_descriptors(0.05)),
    "random-positions": World(changes.random_positions(0.05)),
    "mixture": World(
        changes.in_turn(
            changes.random_descriptors(0.03),
            changes.random_positions(0.03),
            changes.lost(0.1),
            changes.jittered,
        )
    ),
    "descriptor-noise": World(simulated={"descriptor_noise": 0.012}, has_optimum=True),
    "short-sight": World(simulated={"d_max_m": 5.0}, has_optimum=True),
    "few-observations": World(simulated={"observations": 5}, has_optimum=True),
    "robot-late": World(changes.robot_late(20.0), judged="later"),
    "fusion-killed": World(changes.fusion_killed, judged="later"),
    "robot-restarted": World(changes.robot_restarted, judged="later"),
    "slip": World(changes.slipped, judged="found"),
    "carried": World(changes.carried, judged="found"),
    EXACT_TWICE: World(rounds=2),
    "landmarks-moved": World(changes.landmarks_moved, rounds=2),
    "fusion-late": World(changes.fusion_late(60.0), rounds=2, judged="later, aligned"),
    "fusion-restarted": World(changes.fusion_restarted, rounds=2, judged="later, aligned"),
}
"""By name, in the order of the table."""


def worlds_of(names: str) -> tuple[str, ...]:
    """Worlds from text such as swapped,slip."""
    chosen = tuple(dict.fromkeys(names.split(",")))
    if unknown := [name for name in chosen if name not in WORLDS]:
        raise InputError(f"no row '{unknown[0]}'; there are {', '.join(WORLDS)}")
    return chosen


def exact_of(name: str) -> str:
    """The exact world that a world is compared with: that of as many rounds."""
    return EXACT if WORLDS[name].rounds == 1 else EXACT_TWICE


def simulated(base: Base, name: str, robots: int, seed: int) -> Told:
    """What the team of a seed sends in the simulation of a world, before anything is changed."""
    world = WORLDS[name]
    trial = experiment_grid.usual(base, robots, "informed", seed)
    return _simulated(base, replace(trial, **world.simulated), world.rounds)


def day_before(base: Base, robots: int, seed: int) -> Told:
    """What the same team sent in the exact world the day before: its tour began elsewhere."""
    trial = experiment_grid.usual(base, robots, "informed", seed)
    begun = (trial.start_offset + GOLDEN) % 1
    return _simulated(base, replace(trial, seed=DAY_BEFORE + seed, start_offset=begun))


def _simulated(base: Base, trial: Trial, rounds: int = 1) -> Told:
    scenario = replace(base.scenario, odometry_per_frame=ODOMETRY_PER_FRAME, laps=rounds)
    explored = exploration.explore(replace(base, scenario=scenario), trial)
    config = exploration.configure(explored, base.keyframe, base.filters[REJUVENATED])
    config = replace(config, start_sigma=Config().start_sigma)
    events = tuple(e for instant in explored.instants for step in instant for e in step.events)
    return Told(explored.scenario, config, events, exploration.recorded(explored), config.robots)


def simulation_of(name: str) -> str:
    """A world with the same simulation: those of one have to be simulated once."""
    wanted = WORLDS[name].simulated, WORLDS[name].rounds
    return next(n for n, world in WORLDS.items() if (world.simulated, world.rounds) == wanted)


def changed(name: str, told: Told) -> Told:
    """The world `name` of a team that was `simulated`; random numbers are those of its seed."""
    rng = np.random.default_rng([told.config.seed, zlib.crc32(name.encode())])
    return WORLDS[name].change(told, rng)
