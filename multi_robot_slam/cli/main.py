"""The command `multi_robot_slam`: one function per verb."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from msg_defs import cli, scenario_file, topics
from msg_defs.errors import InputError
from multi_robot_slam import runs
from multi_robot_slam.bags import BagReader
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.pipeline import offline
from multi_robot_slam.runs import evaluation, evaluation_table

app = typer.Typer(
    help="Multi-robot visual SLAM: one landmark map and all robots' paths.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
)
convert = typer.Typer(
    help="Recordings of real robots, downloaded in their own formats -> bags for `run`.",
    no_args_is_help=True,
)
app.add_typer(convert, name="convert")
PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True}
"""All that follows a node's verb is the node's to read."""

console = Console()
messages = Console(stderr=True)

Out = Annotated[Path | None, typer.Option(help="Folder to write; it must not exist yet.")]
ScenarioName = Annotated[str, typer.Option(help="Scenario: a YAML file, or paper or calibrated.")]
RunFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run.")]
BagOut = Annotated[Path, typer.Option(help="Bag to write; it must not exist yet.")]
FrameRate = Annotated[
    float, typer.Option(min=0.01, max=100, help="Frames of each robot in a second [Hz].")
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")]


@app.command()
def demo(
    scenario: ScenarioName = "calibrated",
    robots: Annotated[int | None, typer.Option(min=1, max=32, help="Number of robots.")] = None,
    seed: Seed = 0,
    speed: Annotated[float, typer.Option(min=0, help="Times real time; 0: at once.")] = 5.0,
    out: Out = None,
) -> None:
    """Simulated robots, fusion and recorder as processes that talk over ROS 2; then the results.

    Leaves a bag, the configuration, result.json, trajectories, the map, pictures and report.html,
    a page to explore them, in runs/<time>, with a link runs/latest.
    """
    from multi_robot_slam.cli import demo

    cli.require_ros()
    text = demo.configure(scenario, robots, seed)
    with _new_folder(out) as folder:
        (folder / "scenario.yaml").write_text(text)
        demo.record(folder, folder / "scenario.yaml", seed, speed)
        result = offline.load(folder)
        _draw(result, _finish(result, folder), folder)


@app.command()
def run(
    bag: Annotated[Path, typer.Argument(help="Bag folder, .mcap or .db3 file.")],
    out: Out = None,
    scenario: Annotated[
        str | None, typer.Option(help="Scenario; default: the configuration in the bag.")
    ] = None,
    particles: Annotated[int | None, typer.Option(min=1, help="Number of particles M.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the filter.")] = None,
    refine: Annotated[
        bool, typer.Option("--refine", help="Then smooth over the best particle's associations.")
    ] = False,
) -> None:
    """Estimate paths and map from a recorded bag, as fast as the filter goes; no ROS needed."""
    config = _configuration(bag, scenario, particles, seed)
    with _new_folder(out) as folder:
        with _progress() as progress:
            task = progress.add_task(f"{bag}", total=None)
            result = offline.estimate(
                bag,
                config,
                warn=lambda text: messages.print(text, style="yellow", markup=False),
                on_step=lambda step: progress.update(task, completed=step.step),
                refine=refine,
            )
        runs.write_estimates(result, folder)
        _finish(result, folder)


@app.command()
def evaluate(folder: RunFolder) -> None:
    """Judge a run, live or offline, against the ground truth in its bag.

    Prints tables and writes result.json, figures.csv, trajectories and pictures into DIR. Errors
    are unaligned, aligned robot by robot, and aligned as a team; what has no truth is left out.
    `evo_ape tum truth_NAME.tum trajectory_NAME.tum`, `--align` too, gives the same figures.
    """
    with messages.status(f"Reading {folder}"):
        result = offline.load(folder)
    _finish(result, folder)


@app.command()
def report(folder: RunFolder) -> None:
    """Draw a run, live or offline, as a page to explore: DIR/report.html.

    The building in three dimensions with the robots where they were at any time, errors and their
    bounds, particles, associations, timing, configuration. One file that opens in any browser,
    without network.
    """
    with messages.status(f"Reading {folder}"):
        result = offline.load(folder)
    _draw(result, evaluation.evaluate(result), folder)


@app.command()
def compare(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Folders of runs.")],
    csv: Annotated[
        Path | None, typer.Option("--csv", metavar="FILE", help="Also write all figures.")
    ] = None,
) -> None:
    """The figures of several runs side by side, as `evaluate` or `run` left them in result.json.

    Says how much each differs from the first, and where recordings and settings do.
    """
    from multi_robot_slam.runs import comparison

    compared = comparison.compare(folders)
    console.print(comparison.table(compared))
    for line in comparison.notes(compared):
        console.print(line, style="yellow", markup=False)
    if csv is not None:
        comparison.write(compared, csv)


@app.command()
def export(
    folder: RunFolder,
    to: Annotated[str, typer.Option("--to", help="tum, g2o or ply.")],
    out: Annotated[Path, typer.Option(help="File to write; with tum, a folder.")],
) -> None:
    """Write map and paths of a run for other programs, and say what these cannot hold.

    tum: every path, for evo. g2o: poses, odometry and landmarks in the plane, for optimisers. ply:
    landmarks with their uncertainty, and paths as coloured points, for point cloud viewers.
    """
    from multi_robot_slam.runs import exports

    with messages.status(f"Reading {folder}"):
        lines = exports.export(runs.load(folder), to, out)
    for line in [*lines, f"Everything is in {out}"]:
        console.print(line, markup=False)


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
    rest: Annotated[
        int | None,
        typer.Option(min=1, help="Fewest steps between two rejuvenations, if not the scenario's."),
    ] = None,
    out: Annotated[
        Path, typer.Option(help="Folder of the table; rows it has are not computed again.")
    ] = Path("runs/accuracy"),
) -> None:
    """How close filter and refinement come to least squares with the true associations.

    Prints and writes mean and spread over seeds, for 1 to 3 robots in the calibrated scenario:
    the paper's proposal (motion), the informed one, and the informed one with rejuvenation. Rows
    are written as they finish: an interrupted study goes on where it stopped.
    """
    from multi_robot_slam.studies import accuracy, experiments, scheduling

    chosen = {name: accuracy.PARTICLES[name] for name in accuracy.filters_of(filters)}
    if particles is not None:
        chosen = dict.fromkeys(chosen, experiments.particle_numbers(particles))
    base = accuracy.calibrated(resample_below, rest)
    with _progress() as progress:
        task = progress.add_task("explorations", total=None)
        rows = accuracy.study(
            out,
            base,
            repeats,
            chosen,
            scheduling.local,
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    typer.echo(accuracy.markdown(rows))


@app.command()
def experiment(
    name: Annotated[str | None, typer.Argument(help="fig3, fig4, ... fig9, or all.")] = None,
    repeats: Annotated[
        int | None, typer.Option(min=1, help="Runs of each point; default 20, with --quick 2.")
    ] = None,
    out: Annotated[
        Path, typer.Option(help="Folder of the table; rows it has are not computed again.")
    ] = Path("runs/experiments"),
    particles: Annotated[
        str | None, typer.Option(help="Numbers of particles in figures 5 and 9: 1,50,500.")
    ] = None,
    first_seed: Annotated[int, typer.Option(min=0, help="Seed of the first repeat.")] = 0,
    quick: Annotated[bool, typer.Option("--quick", help="Few repeats of few points.")] = False,
    processes: Annotated[
        int | None, typer.Option(min=1, help="Processes on this machine; default: one per core.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Run on the Dask cluster of this scheduler, tcp://...")
    ] = None,
    row: Annotated[
        str | None, typer.Option(help="Instead: compute this row of table.csv again.")
    ] = None,
) -> None:
    """The paper's experiments: table.csv, a picture of each figure, and what it shows.

    Rows are written as they finish: an interrupted experiment goes on where it stopped.
    """
    from multi_robot_slam.studies import experiment_report, experiments, scheduling

    base = experiments.paper()
    execute = (
        partial(scheduling.on_cluster, scheduler=scheduler)
        if scheduler
        else partial(scheduling.local, processes=processes)
    )
    if row is not None:
        typer.echo(experiments.repeat(row, base, execute))
        return
    if name is None:
        raise InputError("name the experiment: fig3, fig4, ... fig9, or all")
    grid = experiments.QUICK if quick else experiments.Grid()
    if particles is not None:
        grid = replace(grid, particles=experiments.particle_numbers(particles))
    count = repeats or (experiments.QUICK_REPEATS if quick else experiments.REPEATS)
    seeds = range(first_seed, first_seed + count)
    wanted = experiments.plan(experiments.figures_of(name), grid, seeds, base)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn())
    with Progress(
        *columns,
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=messages,
        speed_estimate_period=600,
        transient=True,
        disable=not messages.is_terminal,
    ) as progress:
        task = progress.add_task(f"{name}, {len(wanted)} rows", total=None)
        rows = experiments.run(
            wanted,
            base,
            out,
            execute,
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    experiment_report.write(rows, base, out)
    console.print(f"Everything is in {out}", markup=False)


@app.command()
def bench(
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write the rows.")] = None,
    quick: Annotated[bool, typer.Option(help="Fewer steps: under 40 s.")] = False,
) -> None:
    """Measure the filter's speed and memory, beside what this machine would allow."""
    from multi_robot_slam.studies import bench

    if json is not None:
        try:
            json.touch()
        except OSError as error:
            raise InputError(f"cannot write {json}: {error.strerror}; choose another") from None
    with messages.status("Measuring, one thread; leave the machine alone"):
        rows = bench.run(quick)
    if json is not None:
        json.write_text(bench.to_json(rows))
    console.print(bench.report(rows))


@convert.command()
def mrclam(
    folder: Annotated[
        Path, typer.Argument(help="Folder with Barcodes.dat, Robot1_Odometry.dat, ...")
    ],
    out: BagOut,
    rate: FrameRate = 1.0,
) -> None:
    """A recording of UTIAS MRCLAM: several robots, barcode landmarks, robots that see robots."""
    from multi_robot_slam.datasets import mrclam

    _convert(mrclam.read, folder, out, rate)


@convert.command()
def utias(
    file: Annotated[Path, typer.Argument(metavar="FILE.mat", help="dataset2.mat of pysteam.")],
    out: BagOut,
    rate: FrameRate = 1.0,
) -> None:
    """One planar robot with range and bearing, from the pysteam tutorials."""
    from multi_robot_slam.datasets import utias

    _convert(utias.read, file, out, rate)


def _convert(read: Callable, source: Path, out: Path, rate: float) -> None:
    from multi_robot_slam.datasets import bag

    with messages.status(f"Reading {source}") as status:
        recording = read(source)
        total = len(recording.robots)

        def tell(robot: str) -> None:
            number = list(recording.robots).index(robot) + 1
            status.update(f"Converting {source}: {robot}, {number} of {total}")

        counts = bag.write(recording, out, rate, tell)
    console.print(bag.table(counts))
    console.print(f"Now: multi_robot_slam run {out}", markup=False, soft_wrap=True)


@app.command()
def real(
    folder: Annotated[Path, typer.Argument(help="Folder of a UTIAS MRCLAM recording.")],
    seeds: Annotated[int, typer.Option(min=1, help="Runs of each set-up.")] = 10,
    particles: Annotated[int, typer.Option(min=1, help="Number of particles M.")] = 500,
    out: Out = None,
) -> None:
    """How well the filter locates real robots: together, with and without sightings, and alone.

    Prints and writes mean and spread over seeds of real.csv, for the filter with rejuvenation and
    for both proposals without it, beside odometry and least squares with the true identities.
    """
    from multi_robot_slam.studies import real_robots, scheduling

    with _new_folder(out) as target:
        with _progress() as progress:
            task = progress.add_task(f"{folder}", total=None)
            rows = real_robots.study(
                folder,
                target,
                seeds,
                particles,
                scheduling.local,
                lambda done, total: progress.update(task, completed=done, total=total),
            )
        real_robots.write(rows, target)
    typer.echo(real_robots.markdown(rows))
    console.print(f"Everything is in {target}", markup=False)


@app.command(context_settings=PASSED_ON, add_help_option=False)
def fusion(context: typer.Context) -> None:
    """ROS node: the team's odometry and observations in, poses and the landmark map out.

    Parameters as for any node: multi_robot_slam fusion --ros-args -p scenario:=FILE
    """
    cli.start_node("multi_robot_slam.nodes.fusion", context.args)


@app.command(context_settings=PASSED_ON, add_help_option=False)
def record(context: typer.Context) -> None:
    """ROS node: records all topics of the team, the simulator and the fusion into a bag.

    Parameters as for any node: multi_robot_slam record --ros-args -p out:=FOLDER -p robots:=[...]
    """
    cli.start_node("multi_robot_slam.nodes.recorder", context.args)


@app.command(context_settings=PASSED_ON, add_help_option=False)
def replay(context: typer.Context) -> None:
    """ROS node: publishes what was recorded in a bag, at its pace, with /clock.

    By default all but what a fusion made of it, so that another fusion can run on it.
    Parameters as for any node: multi_robot_slam replay --ros-args -p bag:=FOLDER -p rate:=5.0
    """
    cli.start_node("multi_robot_slam.nodes.replay", context.args)


def _configuration(
    bag: Path, scenario: str | None, particles: int | None, seed: int | None
) -> Config:
    recorded = offline.recorded_config(bag)
    if scenario is not None:
        config = scenario_file.from_file(Config, scenario_file.find_scenario(scenario), SECTION)
    elif recorded is None:
        raise InputError(
            f"{bag} carries no configuration on /{topics.FUSION_CONFIG.name}, its topics are "
            f"{BagReader(bag).found()}: name one with --scenario"
        )
    else:
        config = recorded
    values = scenario_file.to_plain(config)
    if scenario is not None and recorded is not None:
        values |= {"robots": recorded.robots, "start_poses": recorded.start_poses}
    if particles is not None:
        values["filter"]["particles"] = particles
    if seed is not None:
        values["seed"] = seed
    return scenario_file.from_mapping(Config, values)


@contextmanager
def _new_folder(out: Path | None) -> Iterator[Path]:
    """Make `out`, or runs/<time>, and then the link runs/latest; what stays empty is removed."""
    folder = out or Path("runs") / f"{datetime.now():%Y%m%d_%H%M%S}"
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise InputError(f"{folder} exists; remove it or choose another with --out") from None
    except OSError as error:
        raise InputError(f"cannot make the folder {folder}: {error.strerror}") from None
    try:
        yield folder
    finally:
        if not any(folder.iterdir()):
            folder.rmdir()
        elif out is None:
            _link_latest(folder)


def _link_latest(folder: Path) -> None:
    link = folder.parent / "latest.new"
    link.unlink(missing_ok=True)
    link.symlink_to(folder.name)
    os.replace(link, folder.parent / "latest")


def _finish(result: runs.Run, folder: Path) -> dict:
    """Write and print what there is to say of a run; its figures."""
    from multi_robot_slam.report import plots

    for warning in result.warnings:
        messages.print(warning, style="yellow", markup=False)
    figures = evaluation.evaluate(result)
    runs.write(result, figures, folder)
    plots.save(result, folder)
    console.print(evaluation_table.table(figures))
    console.print(f"Everything is in {folder}", markup=False)
    return figures


def _draw(result: runs.Run, figures: dict, folder: Path) -> None:
    from multi_robot_slam.report import page

    with messages.status(f"Drawing {folder / page.FILE}"):
        path = page.write(result, figures, folder)
    console.print(path, markup=False, highlight=False, soft_wrap=True)


def _progress() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed} steps"))
    elapsed, is_shown = TimeElapsedColumn(), messages.is_terminal
    return Progress(*columns, elapsed, console=messages, transient=True, disable=not is_shown)


def main() -> None:
    """Entry point of the command `multi_robot_slam`."""
    cli.run(app)


if __name__ == "__main__":
    main()
