"""`convert ...`: recordings of others, in their own formats, become bags."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from multi_robot_slam.cli.options import BagOut, FrameRate, Seed
from multi_robot_slam.cli.terminal import console, countdown, messages

if TYPE_CHECKING:
    from multi_robot_slam.datasets.recording import Recording
    from multi_robot_slam.datasets.stereo_recording import StereoRecording
    from multi_robot_slam.front_end.settings import CameraSettings

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


Team = Annotated[
    int,
    typer.Option(
        min=1, max=32, help="Cut the recording into as many parts: robots that start together."
    ),
]
AsLandmarks = Annotated[
    bool,
    typer.Option(
        "--landmarks/--images",
        help="Landmarks that the front end finds, levelled with the true roll, pitch and height; "
        "or the images as they are, which `run` takes.",
    ),
]
Scale = Annotated[
    float, typer.Option(min=0.1, max=1, help="Size of the images that are searched for landmarks.")
]


@app.command()
def euroc(
    folder: Annotated[
        Path, typer.Argument(help="Folder with mav0 in it, such as V1_01_easy, or of keyframes.")
    ],
    out: BagOut,
    robots: Team = 1,
    rate: FrameRate = 4.0,
    scale: Scale = 1.0,
    seed: Seed = 0,
) -> None:
    """A stereo camera on a drone of the EuRoC recordings.

    It has no wheels and flies. Odometry is the true motion in the plane with the filter's own noise
    model, of this seed; clouds are levelled with the true roll, pitch and height, which stand for
    an IMU. Of the images none is further from the one before than the rate tells.
    """
    from multi_robot_slam.datasets import euroc as source
    from multi_robot_slam.datasets import stereo_bag

    with messages.status(f"Reading {folder}"):
        recording = stereo_bag.spaced(source.read(folder), rate)
    camera = stereo_bag.camera_settings(recording, scale)
    _convert_stereo(recording, out, robots, True, camera, seed)


@app.command()
def kitti(
    folder: Annotated[
        Path, typer.Argument(help="Folder of a sequence, such as sequences/05, with image_0 in it.")
    ],
    out: BagOut,
    robots: Team = 1,
    rate: FrameRate = 10.0,
    landmarks: AsLandmarks = True,
    scale: Scale = 1.0,
    seed: Seed = 0,
) -> None:
    """A stereo camera on a car of the KITTI odometry benchmark.

    Odometry is the true motion in the plane with the filter's own noise model, of this seed. Roads
    are no plane: clouds are levelled with the true roll, pitch and height, which stand for an IMU.
    """
    from multi_robot_slam.datasets import kitti as source
    from multi_robot_slam.datasets import stereo_bag

    with messages.status(f"Reading {folder}"):
        recording = stereo_bag.spaced(source.read(folder), rate)
    camera = stereo_bag.camera_settings(recording, scale, stereo_bag.ON_ROADS_M)
    _convert_stereo(recording, out, robots, landmarks, camera, seed)


def _convert_stereo(
    recording: "StereoRecording",
    out: Path,
    robots: int,
    landmarks: bool,
    camera: "CameraSettings",
    seed: int,
) -> None:
    from multi_robot_slam.datasets import stereo_bag

    team = stereo_bag.parts(recording, robots)
    config = stereo_bag.configuration(team, camera)
    saw = None
    with countdown() as progress:
        task = progress.add_task("Converting", total=len(recording))
        if landmarks:
            seen = stereo_bag.look(team, camera, lambda: progress.advance(task))
            saw = stereo_bag.observed(team, seen)
            stereo_bag.write_clouds(out, team, saw, config, seed)
        else:
            stereo_bag.write_images(out, team, config, seed, lambda: progress.advance(task))
    console.print(stereo_bag.table(team, saw))
    noise = config.filter.motion
    console.print(
        f"Odometry is the true motion with errors of seed {seed}: "
        f"{100 * noise.forward_per_sqrt_m:g} cm and {math.degrees(noise.yaw_per_sqrt_m):.1f} "
        f"degrees after 1 m, {math.degrees(noise.yaw_per_sqrt_rad):.1f} more after 1 rad.",
        soft_wrap=True,
    )
    if landmarks:
        console.print("Clouds are level by the true roll, pitch and height.")
    console.print(f"Now: multi_robot_slam run {out}", markup=False, soft_wrap=True)


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
