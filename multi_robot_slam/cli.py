"""The command `multi_robot_slam`: one function per verb."""

import os
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

from msg_defs import cli, settings
from msg_defs.errors import InputError
from multi_robot_slam import evaluation, offline, plots, runs
from multi_robot_slam.config import SECTION, Config

app = typer.Typer(
    help="Multi-robot visual SLAM: one landmark map and all robots' paths.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
)
console = Console()
messages = Console(stderr=True)

Out = Annotated[Path | None, typer.Option(help="Folder to write; it must not exist yet.")]
ScenarioName = Annotated[str, typer.Option(help="Scenario: a YAML file, or paper or calibrated.")]
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

    Leaves a bag, the configuration, result.json, trajectories, the map and pictures in
    runs/<time>, with a link runs/latest.
    """
    from multi_robot_slam import demo

    cli.require_ros()
    text = demo.configure(scenario, robots, seed)
    folder = _new_folder(out)
    (folder / "scenario.yaml").write_text(text)
    demo.record(folder, folder / "scenario.yaml", seed, speed)
    evaluate(folder)


@app.command()
def run(
    bag: Annotated[Path, typer.Argument(help="Bag folder or .mcap file.")],
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
    folder = _new_folder(out)
    with _progress() as progress:
        task = progress.add_task(f"{bag}", total=None)
        result = offline.estimate(
            bag,
            config,
            warn=lambda text: messages.print(text, style="yellow", markup=False),
            on_step=lambda step: progress.update(task, completed=step.step),
            refine=refine,
        )
    _finish(result, folder)


@app.command()
def evaluate(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a live run.")],
) -> None:
    """Judge a live run: DIR/bag against the ground truth in it. Prints and writes the results."""
    bag = folder / "bag" if (folder / "bag").exists() else folder
    _finish(offline.live(bag), folder)


@app.command()
def accuracy(
    repeats: Annotated[int, typer.Option(min=1, help="Seeds of each team.")] = 20,
    particles: Annotated[
        str, typer.Option(help="Numbers of particles, with commas between.")
    ] = "10,100,500,2000",
    resample_below: Annotated[
        float, typer.Option(min=0, max=1, help="Share of effective particles to resample below.")
    ] = 0.5,
    out: Annotated[Path, typer.Option(help="Folder to write.")] = Path("runs/accuracy"),
) -> None:
    """How close filter and refinement come to least squares with the true associations.

    Prints and writes mean and spread over seeds, for 1 to 3 robots and both proposals.
    """
    from multi_robot_slam import accuracy, experiments, scheduling

    with _progress() as progress:
        task = progress.add_task("explorations", total=None)
        rows = accuracy.study(
            repeats,
            experiments.particle_numbers(particles),
            resample_below,
            scheduling.local,
            lambda done, total: progress.update(task, completed=done, total=total),
        )
    accuracy.write(rows, out)
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
    from multi_robot_slam import experiment_report, experiments, scheduling

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
    from multi_robot_slam import bench

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


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def fusion(context: typer.Context) -> None:
    """ROS node: the team's odometry and observations in, poses and the landmark map out.

    Parameters as for any node: multi_robot_slam fusion --ros-args -p scenario:=FILE
    """
    cli.start_node("multi_robot_slam.fusion", context.args)


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def record(context: typer.Context) -> None:
    """ROS node: records all topics of the team, the simulator and the fusion into a bag.

    Parameters as for any node: multi_robot_slam record --ros-args -p out:=FOLDER -p robots:=[...]
    """
    cli.start_node("multi_robot_slam.recorder", context.args)


def _configuration(
    bag: Path, scenario: str | None, particles: int | None, seed: int | None
) -> Config:
    recorded = offline.recorded_config(bag)
    if scenario is not None:
        config = settings.from_file(Config, settings.find_scenario(scenario), SECTION)
    elif recorded is None:
        raise InputError(f"{bag} carries no configuration: name one with --scenario")
    else:
        config = recorded
    values = settings.to_plain(config)
    if scenario is not None and recorded is not None:
        values |= {"robots": recorded.robots, "start_poses": recorded.start_poses}
    if particles is not None:
        values["filter"]["particles"] = particles
    if seed is not None:
        values["seed"] = seed
    return settings.from_mapping(Config, values)


def _new_folder(out: Path | None) -> Path:
    """Make `out`, or runs/<time> with the link runs/latest."""
    folder = out or Path("runs") / f"{datetime.now():%Y%m%d_%H%M%S}"
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise InputError(f"{folder} exists; remove it or choose another with --out") from None
    except OSError as error:
        raise InputError(f"cannot make the folder {folder}: {error.strerror}") from None
    if out is None:
        link = folder.parent / "latest.new"
        link.unlink(missing_ok=True)
        link.symlink_to(folder.name)
        os.replace(link, folder.parent / "latest")
    return folder


def _finish(result: runs.Run, folder: Path) -> None:
    for warning in result.warnings:
        messages.print(warning, style="yellow", markup=False)
    figures = evaluation.evaluate(result)
    runs.write(result, figures, folder)
    plots.save(result, folder)
    console.print(evaluation.table(figures))
    console.print(f"Everything is in {folder}", markup=False)


def _progress() -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed} steps"))
    return Progress(*columns, TimeElapsedColumn(), console=messages, transient=True)


def main() -> None:
    """Entry point of the command `multi_robot_slam`."""
    cli.run(app)


if __name__ == "__main__":
    main()
