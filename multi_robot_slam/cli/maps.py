"""`map ...`: what is in a map that was saved, two as one; and what `run` does with maps."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from msg_defs.errors import InputError
from multi_robot_slam.cli.terminal import console, messages, warn

if TYPE_CHECKING:
    from multi_robot_slam.config import Config
    from multi_robot_slam.pipeline.map_files import MapFile
    from multi_robot_slam.pipeline.map_merging import MergedFile
    from multi_robot_slam.pipeline.pipeline import Pipeline
    from multi_robot_slam.runs import Run

FILE = "map.npz"
"""Name of the map in the folder of a run."""

app = typer.Typer(
    help="Maps that were saved: `run` and `demo` leave one in map.npz, `--map` begins with it.",
    no_args_is_help=True,
)
MapArgument = Annotated[
    Path,
    typer.Argument(metavar="FILE", help="Map or state of a fusion (.npz), or the folder of a run."),
]


@app.command()
def info(file: MapArgument) -> None:
    """Say what is in a map: whose it is, how large, how well it is known.

    docs/maps.md has the format; NumPy alone reads it.
    """
    from multi_robot_slam.pipeline import map_files

    for line in _told(map_files.read(found(file))):
        console.print(line, markup=False, highlight=False, soft_wrap=True)


@app.command()
def export(
    file: MapArgument,
    out: Annotated[Path, typer.Option(help="Folder to write; it must not exist yet.")],
) -> None:
    """Write the published landmarks of a map for other programs.

    map.csv: a row a landmark, with place, covariance, how often and by whom it was seen. map.ply:
    points with their uncertainty, for point cloud viewers. config.yaml: the configuration that the
    map was made with.
    """
    from multi_robot_slam.cli import folders
    from multi_robot_slam.pipeline import map_files
    from multi_robot_slam.runs import exports
    from multi_robot_slam.runs.text_files import write_map

    held = map_files.read(found(file))
    landmarks = map_files.for_team(held, held.about["robots"]).landmark_map()
    with folders.new_folder(out) as folder:
        write_map(landmarks, folder / "map.csv")
        exports.write_points(exports.landmark_points(landmarks), folder / "map.ply")
        (folder / "config.yaml").write_text(held.about["config"])
        console.print(f"Everything is in {folder}", markup=False)


@app.command()
def merge(
    one: MapArgument,
    other: MapArgument,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Map to write; it must not exist yet.")],
) -> None:
    """Merge the maps of two teams that knew nothing of each other into one, in the first's frame.

    Where the second lies in the first is told by landmarks that look alike, and refused, with the
    numbers, where they do not tell. What both have seen becomes one, and better known; robots of
    the same name are the same. `run --map` goes on in the result.
    """
    from multi_robot_slam.pipeline import map_files, map_merging

    if out.exists():
        raise InputError(f"{out} exists; remove it or choose another with --out")
    with messages.status("merging"):
        made = map_merging.merge(*(map_files.read(found(path)) for path in (one, other)))
    map_files.write(out, made.about, made.kept)
    for line in _merged(made):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    console.print(f"The map is in {out}", markup=False)


def found(named: Path) -> Path:
    """The map that is meant by its file, with or without `.npz`, or by the folder of a run."""
    places = (named, named / FILE, named.with_name(f"{named.name}.npz"))
    path = next((place for place in places if place.is_file()), None)
    if path is None and named.is_dir():
        raise InputError(f"{named} holds no {FILE}; name the folder that `run` or `demo` left")
    return path or named


def begin(config: "Config", file: Path | None, refine: bool) -> "Pipeline":
    """The pipeline of a run that begins with the map in `file`, if one is named."""
    from multi_robot_slam.pipeline import map_files
    from multi_robot_slam.pipeline.pipeline import Pipeline

    if file is None:
        return Pipeline(config, warn, keeps_frames=refine)
    if refine:
        raise InputError("--refine smooths a run by itself, without the --map; leave out one")
    kept = map_files.for_team(map_files.read(found(file)), config.robots)
    return Pipeline(config, warn, keeps_frames=False, kept=kept)


def leave(pipeline: "Pipeline", result: "Run", folder: Path) -> None:
    """Write the map of a run that has ended into its folder; warn where there is none."""
    from multi_robot_slam.pipeline import map_files

    stamp_ns = result.steps[-1].stamp_ns if result.steps else 0
    about = map_files.about(pipeline.config, stamp_ns)
    try:
        map_files.write(folder / FILE, about, map_files.closed(pipeline))
    except InputError as error:
        warn(f"{FILE}: {error}")


def _merged(made: "MergedFile") -> list[str]:
    published = int(made.kept.published.sum())
    total = f"landmarks: {published} published, {len(made.kept.ids)} in all"
    robots = f"robots: {', '.join(made.about['robots'])}"
    if made.merged is None or made.vote is None:
        return ["both are the same map", robots, total]
    x, y, yaw = made.merged.pose.tolist()
    return [
        f"the second map lies at [{x:.2f}, {y:.2f}, {yaw:.3f}] in the first, by "
        f"{len(made.vote.pairs)} landmarks of {made.vote.things} places that agree, "
        f"{made.vote.runner_up} do by another pose",
        f"{made.merged.joined} landmarks are in both, and one from now on",
        robots,
        total,
    ]


def _told(file: "MapFile") -> list[str]:
    import numpy as np

    from multi_robot_slam.pipeline import map_files

    about = file.about
    what = "a map" if file.state is None else "the state of a fusion, from which it goes on"
    kept = map_files.for_team(file, about["robots"])
    landmarks = kept.landmark_map()
    lines = [
        f"{what}, version {about['version']} of the format, written by {about['program']}",
        f"robots: {', '.join(about['robots'])}",
        f"newest frame: {about['stamp_ns'] / 1e9:.3f} s",
        f"landmarks: {len(landmarks.ids)} published, {len(kept.ids)} in all",
    ]
    for bit, name in enumerate(about["robots"]):
        lines.append(f"seen by {name}: {np.count_nonzero(landmarks.robots & (1 << bit))}")
    if len(landmarks.ids):
        low, high = landmarks.positions.min(axis=0), landmarks.positions.max(axis=0)
        sigmas = np.sqrt(landmarks.covariances[:, [0, 3]].sum(axis=1) / 2)
        lines += [
            *(
                f"{axis}: {least:.2f} to {most:.2f} m"
                for axis, least, most in zip("xyz", low, high, strict=True)
            ),
            f"standard deviation in the plane: median {np.median(sigmas):.3f} m, worst "
            f"{sigmas.max():.3f} m",
        ]
    return lines
