"""The paper's section 7: the grid of each figure x seeds -> runs -> one table.

One run is one exploration by one filter, in this process and without ROS. Runs that differ in the
filter alone share their simulation, and a run that several figures need is done once.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from msg_defs import scenario_file
from msg_defs.errors import InputError
from msg_defs.types import LandmarkMap, Trajectory, Walls
from multi_robot_slam import runs
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.filter.settings import NO_REJUVENATION, FilterSettings
from multi_robot_slam.pipeline import offline, refinement
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs import evaluation
from multi_robot_slam.studies import experiment_table
from multi_robot_slam.studies.experiment_table import RESULTS, Result, Rows, Trial
from sim_world.scenario import SECTION as WORLD_SECTION
from sim_world.scenario import Scenario
from sim_world.simulator import RobotStep, Simulation
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


@dataclass(frozen=True)
class Base:
    """What all runs have in common: the world, and the filter behind each proposal."""

    scenario: Scenario
    filters: dict[str, FilterSettings]
    """motion: the paper's. informed: this package's own, with its defaults."""


@dataclass(frozen=True)
class Job:
    """Runs that share one simulation."""

    base: Base
    trials: tuple[Trial, ...]

    @property
    def cost(self) -> float:
        """Rough duration, in units of a run with hardly any particles."""
        return 3 + sum(1 + trial.particles / 500 for trial in self.trials)


@dataclass(frozen=True, eq=False)
class Exploration:
    """A simulated exploration: all that the robots reported, and the truth."""

    scenario: Scenario
    seed: int
    start_poses: dict[str, np.ndarray]
    instants: list[tuple[RobotStep, ...]]
    truth: dict[str, Trajectory]
    landmarks: LandmarkMap
    walls: Walls


def paper() -> Base:
    """The paper's world and parameters (Table 2). Filters use one thread: runs share the cores."""
    path = scenario_file.find_scenario("paper")
    filters = {
        "motion": scenario_file.from_file(Config, path, SECTION).filter,
        "informed": FilterSettings(rejuvenation=NO_REJUVENATION),
    }
    return Base(
        scenario_file.from_file(Scenario, path, WORLD_SECTION),
        {name: replace(own, threads=1) for name, own in filters.items()},
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


def plan(
    figures: Iterable[str], grid: Grid, seeds: Sequence[int], base: Base
) -> list[tuple[str, Trial]]:
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


def jobs(trials: Iterable[Trial], base: Base) -> list[Job]:
    """The trials by simulation, the longest job first."""
    groups = defaultdict(list)
    for trial in sorted(trials):
        groups[replace(trial, particles=0, proposal="")].append(trial)
    return sorted((Job(base, tuple(g)) for g in groups.values()), key=lambda j: -j.cost)


def compute(job: Job) -> list[Result]:
    """The result of each of the job's trials."""
    exploration = explore(job.base, job.trials[0])
    batch = batch_paths(exploration, job.base)
    return [_result(exploration, batch, job.base, trial) for trial in job.trials]


def explore(base: Base, trial: Trial) -> Exploration:
    """Simulate the exploration of a trial."""
    scenario = replace(
        base.scenario,
        robots=trial.robots,
        observations=trial.observations,
        d_max_m=trial.d_max_m,
        descriptor_noise=trial.descriptor_noise,
        trajectory=trial.trajectory,
        start_offset=trial.start_offset,
    )
    simulation = Simulation(scenario, trial.seed)
    return Exploration(
        scenario,
        trial.seed,
        simulation.start_poses,
        list(simulation.steps()),
        {name: simulation.truth_path(name) for name in scenario.names},
        simulation.landmarks,
        simulation.walls,
    )


def estimate(
    exploration: Exploration, filter_settings: FilterSettings
) -> tuple[runs.Run, Pipeline]:
    """The filter's run over the exploration, and the pipeline at its end."""
    starts = exploration.start_poses
    config = Config(
        robots=tuple(starts),
        start_poses=tuple(tuple(map(float, pose)) for pose in starts.values()),
        seed=exploration.seed,
        mount=exploration.scenario.camera.mount,
        filter=filter_settings,
    )
    pipeline = Pipeline(config)
    pipeline.warm_up()
    sent = (
        event
        for instant in exploration.instants
        for robot in instant
        for event in (robot.odometry, robot.observations)
    )
    steps = offline.run_through(pipeline, sent)
    return offline.assemble(pipeline, _recorded(exploration), steps), pipeline


def _recorded(exploration: Exploration) -> runs.Recorded:
    by_robot = list(zip(*exploration.instants, strict=True))
    truths = [robot.observation_truth for steps in by_robot for robot in steps]
    return runs.Recorded(
        odometry={
            steps[0].odometry.robot: runs.trajectory(step.odometry for step in steps)
            for steps in by_robot
        },
        truth=exploration.truth,
        true_landmarks=exploration.landmarks,
        walls=exploration.walls,
        observation_truth={(truth.robot, truth.stamp_ns): truth.landmarks for truth in truths},
    )


def filter_of(base: Base, trial: Trial) -> FilterSettings:
    """The settings of a trial's filter."""
    return replace(base.filters[trial.proposal], particles=trial.particles)


def batch_paths(exploration: Exploration, base: Base) -> dict[str, Trajectory]:
    """The paths by least squares with the true associations, for comparison.

    The search starts from the path of one particle, so that the answer is the same to the last
    digit whichever filters it is compared with.
    """
    run, pipeline = estimate(exploration, replace(base.filters["informed"], particles=1))
    return refinement.yardstick(pipeline.lineage(), run.observation_truth, run.config)


def _result(
    exploration: Exploration, batch: dict[str, Trajectory], base: Base, trial: Trial
) -> Result:
    run, _ = estimate(exploration, filter_of(base, trial))
    figures = evaluation.evaluate(run.with_paths(yardstick=batch))
    return {name: figures[name] for name in RESULTS}


Execute = Callable[[Callable[[Job], list[Result]], list[Job]], Iterator[tuple[Job, list[Result]]]]
"""Runs a function on jobs: `scheduling.local` or `scheduling.on_cluster`."""


def run(
    wanted: list[tuple[str, Trial]],
    base: Base,
    folder: Path,
    execute: Execute,
    on_progress: Callable[[float, float], None] = lambda done, total: None,
) -> Rows:
    """Bring `folder/table.csv` to hold the wanted rows; those it has are not computed again.

    `on_progress` is told the share of the work that is done, and all of it.
    """
    claim(folder, base)
    path = folder / "table.csv"
    rows = experiment_table.read(path)
    known = {trial: result for (_, trial), result in rows.items()}
    rows |= {(figure, trial): known[trial] for figure, trial in wanted if trial in known}
    experiment_table.write(path, rows)
    todo = defaultdict(list)
    for figure, trial in wanted:
        if trial not in known:
            todo[trial].append(figure)
    work = jobs(todo, base)
    done, total = 0.0, sum(job.cost for job in work)
    on_progress(done, total)
    for job, results in execute(compute, work) if work else ():
        finished = zip(job.trials, results, strict=True)
        new = {(figure, trial): result for trial, result in finished for figure in todo[trial]}
        experiment_table.append(path, new)
        rows |= new
        done += job.cost
        on_progress(done, total)
    experiment_table.write(path, rows)
    return experiment_table.read(path)


def claim(folder: Path, base: Base) -> None:
    """Make the folder, or make sure that its rows come from the same settings."""
    sections = {WORLD_SECTION: base.scenario, **base.filters}
    text, path = scenario_file.to_yaml(**sections), folder / "settings.yaml"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            path.write_text(text)
        known = path.read_text()
    except OSError as error:
        raise InputError(f"cannot write into {folder}: {error.strerror}") from None
    if known != text:
        raise InputError(
            f"{folder} holds an experiment with other settings (settings.yaml there); remove it "
            "or choose another folder with --out"
        )


def repeat(line: str, base: Base, execute: Execute) -> str:
    """The row of table.csv that `line` is, computed again."""
    figure, trial, _ = experiment_table.from_line(line)
    if trial.proposal not in base.filters or trial.trajectory not in TOURS:
        raise InputError(
            f"proposal = '{trial.proposal}', trajectory = '{trial.trajectory}': use "
            f"{' or '.join(base.filters)}, and {', '.join(TOURS)}"
        )
    ((_, (result,)),) = execute(compute, [Job(base, (trial,))])
    return experiment_table.to_line(figure, trial, result)
