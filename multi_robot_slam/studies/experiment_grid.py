"""The paper's section 7: the runs that each figure needs."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from msg_defs import scenario_file
from msg_defs.errors import InputError
from multi_robot_slam.config import shipped
from multi_robot_slam.filter.settings import NO_REJUVENATION, FilterSettings
from multi_robot_slam.studies.experiment_table import Key, Trial
from multi_robot_slam.studies.exploration import Base
from sim_world.scenario import SECTION as WORLD_SECTION
from sim_world.scenario import Scenario
from sim_world.trajectories import TOURS

FIGURES = ("fig3", "fig4", "fig5", "fig6", "fig7", "fig8", "fig9")
SINGLE_RUNS = ("fig3", "fig4")
"""Figures of one run."""
TEAMS = (1, 2, 3)
"""Numbers of robots K."""
GOLDEN = (5**0.5 - 1) / 2
"""Multiples of it, modulo 1, fill the unit interval evenly however many there are."""


@dataclass(frozen=True)
class Grid:
    """The values each figure varies."""

    particles: tuple[int, ...] = (1, 10, 50, 100, 200, 300, 400, 500, 1000, 1500, 2000)
    d_max_m: tuple[float, ...] = (4.0, 6.0, 8.0, 10.0, 12.0, 14.0)
    descriptor_noise: tuple[float, ...] = (0.0, 0.005, 0.01, 0.011, 0.012, 0.013, 0.014, 0.016)
    """E_0 = 0.04 refuses half of the true matches at 0.0125: 2 * 128 * 0.0125^2 = 0.04 (19)."""
    observations: tuple[int, ...] = (0, 1, 5, 10, 15, 20, 25)


QUICK = Grid((1, 50, 500), (6.0, 8.0, 10.0), (0.01, 0.012, 0.014), (0, 5, 15))
REPEATS, QUICK_REPEATS = 20, 2


def paper() -> Base:
    """The paper's world and parameters (Table 2). Filters use one thread: runs share the cores."""
    path = scenario_file.find_scenario("paper")
    config = shipped("paper")
    filters = {
        "motion": config.filter,
        "informed": FilterSettings(rejuvenation=NO_REJUVENATION),
    }
    return Base(
        scenario_file.from_file(Scenario, path, WORLD_SECTION),
        {name: replace(own, threads=1) for name, own in filters.items()},
        config.keyframe,
    )


def figures_of(name: str) -> tuple[str, ...]:
    """The figures that `name` asks for: one of them, or all."""
    if name not in (*FIGURES, "all"):
        raise InputError(f"no experiment '{name}'; there are {', '.join(FIGURES)} and all")
    return FIGURES if name == "all" else (name,)


def particle_numbers(text: str) -> tuple[int, ...]:
    """Numbers of particles from text such as 1,50,500."""
    try:
        numbers = tuple(sorted({int(word) for word in text.split(",")}))
    except ValueError:
        numbers = ()
    if not numbers or numbers[0] < 1:
        raise InputError(f"particles = '{text}': give whole numbers from 1 on, such as 1,50,500")
    return numbers


def plan(figures: Iterable[str], grid: Grid, seeds: Sequence[int], base: Base) -> list[Key]:
    """Every row the figures need."""
    return [
        (figure, trial)
        for figure in figures
        for seed in (seeds[:1] if figure in SINGLE_RUNS else seeds)
        for trial in _trials(figure, grid, seed, base)
    ]


def _trials(figure: str, grid: Grid, seed: int, base: Base) -> Iterator[Trial]:
    for robots in TEAMS[-1:] if figure in SINGLE_RUNS else TEAMS:
        for proposal in ("motion",) if figure in SINGLE_RUNS else base.filters:
            trial = usual(base, robots, proposal, seed)
            for values in _variations(figure, grid, trial):
                yield replace(trial, **values)


def usual(base: Base, robots: int, proposal: str, seed: int) -> Trial:
    """The run with the parameters of Table 2.

    The seed decides the tour and the start on it, in turn: the three tours, then the next start.
    """
    tours = tuple(TOURS)
    return Trial(
        robots=robots,
        particles=base.filters["motion"].particles,
        observations=base.scenario.observations,
        d_max_m=base.scenario.d_max_m,
        descriptor_noise=base.scenario.descriptor_noise,
        proposal=proposal,
        trajectory=tours[seed % len(tours)],
        start_offset=round(seed // len(tours) * GOLDEN % 1, 3),
        seed=seed,
    )


def _variations(figure: str, grid: Grid, usual: Trial) -> list[dict]:
    """What a figure changes in the usual run. B/K is rounded down."""
    if figure in SINGLE_RUNS:
        return [{}]
    if figure == "fig9":
        shares = sorted({usual.observations, usual.observations // usual.robots})
        return [{"particles": m, "observations": b} for m in grid.particles for b in shares]
    name = {
        "fig5": "particles",
        "fig6": "d_max_m",
        "fig7": "descriptor_noise",
        "fig8": "observations",
    }[figure]
    return [{name: value} for value in getattr(grid, name)]
