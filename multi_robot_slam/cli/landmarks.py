"""`landmarks`: what the front end sees in the pictures of a bag, as another bag."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from multi_robot_slam.cli import overrides
from multi_robot_slam.cli.options import BagOut, Namespace, OtherScenario
from multi_robot_slam.cli.terminal import console, countdown, warn

if TYPE_CHECKING:
    from rich.table import Table

    from multi_robot_slam.pipeline.landmarks import Result


def landmarks(
    bag: Annotated[Path, typer.Argument(help="Bag folder, .mcap or .db3 file.")],
    out: BagOut,
    scenario: OtherScenario = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Any setting by its dotted name, such as camera.features.scale=0.5; can be given "
            "repeatedly.",
            autocompletion=overrides.completions,
        ),
    ] = None,
    namespace: Namespace = None,
    keep_images: Annotated[
        bool, typer.Option("--keep-images", help="Copy the pictures, too.")
    ] = False,
) -> None:
    """Pictures in, observations out: what the node `camera` would publish, everything else copied.

    `run` on the result needs nothing else, and gives what `run` on the pictures gives, as often as
    settings of the filter change. Of a robot that hardly moves few pairs are looked at (keyframe.*,
    camera.rest_s).
    """
    from multi_robot_slam.cli import configuration
    from multi_robot_slam.pipeline import landmarks as pictures

    recording = configuration.Recording(bag, namespace)
    config = configuration.of_run(recording, scenario, overrides.parse(set_ or ()), warn)
    with countdown() as progress:
        task = progress.add_task(f"{bag}", total=None)
        result = pictures.write(
            bag,
            out,
            config,
            warn,
            on_progress=lambda done, total: progress.update(task, completed=done, total=total),
            namespace=namespace,
            keep_images=keep_images,
        )
    console.print(_table(result))
    if result.left_out:
        warn(f"not copied, for their types are unknown: {', '.join(result.left_out)}")
    console.print(f"Now: multi_robot_slam run {out}", markup=False, soft_wrap=True)


def _table(result: "Result") -> "Table":
    """What became of each robot's pictures, and what was dropped."""
    from rich.box import SIMPLE
    from rich.table import Table

    dropped = ", ".join(f"{what}: {count}" for what, count in sorted(result.dropped.items()))
    caption = f"dropped: {dropped}" if dropped else None
    shown = Table(title="pictures", caption=caption, box=SIMPLE, padding=(0, 1, 0, 0))
    shown.title_justify = shown.caption_justify = "left"
    for name in ("", "pairs looked at", "points matched", "observations"):
        shown.add_column(name, justify="right" if name else "left", no_wrap=True)
    for robot, made in result.robots.items():
        shown.add_row(robot, str(made.pairs), str(made.matched), str(made.observations))
    return shown
