"""`multi_robot_slam bench`: how fast the filter is, and how fast this machine would let it be.

Everything is measured in one process whose libraries are told by their environment variables to
use one thread, with the filter's own `threads` at 1; figures that are compared take turns, step by
step. Figures are medians over steps; the spread is from their 10 % to their 90 % quantile.
"""

import copy
import gc
import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.table import Table

from msg_defs.errors import InputError
from msg_defs.types import DESCRIPTOR_SIZE
from multi_robot_slam import machine, textbook, workload
from multi_robot_slam.filter import informed, kernels, rbpf, stereo
from multi_robot_slam.filter.history import PRUNE_EVERY
from multi_robot_slam.filter.landmarks import Landmarks

ONE_THREAD = {
    name: "1"
    for name in (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMBA_NUM_THREADS",
    )
}

LITERAL = Path(__file__).parents[1] / "test" / "literal_algorithm1.py"

TARGETS = {
    "particle_observation_ns_motion": ("ns", "<=", 30.0),
    "particle_observation_ns_informed": ("ns", "<=", 90.0),
    "step_ms_m2000_k3": ("ms", "<=", 5.0),
    "resample_share_m2000_k3": ("of the step", "<=", 0.25),
    "map_growth_ratio": ("times", "<=", 1.2),
    "speedup_over_literal": ("times", ">=", 1000.0),
    "speedup_over_textbook": ("times", ">=", 3000.0),
    "step_ms_m100_k1": ("ms", "<=", 0.5),
    "state_mb_m2000_n1000": ("MB", "<=", 150.0),
    "first_step_s": ("s", "<=", 2.0),
}
"""Name -> unit, direction, target."""

FLOAT = 4
"""Bytes of a float32 and of an int32."""

OUTCOME = 3 * FLOAT
"""Match, D (18) and |Z| (16) of a particle-observation."""

BYTES = {
    # planes read and written; outcome written, and read again to weigh and to name the match
    "motion": 2 * kernels.PLANES * FLOAT + 2 * OUTCOME,
    # planes read once more, to match; outcome read once more, to update
    "informed": 3 * kernels.PLANES * FLOAT + 3 * OUTCOME,
}
"""Bytes a particle-observation must move: predict, associate, update and weigh."""

GATHER_BYTES = 2 * kernels.PLANES * FLOAT
"""Bytes a particle-observation must move for resampling: its planes, read and written."""

KERNELS = {"motion": (kernels.update,), "informed": (informed.believe, kernels.update)}
"""The loops that every particle-observation goes through."""

SURVEY_SPEED = 5.0
"""Landmarks passed in a step while the map is made."""

SPEED = 0.5
"""Landmarks passed in a step while time is taken: each is observed in about 30 steps."""

LEAST_RIGHT = 0.95
"""Share of right matches below which a run is no workload."""

IMPORTS = "import numpy, numba"
FIRST_STEP = """
from multi_robot_slam.config import Config
from multi_robot_slam.pipeline import Pipeline
Pipeline(Config()).warm_up()
"""


@dataclass(frozen=True)
class Sizes:
    """How much is measured; the names of the rows tell what the defaults stand for."""

    particles: int = 2000
    robots: int = 3
    observations: int = 15
    landmarks: int = 700
    few_particles: int = 100
    small_map: int = 500
    large_map: int = 10_000
    memory_map: int = 1000
    literal_map: int = 100
    steps: int = 200
    rounds: int = 3
    """Steps with the literal algorithm and with the textbook's, and twice as many fresh starts."""
    textbook_particles: int = 5


QUICK = Sizes(steps=40, rounds=1)


@dataclass(frozen=True)
class Row:
    """One figure; `limit` is what the machine's own rates would allow, in the same unit."""

    name: str
    value: float
    unit: str
    target: float
    limit: float
    spread: tuple[float, float]
    met: bool
    note: str


def run(quick: bool) -> list[Row]:
    """Measure in a fresh process of one thread."""
    if not LITERAL.exists():
        raise InputError(f"bench compares with {LITERAL}, which is not there: run it in a checkout")
    command = [sys.executable, "-m", __name__, *["--quick"] * quick]
    done = subprocess.run(command, env=os.environ | ONE_THREAD, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise RuntimeError(f"the benchmark stopped with exit code {done.returncode}")
    return [Row(**row) for row in json.loads(done.stdout)]


def table(rows: list[Row]) -> Table:
    """The rows for a terminal."""
    result = Table(title="Performance, one thread")
    for name in ("figure", "value", "spread", "limit", "target", "unit", "met"):
        result.add_column(name, justify="right" if name in ("value", "limit", "target") else "left")
    result.add_column("note", style="dim")
    for row in rows:
        direction = TARGETS[row.name][1]
        result.add_row(
            row.name,
            f"{row.value:.4g}",
            f"{row.spread[0]:.3g} .. {row.spread[1]:.3g}",
            f"{row.limit:.3g}",
            f"{direction} {row.target:g}",
            row.unit,
            "yes" if row.met else "[red]no",
            row.note,
        )
    return result


def measure(sizes: Sizes) -> list[Row]:
    """All rows, measured in this process."""
    limits = Limits(sizes)
    teams = {
        proposal: Session(sizes, sizes.landmarks, sizes.robots, sizes.particles, proposal)
        for proposal in BYTES
    }
    clocks = take_turns(teams, sizes.steps)
    rows = [
        particle_observation(sizes, limits, proposal, clocks[proposal], teams[proposal])
        for proposal in BYTES
    ]
    rows += [whole_step(sizes, limits, clocks), resample_share(limits, clocks)]
    rows.append(speedup_over_textbook(sizes, limits, teams["motion"]))
    rows.append(state_size(sizes, teams["informed"]))
    teams.clear()
    gc.collect()
    rows.append(map_growth(sizes))
    rows.append(single_robot(sizes, limits))
    rows.append(speedup_over_literal(sizes, limits))
    rows.append(first_step(sizes))
    order = list(TARGETS)
    return sorted(rows, key=lambda row: order.index(row.name))


def particle_observation(sizes, limits, proposal, clocks, session) -> "Row":
    """Predict, associate, update and weigh; the lazy copies are counted to resampling."""
    scale = 1e9 / (sizes.particles * sizes.robots * sizes.observations)
    values = [(clock.proposal - clock.gather) * scale for clock in clocks]
    note = (
        f"{BYTES[proposal]} bytes at {1 / limits.rates.ns_per_byte:.0f} GB/s, "
        f"{limits.operations[proposal]} operations at "
        f"{1 / limits.rates.ns_per_operation:.0f} GFLOP/s; {session.size()} landmarks, "
        f"{100 * session.right_share():.1f} % matched right"
    )
    return row(f"particle_observation_ns_{proposal}", values, limits.proposal(proposal), note)


def whole_step(sizes, limits, clocks) -> "Row":
    """The slower proposal's step."""
    steps = {p: [1e3 * clock.step for clock in clocks[p]] for p in clocks}
    slower = max(steps, key=lambda p: np.median(steps[p]))
    count = sizes.particles * sizes.robots * sizes.observations
    note = "; ".join(f"{p} {np.median(steps[p]):.2f}" for p in steps)
    return row("step_ms_m2000_k3", steps[slower], 1e-6 * count * limits.step(slower), note)


def resample_share(limits, clocks) -> "Row":
    """All of a step but the proposal, and the lazy copies in it; the larger share of both."""
    shares = {
        p: [(clock.step - clock.proposal + clock.gather) / clock.step for clock in clocks[p]]
        for p in clocks
    }
    larger = max(shares, key=lambda p: np.median(shares[p]))
    note = "; ".join(f"{p} {np.median(shares[p]):.2f}" for p in shares)
    limit = 1 - limits.proposal(larger) / limits.step(larger)
    return row("resample_share_m2000_k3", shares[larger], limit, f"with lazy copies: {note}")


def map_growth(sizes) -> "Row":
    """The same step with a large and with a small map, in turns."""
    sessions = {
        size: Session(sizes, size, sizes.robots, sizes.particles, "informed")
        for size in (sizes.large_map, sizes.small_map)
    }
    clocks = take_turns(sessions, sizes.steps)
    large, small = ([clock.step for clock in clocks[size]] for size in sessions)
    note = (
        f"{sizes.large_map} landmarks {1e3 * np.median(large):.2f} ms, "
        f"{sizes.small_map} landmarks {1e3 * np.median(small):.2f} ms, informed"
    )
    return row("map_growth_ratio", np.divide(large, small), 1.0, note)


def single_robot(sizes, limits) -> "Row":
    """One robot, few particles: what lies outside the kernels shows."""
    session = Session(sizes, sizes.landmarks, 1, sizes.few_particles, "informed")
    clocks = take_turns({"": session}, 2 * sizes.steps)[""]
    limit = 1e-6 * sizes.few_particles * sizes.observations * limits.step("informed")
    note = f"informed, {session.size()} landmarks"
    return row("step_ms_m100_k1", [1e3 * clock.step for clock in clocks], limit, note)


def speedup_over_textbook(sizes, limits, session) -> "Row":
    """Per particle-observation: the filter against `textbook`, which runs with few particles.

    The textbook's particles are copies of the filter's first; they see the same frames with the
    same draws, and must match the same landmarks.
    """
    count, ratios, same = sizes.textbook_particles, [], []
    for number in range(sizes.rounds):
        particles, ids = textbook_copies(session.state, count)
        frames = session.world.drive(SPEED)
        normals = np.random.default_rng(number)
        start, matches = time.perf_counter(), []
        for frame in frames:
            draws = normals.standard_normal((3, sizes.particles))[:, :count]
            matches.append(
                textbook.update_particles(
                    particles, frame, session.settings, session.mount, draws
                )
            )
        slow = (time.perf_counter() - start) / count
        clock, info = session.process(frames, np.random.default_rng(number))
        ratios.append(slow / ((clock.proposal - clock.gather) / sizes.particles))
        same += [
            equal_choices(choice, seen.matches[:, m], ids[m], seen.new_ids)
            for choices, seen in zip(matches, info.frames, strict=True)
            for m, choice in enumerate(choices)
        ]
    note = f"{session.size()} landmarks, {100 * np.mean(same):.1f} % of the matches the same"
    require(np.mean(same), "matches like the textbook's")
    limit = np.median(ratios) * 1
    return row("speedup_over_textbook", ratios, limit, note)
