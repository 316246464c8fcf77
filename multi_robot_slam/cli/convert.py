"""`convert ...`: recordings of others, in their own formats, become bags."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from multi_robot_slam.cli.options import BagOut, FrameRate
from multi_robot_slam.cli.terminal import console, messages

if TYPE_CHECKING:
    from multi_robot_slam.datasets.recording import Recording

app = typer.Typer(
    help="Recordings of real robots, downloaded in their own formats -> bags for `run`.",
    no_args_is_help=True,
)


@app.command()
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


@app.command()
def utias(
    file: Annotated[Path, typer.Argument(metavar="FILE.mat", help="dataset2.mat of pysteam.")],
    out: BagOut,
    rate: FrameRate = 1.0,
) -> None:
    """One planar robot with range and bearing, from the pysteam tutorials."""
    from multi_robot_slam.datasets import utias

    _convert(utias.read, file, out, rate)


def _convert(read: "Callable[[Path], Recording]", source: Path, out: Path, rate: float) -> None:
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
