"""The rows of the benchmark, each measured in this process.

What is compared takes turns, step by step. A figure is the median over steps; its spread goes from
their 10 % to their 90 % quantile.
"""

import gc
import os
import subprocess
import sys

import numpy as np

from multi_robot_slam.filter import kernels
from multi_robot_slam.filter.history import PRUNE_EVERY
from multi_robot_slam.studies import live_rows, rivals
from multi_robot_slam.studies.bench_limits import BYTES, GATHER_BYTES, WORD, Limits, Sizes
from multi_robot_slam.studies.bench_table import ONE_THREAD, TARGETS, Row, row_of
from multi_robot_slam.studies.session import Clock, Proposal, Session, take_turns

BARE_IMPORT = "import numpy, numba"

FIRST_STEP = """
from multi_robot_slam.config import Config
from multi_robot_slam.pipeline import Pipeline
Pipeline(Config()).warm_up()
"""


def measure(sizes: Sizes) -> list[Row]:
    """All rows, in the order of TARGETS, measured in this process."""
    limits = Limits(sizes)
    teams = {
        proposal: _session(sizes, sizes.landmarks, sizes.robots, sizes.particles, proposal)
        for proposal in BYTES
    }
    clocks = take_turns(teams, sizes.steps)
    rows = [particle_observation(sizes, limits, p, clocks[p], teams[p]) for p in BYTES]
    rows += [whole_step(sizes, limits, clocks), resample_share(sizes, limits, clocks)]
    rows += [speedup_over_textbook(sizes, limits, teams["motion"])]
    rows += [state_size(sizes, teams["informed"])]
    del teams
    gc.collect()
    rows += [map_growth(sizes), growth_pause(sizes, limits), speedup_over_literal(sizes, limits)]
    rows += [
        single_robot(sizes, limits, "step_ms_m100_k1", sizes.few_particles),
        single_robot(sizes, limits, "step_ms_m500_k1_frame", sizes.default_particles),
    ]
    rows += [first_step(sizes)]
    rows += live_rows.measure(sizes, limits)
    return sorted(rows, key=lambda row: list(TARGETS).index(row.name))


def _session(
    sizes: Sizes, landmarks: int, robots: int, particles: int, proposal: Proposal
) -> Session:
    return Session(landmarks, robots, particles, sizes.observations, proposal, sizes.seed)


def _rounds(sizes: Sizes) -> range:
    """Seeds of the rivals' steps."""
    return range(sizes.seed, sizes.seed + sizes.rounds)


def particle_observation(
    sizes: Sizes, limits: Limits, proposal: Proposal, clocks: list[Clock], session: Session
) -> Row:
    """Predict, associate, update and weigh; the lazy copies belong to resampling."""
    values = _per_particle_observation(sizes, clocks)
    note = (
        f"{limits.explain(proposal)}; {session.size()} landmarks, "
        f"{100 * session.right_share():.1f} % of the matches right"
    )
    return row_of(f"particle_observation_ns_{proposal}", values, limits.proposal(proposal), note)


def _per_particle_observation(sizes: Sizes, clocks: list[Clock]) -> list[float]:
    scale = 1e9 / (sizes.particles * sizes.robots * sizes.observations)
    return [scale * (clock.proposal - clock.gather) for clock in clocks]


def whole_step(sizes: Sizes, limits: Limits, clocks: dict[Proposal, list[Clock]]) -> Row:
    """The step of the slower proposal."""
    values = {p: [1e3 * clock.step for clock in clocks[p]] for p in clocks}
    slower, note = _worst(values)
    count = sizes.particles * sizes.robots * sizes.observations
    return row_of("step_ms_m2000_k3", values[slower], 1e-6 * count * limits.step(slower), note)


def resample_share(sizes: Sizes, limits: Limits, clocks: dict[Proposal, list[Clock]]) -> Row:
    """Everything outside the proposal, and the lazy copies in it; the larger of both proposals."""
    values = {p: [1 - (c.proposal - c.gather) / c.step for c in clocks[p]] for p in clocks}
    larger, note = _worst(values)
    rest = np.median(_per_particle_observation(sizes, clocks[larger]))
    limit = limits.gather / (limits.gather + rest)
    note += f"; limit: {GATHER_BYTES} bytes copied, the rest of the step as it is"
    return row_of("resample_share_m2000_k3", values[larger], limit, note)


def map_growth(sizes: Sizes) -> Row:
    """The same step with a large map and with a small one."""
    sessions = {
        size: _session(sizes, size, sizes.robots, sizes.particles, "informed")
        for size in (sizes.large_map, sizes.small_map)
    }
    clocks = take_turns(sessions, sizes.steps)
    large, small = ([1e3 * clock.step for clock in clocks[size]] for size in sessions)
    note = "; ".join(
        f"{session.size()} landmarks {np.median(times):.2f} ms"
        for session, times in zip(sessions.values(), (large, small), strict=True)
    )
    return row_of("map_growth_ratio", np.divide(large, small), 1.0, note)


def growth_pause(sizes: Sizes, limits: Limits) -> Row:
    """The longest step, over the median one, of a map that grows from few landmarks to many."""
    session = Session(
        sizes.literal_map,
        sizes.robots,
        sizes.particles,
        sizes.observations,
        "informed",
        sizes.seed,
        ring=2 * sizes.grown_map,
    )
    few = session.size()
    steps = [1e3 * clock.step for clock in session.survey(sizes.grown_map)]
    median = float(np.median(steps))
    limit = 1e-6 * sizes.particles * sizes.robots * sizes.observations * limits.step("informed")
    note = (
        f"{few} to {session.size()} landmarks in {len(steps)} steps of {median:.2f} ms; "
        "limit: another step"
    )
    over = [step - median for step in steps]
    return row_of("growth_pause_ms", over, limit, note, value=max(over))


def speedup_over_literal(sizes: Sizes, limits: Limits) -> Row:
    """Whole steps of one robot with few particles."""
    session = _session(sizes, sizes.literal_map, 1, sizes.few_particles, "motion")
    result = rivals.against_literal(session, _rounds(sizes))
    least = 1e-9 * sizes.few_particles * sizes.observations * limits.step("motion")
    note = (
        f"{session.size()} landmarks: {np.median(result.rival):.2f} s against "
        f"{1e3 * np.median(result.fast):.2f} ms; {100 * result.same:.1f} % of the matches equal"
    )
    return _speedup("speedup_over_literal", result, least, note)


def speedup_over_textbook(sizes: Sizes, limits: Limits, session: Session) -> Row:
    """Predict, associate, update and weigh, per particle-observation."""
    result = rivals.against_textbook(session, sizes.textbook_particles, _rounds(sizes))
    note = (
        f"{session.size()} landmarks: {1e6 * np.median(result.rival):.0f} us against "
        f"{1e9 * np.median(result.fast):.0f} ns; {100 * result.same:.1f} % of the matches equal"
    )
    return _speedup("speedup_over_textbook", result, 1e-9 * limits.proposal("motion"), note)


def single_robot(sizes: Sizes, limits: Limits, name: str, particles: int) -> Row:
    """One robot's frame: what lies outside the kernels shows; the slower proposal."""
    sessions = {p: _session(sizes, sizes.landmarks, 1, particles, p) for p in BYTES}
    clocks = take_turns(sessions, sizes.steps)
    values = {p: [1e3 * clock.step for clock in clocks[p]] for p in clocks}
    slower, note = _worst(values)
    limit = 1e-6 * particles * sizes.observations * limits.step(slower)
    return row_of(name, values[slower], limit, note)


def state_size(sizes: Sizes, session: Session) -> Row:
    """Bytes set aside for all arrays of the state, written to or not, while history grows."""
    session.survey(sizes.memory_map)
    values = []
    for _ in range(PRUNE_EVERY):
        session.step()
        values.append(1e-6 * bytes_of(session.state, set()))
    limit = 1e-6 * sizes.memory_map * kernels.PLANES * WORD * sizes.particles
    note = f"most of {PRUNE_EVERY} steps; {session.size()} landmarks; limit: their planes alone"
    return row_of("state_mb_m2000_n1000", values, limit, note, value=max(values))


def bytes_of(thing: object, counted: set[int]) -> int:
    """Bytes of all arrays reached from `thing`, each buffer once."""
    while isinstance(thing, np.ndarray) and isinstance(thing.base, np.ndarray):
        thing = thing.base
    if id(thing) in counted:
        return 0
    counted.add(id(thing))
    if isinstance(thing, np.ndarray):
        return thing.nbytes
    parts = thing if isinstance(thing, list | tuple) else getattr(thing, "__dict__", {}).values()
    return sum(bytes_of(part, counted) for part in parts)


def first_step(sizes: Sizes) -> Row:
    """From import to first step in fresh processes; the compiler's cache is warm."""
    _time_in_fresh_process(FIRST_STEP)
    values, bare = [], []
    for _ in range(sizes.rounds):
        values.append(_time_in_fresh_process(FIRST_STEP))
        bare.append(_time_in_fresh_process(BARE_IMPORT))
    return row_of("first_step_s", values, float(np.median(bare)), f"limit: {BARE_IMPORT}")


def _time_in_fresh_process(code: str) -> float:
    timed = f"import time\nstart = time.perf_counter()\n{code}\nprint(time.perf_counter() - start)"
    command = [sys.executable, "-c", timed]
    done = subprocess.run(command, env=os.environ | ONE_THREAD, stdout=subprocess.PIPE, check=True)
    return float(done.stdout)


def _worst(values: dict[Proposal, list[float]]) -> tuple[Proposal, str]:
    medians = {proposal: np.median(values[proposal]) for proposal in values}
    note = ", ".join(f"{proposal} {median:.3g}" for proposal, median in medians.items())
    return max(medians, key=lambda proposal: medians[proposal]), note


def _speedup(name: str, result: rivals.Comparison, least_s: float, note: str) -> Row:
    limit = float(np.median(result.rival) / least_s)
    return row_of(name, np.divide(result.rival, result.fast), limit, note)
