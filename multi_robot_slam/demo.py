"""All at once: simulated robots, fusion and recorder as processes that talk over DDS."""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from msg_defs import settings
from msg_defs.errors import InputError
from multi_robot_slam.config import SECTION, Config
from sim_world.scenario import SECTION as WORLD_SECTION
from sim_world.scenario import Scenario
from sim_world.simulator import Simulation

END_S = 3.0
"""How long a process may take to end after SIGINT."""
IDLE_S = 2.0
"""Silence after which the fusion takes the exploration for over."""


def configure(scenario: Path, robots: int | None, seed: int) -> str:
    """Both packages' settings for a simulated team, as YAML: names and start poses agree."""
    world = settings.from_file(Scenario, scenario, WORLD_SECTION)
    if robots is not None:
        world = settings.from_mapping(Scenario, vars(world) | {"robots": robots})
    starts = Simulation(world, seed).start_poses
    config = replace(
        settings.from_file(Config, scenario, SECTION),
        robots=tuple(starts),
        start_poses=tuple(tuple(map(float, pose)) for pose in starts.values()),
        seed=seed,
    )
    return settings.to_yaml(**{WORLD_SECTION: world, SECTION: config})


def record(folder: Path, scenario: Path, seed: int, speed: float) -> None:
    """Spawn recorder, fusion and robots; leave `folder/bag` when the exploration is over.

    `scenario` is what `configure` wrote. Whatever happens, every process is ended, the recorder
    last, so that its bag is whole.
    """
    team = ",".join(settings.from_file(Config, scenario, SECTION).robots)
    shared = [f"scenario:={scenario}"]
    with (
        _node(
            "multi_robot_slam.recorder", f"out:={folder / 'bag'}", f"robots:=[{team}]"
        ) as recorder,
        _node("multi_robot_slam.fusion", *shared, f"stop_after_s:={IDLE_S}") as fusion,
        _node(
            "sim_world.robots",
            *shared,
            f"seed:={seed}",
            f"speed:={speed}",
            "subscribers:=2",
            "truth_subscribers:=1",
        ) as robots,
    ):
        _wait(robots, [fusion, recorder])
        _wait(fusion, [recorder])


@contextmanager
def _node(module: str, *parameters: str) -> Iterator[subprocess.Popen]:
    """A node in a process of its own, which is ended with SIGINT by its process id."""
    arguments = [argument for p in parameters for argument in ("-p", p)]
    process = subprocess.Popen(
        [sys.executable, "-m", module, "--ros-args", *arguments], start_new_session=True
    )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()


def _wait(process: subprocess.Popen, needed: list[subprocess.Popen]) -> None:
    """Wait until `process` has ended well; `InputError` when it or a `needed` one fails."""
    while process.poll() is None:
        for other in needed:
            if other.poll() is not None:
                raise InputError(f"{other.args[2]} ended too early; what it said is above")
        time.sleep(0.05)
    if process.returncode:
        raise InputError(f"{process.args[2]} failed; what it said is above")
