"""`study ...`: what this package says about itself, measured again."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from msg_defs import cli
from msg_defs.errors import InputError
from multi_robot_slam.cli.options import FirstSeed, FrameRate, Namespace, Out, ScenarioName, Seed
from multi_robot_slam.cli.terminal import console, countdown, counter, messages

if TYPE_CHECKING:
    from multi_robot_slam.studies import experiment_grid, experiment_table, exploration, table

app = typer.Typer(
    help="Studies of the filter: the paper's experiments, accuracy, real robots, speed.",
    no_args_is_help=True,
)

LONG_S = 600.0
"""Rows of an experiment take minutes: the time left is estimated over as long."""


def _figures(incomplete: str) -> list[str]:
    return [f for f in (*(f"fig{i}" for i in range(3, 10)), "all") if f.startswith(incomplete)]


Experiment = Annotated[
    str | None, typer.Argument(help="fig3, fig4, ... fig9, or all.", autocompletion=_figures)
]
Repeats = Annotated[
    int | None, typer.Option(min=1, help="Runs of each point; default 20, with --quick 2.")
]
ParticleNumbers = Annotated[
    str | None, typer.Option(help="Numbers of particles in figures 5 and 9: 1,50,500.")
]
Quick = Annotated[bool, typer.Option("--quick", help="Few repeats of few points.")]
Processes = Annotated[
    int | None, typer.Option(min=1, help="Processes on this machine; default: one per core.")
]
Scheduler = Annotated[
    str | None, typer.Option(help="Run on the Dask cluster of this scheduler, tcp://...")
]
RowAgain = Annotated[str | None, typer.Option(help="Instead: compute this row of table.csv again.")]
TableFolder = Annotated[
    Path, typer.Option(help="Folder of the table; rows it has are not computed again.")
]


@app.command()
def experiment(
    name: Experiment = None,
    repeats: Repeats = None,
    out: TableFolder = Path("runs/experiments"),
    particles: ParticleNumbers = None,
    first_seed: FirstSeed = 0,
    quick: Quick = False,
    processes: Processes = None,
    scheduler: Scheduler = None,
    row: RowAgain = None,
) -> None:
    """The paper's experiments: table.csv, a picture of each figure, and what it shows.

    Rows are written as they finish: an interrupted experiment goes on where it stopped.
    """
    from multi_robot_slam.studies import experiment_grid, experiments

    base, execute = experiment_grid.paper(), _execution(processes, scheduler)
    if row is not None:
        typer.echo(experiments.repeat(row, base, execute))
        return
    if name is None:
        raise InputError("name the experiment: fig3, fig4, ... fig9, or all")
    grid, count = _grid(quick, particles)
    seeds = range(first_seed, first_seed + (repeats or count))
    wanted = experiment_grid.plan(experiment_grid.figures_of(name), grid, seeds, base)
    _fill(name, wanted, base, out, execute)
    console.print(f"Everything is in {out}", markup=False)


def _execution(processes: int | None, scheduler: str | None) -> "table.Execute":
    """On the cluster of the `scheduler` if one is given, else on this machine."""
    from multi_robot_slam.studies import scheduling

    if scheduler:
        return partial(scheduling.on_cluster, scheduler=scheduler)
    return partial(scheduling.local, processes=processes)


def _grid(quick: bool, particles: str | None) -> "tuple[experiment_grid.Grid, int]":
    """What the figures vary, and how often each point is repeated if nobody says."""
    from multi_robot_slam.studies import experiment_grid

    grid, count = experiment_grid.Grid(), experiment_grid.REPEATS
    if quick:
        grid, count = experiment_grid.QUICK, experiment_grid.QUICK_REPEATS
    if particles is not None:
        grid = replace(grid, particles=experiment_grid.particle_numbers(particles))
    return grid, count


def _fill(
    name: str,
    wanted: "list[experiment_table.Key]",
    base: "exploration.Base",
    out: Path,
    execute: "table.Execute",
) -> None:
    """Bring the table in `out` to hold the rows `wanted`, with a progress bar; then draw them."""
    from multi_robot_slam.studies import experiment_report, experiments

    with countdown(LONG_S) as progress:
        task = progress.add_task(f"{name}, {len(wanted)} rows", total=None)
        rows = experiments.run(
            wanted,
            base,
            out,
            execute,
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    experiment_report.write(rows, base, out)


@app.command()
def accuracy(
    repeats: Annotated[int, typer.Option(min=1, help="Seeds of each team.")] = 20,
    filters: Annotated[
        str, typer.Option(help="Which filters, with commas between.")
    ] = "motion,informed,rejuvenated",
    particles: Annotated[
        str | None,
        typer.Option(
            help="Numbers of particles, with commas between, of every filter. "
            "Default: 10,100,500,2000, and 100,500 of the rejuvenated one."
        ),
    ] = None,
    resample_below: Annotated[
        float, typer.Option(min=0, max=1, help="Share of effective particles to resample below.")
    ] = 0.5,
    first_seed: FirstSeed = 0,
    out: TableFolder = Path("runs/accuracy"),
) -> None:
    """How close filter and refinement come to least squares with the true associations.

    Prints and writes mean and spread over seeds, for 1 to 3 robots in the calibrated scenario:
    the paper's proposal (motion), the informed one, and the informed one with rejuvenation. Rows
    are written as they finish: an interrupted study goes on where it stopped.
    """
    from multi_robot_slam.studies import accuracy, accuracy_table, experiment_grid, scheduling

    chosen = {name: accuracy.PARTICLES[name] for name in accuracy.filters_of(filters)}
    if particles is not None:
        chosen = dict.fromkeys(chosen, experiment_grid.particle_numbers(particles))
    base = accuracy.calibrated(resample_below)
    with counter("explorations") as progress:
        task = progress.add_task("accuracy", total=None)
        rows = accuracy.study(
            out,
            base,
            range(first_seed, first_seed + repeats),
            chosen,
            scheduling.local,
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    typer.echo(accuracy_table.markdown(rows))


@app.command()
def hard(
    rows: Annotated[
        str | None, typer.Option(help="Only these worlds, with commas between: swapped,slip.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each world and team.")] = 10,
    robots: Annotated[str, typer.Option(help="Sizes of the teams: 2,3.")] = "2,3",
    exact: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Instead: N runs in the exact world."),
    ] = None,
    first_seed: FirstSeed = 0,
    processes: Processes = None,
    scheduler: Scheduler = None,
    out: TableFolder = Path("runs/hard"),
) -> None:
    """What becomes of the estimate when the world is not as the fusion is told, and who says so.

    Starts that are off, other noise, gaps, losses, outliers, landmarks that move, late and
    restarted programs, wheels that slip: each world differs in one thing, and its runs are held
    to those of the same team in the exact world. Prints and writes, for each world and team, the
    ratio of errors, NEES, the map, what was said and when, and every run that was wrong and silent.
    Rows are written as they finish: an interrupted study goes on where it stopped.
    """
    from multi_robot_slam.studies import accuracy, hard_table, hard_worlds
    from multi_robot_slam.studies import hard as hard_study

    teams = hard_study.teams_of(robots)
    worlds = hard_worlds.worlds_of(rows) if rows else tuple(hard_worlds.WORLDS)
    if exact is not None:
        worlds, seeds = (hard_worlds.EXACT,), -(-exact // len(teams))
    with countdown(LONG_S) as progress:
        task = progress.add_task("hard worlds", total=None)
        found = hard_study.study(
            out,
            accuracy.calibrated(),
            worlds,
            teams,
            range(first_seed, first_seed + seeds),
            _execution(processes, scheduler),
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    typer.echo(hard_table.markdown(found))


@app.command()
def real(
    folder: Annotated[Path, typer.Argument(help="Folder of a UTIAS MRCLAM recording.")],
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each set-up.")] = 10,
    particles: Annotated[int, typer.Option(min=1, help="Number of particles M.")] = 500,
    first_seed: FirstSeed = 0,
    out: TableFolder = Path("runs/real"),
) -> None:
    """How well the filter locates real robots: together, with and without sightings, and alone.

    Prints and writes mean and spread over seeds of real.csv, for the filter with rejuvenation and
    for both proposals without it, beside odometry and least squares with the true identities. Rows
    are written as they finish: an interrupted study goes on where it stopped.
    """
    from multi_robot_slam.studies import real_robots, real_table, scheduling

    with counter("runs") as progress:
        task = progress.add_task(f"{folder}", total=None)
        rows = real_robots.study(
            folder,
            out,
            range(first_seed, first_seed + seeds),
            particles,
            scheduling.local,
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    typer.echo(real_table.markdown(rows))
    console.print(f"Everything is in {out}", markup=False)


@app.command()
def cameras(
    source: Annotated[str, typer.Argument(help="euroc, kitti, library or rendered.")],
    folder: Annotated[
        Path | None, typer.Argument(help="Folder of the recording, as of `convert euroc`.")
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each set-up.")] = 10,
    particles: Annotated[int, typer.Option(min=1, help="Number of particles M.")] = 500,
    setups: Annotated[
        str | None, typer.Option(help="Only these set-ups, with commas between.")
    ] = None,
    first_seed: FirstSeed = 0,
    processes: Processes = None,
    out: Out = None,
) -> None:
    """How good SLAM from images is: from recorded stereo cameras, and from rendered ones.

    EuRoC as one robot, as two at once, and as each half alone; KITTI as one robot; the simulated
    building, three robots, with images and with landmarks that have the same noise; and each thing
    that spoils images in turn. A seed is that of the odometry's errors and of the filter. Prints
    and writes mean and spread over seeds of cameras.csv. Rows are written as they finish: an
    interrupted study goes on where it stopped.
    """
    from multi_robot_slam.studies import cameras as study_of_cameras
    from multi_robot_slam.studies import scheduling

    if source == "library":
        _library(folder, range(first_seed, first_seed + seeds), particles)
        return
    wanted = study_of_cameras.plan(source, folder, setups, particles)
    out = out or Path("runs/cameras") / source
    with counter("runs") as progress:
        task = progress.add_task(f"{source}: looking at images", total=None)
        rows = study_of_cameras.study(
            wanted,
            range(first_seed, first_seed + seeds),
            out,
            partial(scheduling.local, processes=processes),
            lambda done, total: progress.update(
                task, completed=done, total=total, description=source
            ),
        )
    typer.echo(study_of_cameras.markdown(wanted, rows))
    console.print(f"Everything is in {out}", markup=False)


@app.command()
def front_end(
    source: Annotated[str, typer.Argument(help="euroc, kitti or rendered.")],
    folder: Annotated[
        Path | None, typer.Argument(help="Folder of the recording, as of `convert euroc`.")
    ] = None,
    scale: Annotated[
        float, typer.Option(min=0.1, max=1, help="Size of the images that are searched.")
    ] = 1.0,
    setup: Annotated[
        str, typer.Option(help="Of rendered images: a set-up of `study cameras`.")
    ] = "rendered",
) -> None:
    """How good landmarks found in images are, one pair against another, and how long they take.

    Of a recording: landmark NEES, matches of places that are seen again, the pose of one frame from
    another's landmarks, the drift from frame to frame, and the time of a pair beside that of SIFT
    alone. Of rendered images the time of both. Times are those of one thread.
    """
    from multi_robot_slam.studies import cameras_rendered, front_end_table

    if source not in ("euroc", "kitti", "rendered"):
        raise InputError(f"no images '{source}'; there are euroc, kitti, rendered")
    if (folder is None) != (source == "rendered"):
        raise InputError(f"study front-end {source}: name the folder of a recording, and none else")
    images = [name for name in cameras_rendered.SETUPS if name != cameras_rendered.LANDMARKS]
    if setup not in images:
        raise InputError(f"no set-up '{setup}' with images; there are {', '.join(images)}")
    with messages.status(f"Looking at images of {folder or setup}"):
        if folder is None:
            found = front_end_table.of_rendered(setup)
        else:
            found = front_end_table.of_recording(source, folder, scale)
    typer.echo(front_end_table.markdown(found))


@app.command()
def descriptors(
    bag: Annotated[Path, typer.Argument(help="Bag of images, or of landmarks found in images.")],
    namespace: Namespace = None,
) -> None:
    """How far descriptors of equal and of different landmarks are apart: filter.descriptor_gate.

    What is equal is told by the true poses in the bag, or else by those that a run estimates.
    Prints both distributions, and the largest threshold with one wrong match in a hundred.
    """
    from multi_robot_slam.cli import configuration
    from multi_robot_slam.cli.terminal import warn
    from multi_robot_slam.studies import descriptor_gate

    config = configuration.of_run(configuration.Recording(bag, namespace), None, {}, warn)
    with messages.status(f"Comparing the frames of {bag}"):
        found = descriptor_gate.derive(bag, config)
    typer.echo(descriptor_gate.markdown(found, config.filter.descriptor_gate))


def _library(folder: Path | None, seeds: range, particles: int) -> None:
    """How far the walk round the library misses its closure."""
    from multi_robot_slam.front_end.settings import CameraSettings
    from multi_robot_slam.studies import cameras_library, library

    if folder is None:
        raise InputError("name the folder of the recording: study cameras library FOLDER")
    pairs = library.read(folder)
    with messages.status(f"Looking at {2 * len(pairs)} pairs of {folder}") as status:
        walked = cameras_library.walk(pairs, CameraSettings())
        rows = []
        for seed in seeds:
            status.update(f"Run {seed - seeds[0] + 1} of {len(seeds)}")
            rows.append(cameras_library.run(walked, pairs, seed, particles))
    typer.echo(cameras_library.markdown(walked, pairs, rows))


@app.command()
def hours(
    hours: Annotated[float, typer.Option(min=0.01, help="Length of each run [h].")] = 4.0,
    robots: Annotated[int, typer.Option(min=1, max=32, help="Number of robots.")] = 3,
    particles: Annotated[int, typer.Option(min=1, help="Number of particles M.")] = 500,
    seeds: Annotated[int, typer.Option(min=1, help="Runs, each with a seed of its own.")] = 1,
    first_seed: FirstSeed = 0,
    optimum: Annotated[
        float,
        typer.Option(
            metavar="MINUTES",
            min=0,
            help="At the end of each row that lies in the first MINUTES, also compute the best "
            "possible poses: least squares with the true associations. Up to 30; all frames are "
            "then kept in memory, and a run of 30 minutes needs gigabytes for it.",
        ),
    ] = 0.0,
    processes: Processes = None,
    out: TableFolder = Path("runs/hours"),
) -> None:
    """Whether the filter stays as fast, small and honest as it begins: round and round for hours.

    A team at 10 Hz drives round the building; its messages go through the filter as fast as it
    takes them, and map and paths are made once a second, as in a live fusion. Writes a row for
    each tenth of a run (of at most ten minutes) to hours.csv, and to hours.md, which is also
    printed, the rows over all seeds with the figures they are to reach. NEES is 3 for an honest
    filter.

    One process for each seed, on all cores; so that a thread of rejuvenation finds a core free, as
    in a live fusion, use no more --processes than half of the cores: longest steps depend on it. A
    whole run is written when it ends.
    """
    from multi_robot_slam.studies import accuracy, hours_table, scheduling
    from multi_robot_slam.studies import hours as study_of_hours

    rows = study_of_hours.study(
        out,
        accuracy.calibrated(),
        study_of_hours.Plan(robots, particles, 3600 * hours, 60 * optimum),
        range(first_seed, first_seed + seeds),
        partial(scheduling.local, processes=processes),
    )
    typer.echo(hours_table.markdown(rows))
    console.print(f"Everything is in {out}", markup=False)


@app.command()
def latency(
    robots: Annotated[int, typer.Option(min=1, max=32, help="Number of robots.")] = 3,
    rate: FrameRate = 10.0,
    laps: Annotated[
        int, typer.Option(min=1, help="Rounds of the tour; three robots take 75 s for one.")
    ] = 1,
    scenario: ScenarioName = "calibrated",
    seed: Seed = 0,
    out: Out = None,
) -> None:
    """How long after a cloud its pose is out: simulated robots and fusion, live, in real time.

    A third process notes when each message arrives, by one monotonic clock. What is printed is the
    time from a cloud to the pose of the step that it became, and from the odometry of a frame that
    did not to the pose that was predicted: transport, wait for the other robots, filter, encoding.
    Leave the machine alone meanwhile. Keeps the arrivals, arrivals.csv, and latency.md.
    """
    from msg_defs.ros import environment
    from multi_robot_slam.cli import folders, processes, simulated
    from multi_robot_slam.studies import latency as study_of_latency

    cli.require_ros()
    environment.prepare()
    world, config = simulated.configure(scenario, robots, seed, rate, laps)
    with folders.new_folder(out) as folder:
        (folder / "scenario.yaml").write_text(simulated.to_yaml(world, config))
        arrivals = folder / "arrivals.csv"
        processes.clock(arrivals, folder / "scenario.yaml", seed)
        found = study_of_latency.latencies(study_of_latency.read(arrivals), world.names)
        text = study_of_latency.markdown(found)
        (folder / "latency.md").write_text(text)
    typer.echo(text)
    console.print(f"Everything is in {folder}", markup=False)


@app.command()
def bench(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write the rows.")] = None,
    quick: Annotated[bool, typer.Option(help="Fewer steps: under 90 s.")] = False,
    first_seed: Annotated[int, typer.Option(min=0, help="Seed of the measured runs.")] = 0,
) -> None:
    """Measure the filter's speed and memory, beside what this machine would allow.

    Takes five minutes. Processor time where nothing else is said, so that other programs disturb it
    little; how fast a bag is run, and how long the first step takes, is time that passes.
    """
    from multi_robot_slam.studies import bench

    if json is not None:
        try:
            json.touch()
        except OSError as error:
            raise InputError(f"cannot write {json}: {error.strerror}; choose another") from None
    with messages.status("Measuring, one thread; leave the machine alone"):
        rows = bench.run(quick, first_seed)
    if json is not None:
        json.write_text(bench.to_json(rows))
    console.print(bench.report(rows))
