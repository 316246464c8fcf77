"""`demo` and `run`: a new run, from simulated robots or from a bag."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from msg_defs import cli
from multi_robot_slam.cli import overrides
from multi_robot_slam.cli.options import Namespace, OtherScenario, Out, Robots, Seed
from multi_robot_slam.cli.terminal import countdown, warn

LIVE_SPEED, PICTURES_SPEED = 5.0, 1.0
"""Times real time: that a fusion does with ease, and so do three front ends on two cores."""


def demo(
    scenario: Annotated[
        str | None,
        typer.Option(
            help="Scenario: a YAML file, or paper, calibrated or cameras. Default: calibrated, "
            "with --images cameras.",
            autocompletion=cli.scenarios,
        ),
    ] = None,
    robots: Robots = None,
    seed: Seed = 0,
    speed: Annotated[
        float | None,
        typer.Option(min=0, help="Times real time; 0: at once. Default: 5, with pictures 1."),
    ] = None,
    images: Annotated[
        bool,
        typer.Option(
            "--images",
            help="Robots send pictures, in which a camera node for each sees the landmarks.",
        ),
    ] = False,
    unknown_starts: Annotated[
        bool,
        typer.Option(
            "--unknown-starts",
            help="Nobody tells where robots start, but of the first. Each maps by itself until it "
            "has seen enough of what others saw; a line says when, and by what.",
        ),
    ] = False,
    map_: Annotated[
        Path | None,
        typer.Option(
            "--map",
            metavar="FILE",
            help="Another day: robots start elsewhere in the map of an earlier demo, a run's "
            "folder or the map.npz in it, and nobody tells where.",
        ),
    ] = None,
    watch: Annotated[
        bool, typer.Option(help="Serve a page to watch it in the browser, until the demo ends.")
    ] = True,
    out: Out = None,
) -> None:
    """Simulated robots, fusion and recorder as processes that talk over ROS 2; then the results.

    Leaves a bag, the configuration, result.json, trajectories, the map, pictures and report.html,
    a page to explore them, in runs/<time>, with a link runs/latest. The map is in map.npz, too,
    for another day:

        multi_robot_slam demo --unknown-starts

        multi_robot_slam demo --map runs/latest/map.npz
    """
    from msg_defs.ros import environment
    from multi_robot_slam import runs
    from multi_robot_slam.cli import folders, maps, processes, results, simulated
    from multi_robot_slam.pipeline import map_files, offline

    cli.require_ros()
    environment.prepare()
    scenario = scenario or ("cameras" if images else "calibrated")
    begun_in = None if map_ is None else maps.found(map_).resolve()
    offset = None
    if begun_in is not None:
        map_files.read_about(begun_in)
        offset = simulated.OTHER_DAY
    world, config = simulated.configure(scenario, robots, seed, images=images, start_offset=offset)
    if unknown_starts or begun_in is not None:
        config = simulated.with_unknown_starts(config, are_told=begun_in is None)
    if speed is None:
        speed = PICTURES_SPEED if world.images.enabled else LIVE_SPEED
    with folders.new_folder(out) as folder:
        (folder / "scenario.yaml").write_text(simulated.to_yaml(world, config))
        with processes.watching() if watch else nullcontext():
            processes.record(folder, folder / "scenario.yaml", seed, speed, begun_in)
            result = replace(offline.load(folder), provenance=runs.here(scenario))
            results.draw(result, results.finish(result, folder), folder)


def run(
    bag: Annotated[Path, typer.Argument(help="Bag folder, .mcap or .db3 file.")],
    out: Out = None,
    scenario: OtherScenario = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Any setting by its dotted name, such as filter.gate=9; can be given repeatedly.",
            autocompletion=overrides.completions,
        ),
    ] = None,
    particles: Annotated[
        int | None, typer.Option(min=1, help="Number of particles M: filter.particles.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the filter: seed.")] = None,
    namespace: Namespace = None,
    map_: Annotated[
        Path | None,
        typer.Option(
            "--map",
            metavar="FILE",
            help="Map to begin with, of an earlier run (map.npz in its folder); robots start in it "
            "at their start_poses, as certain as start_sigma says, the first one too; or anywhere, "
            "where these are unknown.",
        ),
    ] = None,
    refine: Annotated[
        bool, typer.Option("--refine", help="Then smooth over the best particle's associations.")
    ] = False,
) -> None:
    """Estimate paths and map from a recorded bag, as fast as the filter goes; no ROS needed.

    Prints errors where the bag holds the truth. `evaluate` adds the yardstick, the best answer
    there is, and pictures; `report` draws the page to explore.

    The map is left in map.npz, for `run --map` on another day: with other robots, or as many. By
    default they go on mapping; with `--set filter.mapping=false` they are localised in the map,
    which does not change. `map info` and `map export` read it.
    """
    from multi_robot_slam import runs
    from multi_robot_slam.cli import configuration, folders, maps, results
    from multi_robot_slam.pipeline import offline

    words = list(set_ or ())
    words += [f"filter.particles={particles}"] if particles is not None else []
    words += [f"seed={seed}"] if seed is not None else []
    recording = configuration.Recording(bag, namespace)
    config = configuration.of_run(recording, scenario, overrides.parse(words), warn)
    pipeline = maps.begin(config, map_, refine)
    with folders.new_folder(out) as folder:
        with countdown() as progress:
            task = progress.add_task(f"{bag}", total=None)
            result = offline.estimate_by(
                pipeline,
                bag,
                on_progress=lambda done, total: progress.update(task, completed=done, total=total),
                refine=refine,
                namespace=namespace,
                scenario=scenario,
            )
        runs.write_estimates(result, folder)
        maps.leave(pipeline, result, folder)
        results.finish(result, folder, with_pictures=False)
