"""Rows of the benchmark that a user feels: a team live, and one in a bag."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from time import perf_counter

import numpy as np

from multi_robot_slam.filter.settings import NO_REJUVENATION
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.studies import accuracy
from multi_robot_slam.studies.bench_limits import Limits, Sizes
from multi_robot_slam.studies.bench_table import ONE_THREAD, Row, row_of
from multi_robot_slam.studies.exploration import configure
from multi_robot_slam.studies.live_team import LiveFilter, Spent, instants, sent, team
from sim_world.messages import Message
from sim_world.simulator import Simulation

NEVER = "filter.rejuvenation.ancestors_below=0"


def measure(sizes: Sizes, limits: Limits) -> list[Row]:
    """The rows of live teams, and of a team in a bag."""
    taken = spent(sizes, sizes.robots)
    least = least_s(sizes, limits, taken)
    return [
        processor_time("cpu_s_per_s_k3", taken, least),
        processor_time("cpu_s_per_s_k10", *_of_many(sizes, limits)),
        *rejuvenation_ratios(taken, spent(sizes, sizes.robots, is_rejuvenated=False)),
        *run_times(sizes, least),
    ]


def _of_many(sizes: Sizes, limits: Limits) -> tuple[list[Spent], float]:
    taken = spent(sizes, sizes.many_robots)
    return taken, least_s(sizes, limits, taken)


def spent(sizes: Sizes, robots: int, is_rejuvenated: bool = True) -> list[Spent]:
    """What each second of a team takes with the defaults, after the start."""
    base, whole_s = accuracy.calibrated(), sizes.start_s + sizes.live_s
    settings = replace(
        base.filters[accuracy.REJUVENATED], particles=sizes.default_particles, threads=0
    )
    if not is_rejuvenated:
        settings = replace(settings, rejuvenation=NO_REJUVENATION)
    scenario = team(base.scenario, robots, sizes.rate_hz, whole_s)
    simulation = Simulation(scenario, sizes.seed)
    pipeline = Pipeline(configure(simulation, base.keyframe, settings), keeps_frames=False)
    pipeline.warm_up()
    seconds = _by_second(simulation, whole_s, sizes.rate_hz)
    live, found = LiveFilter(pipeline), []
    for messages in seconds:
        for message in messages:
            live.take(*message)
        found.append(live.spent())
    return found[round(sizes.start_s) :]


def _by_second(simulation: Simulation, seconds: float, rate_hz: float) -> list[list[Message]]:
    """All messages, before any is taken."""
    moments = instants(simulation, seconds)
    batches = iter(lambda: list(islice(moments, round(rate_hz))), [])
    return [[m for instant in batch for m in sent(instant)] for batch in batches]


def least_s(sizes: Sizes, limits: Limits, taken: list[Spent]) -> float:
    """What this machine would allow for the particle-observations of a second [s]."""
    observations = sum(second.observations for second in taken) / len(taken)
    return 1e-9 * sizes.default_particles * observations * limits.step("informed")


def processor_time(name: str, taken: list[Spent], least: float) -> Row:
    """The mean over the seconds: what comes now and then counts too."""
    values = [second.whole for second in taken]
    steps = sum(second.steps for second in taken)
    note = f"{len(taken)} s, {steps} steps; mean over the seconds; limit: the kernels alone"
    return row_of(name, values, least, note, value=float(np.mean(values)))


def rejuvenation_ratios(taken: list[Spent], without: list[Spent]) -> list[Row]:
    """The average step of the same run with rejuvenation and without, by two clocks."""
    clocks: dict[str, Callable[[Spent], float]] = {
        "rejuvenation_ratio": lambda second: second.stepping,
        "rejuvenation_ratio_thread": lambda second: second.own_stepping,
    }
    rows = []
    for name, clock in clocks.items():
        usual_s, whole_s = (sum(map(clock, run)) / _steps(run) for run in (without, taken))
        values = [clock(s) / s.steps / usual_s for s in taken if s.steps]
        note = f"{1e3 * whole_s:.2f} ms against {1e3 * usual_s:.2f} ms a step, on average"
        rows.append(row_of(name, values, 1.0, note, value=whole_s / usual_s))
    return rows


def _steps(taken: list[Spent]) -> int:
    return sum(second.steps for second in taken)


def run_times(sizes: Sizes, least: float) -> list[Row]:
    """`multi_robot_slam run`, a process that may use all cores, on the bag of a team."""
    names = {"run_times_real_time": ("--set", NEVER), "run_times_real_time_rejuvenated": ()}
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bag, length_s = generated(folder, sizes)
        particles = ("--particles", str(sizes.default_particles))
        for row, options in names.items():
            times = length_s / run_s(bag, folder / row, *particles, *options)
            note = f"once {length_s:.0f} s of {sizes.robots} robots; limit: the kernels alone"
            rows.append(row_of(row, [times], 1 / least, note))
    return rows


def generated(folder: Path, sizes: Sizes) -> tuple[Path, float]:
    """The bag of a team in `folder`, and how long it is [s]."""
    world = team(accuracy.calibrated().scenario, sizes.robots, sizes.rate_hz, sizes.bag_s)
    bag = folder / "bag"
    options = ("--robots", sizes.robots, "--rate", sizes.rate_hz, "--laps", world.laps)
    _command("sim_world.cli", "generate", *options, "--seed", sizes.seed, "--out", bag)
    return bag, (Simulation(world, sizes.seed).instants - 1) / sizes.rate_hz


def run_s(bag: Path, out: Path, *options: str) -> float:
    """How long `multi_robot_slam run` takes, from its start to its end [s]."""
    start = perf_counter()
    _command("multi_robot_slam.cli", "run", bag, "--out", out, *options)
    return perf_counter() - start


def _command(module: str, *words: object) -> None:
    command = [sys.executable, "-m", module, *map(str, words)]
    environment = {name: value for name, value in os.environ.items() if name not in ONE_THREAD}
    subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, check=True)
