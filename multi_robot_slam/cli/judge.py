"""`evaluate`, `report`, `compare`, `export`: what there is to learn from runs that are done."""

from pathlib import Path
from typing import Annotated

import typer

from multi_robot_slam.cli.options import Namespace, RunFolder, RunFolders
from multi_robot_slam.cli.terminal import console, messages


def evaluate(folder: RunFolder, namespace: Namespace = None) -> None:
    """Judge a run, live or offline, against the ground truth in its bag.

    Prints tables and writes result.json, figures.csv, trajectories and pictures into DIR. Errors
    are unaligned, aligned robot by robot, and aligned as a team; what has no truth is left out.
    `evo_ape tum truth_NAME.tum trajectory_NAME.tum`, `--align` too, gives the same figures.
    """
    from multi_robot_slam.cli import results
    from multi_robot_slam.pipeline import offline

    with messages.status(f"Reading {folder}"):
        result = offline.load(folder, namespace)
    results.finish(result, folder)


def report(folder: RunFolder, namespace: Namespace = None) -> None:
    """Draw a run, live or offline, as a page to explore: DIR/report.html.

    The building in three dimensions with the robots where they were at any time, errors and their
    bounds, particles, associations, timing, configuration. One file that opens in any browser,
    without network.
    """
    from multi_robot_slam.cli import results
    from multi_robot_slam.pipeline import offline
    from multi_robot_slam.runs import evaluation

    with messages.status(f"Reading {folder}"):
        result = offline.load(folder, namespace)
    results.draw(result, evaluation.evaluate(result), folder)


def compare(
    folders: RunFolders,
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


def _formats(incomplete: str) -> list[str]:
    return [name for name in ("tum", "g2o", "ply") if name.startswith(incomplete)]


def export(
    folder: RunFolder,
    to: Annotated[str, typer.Option("--to", help="tum, g2o or ply.", autocompletion=_formats)],
    out: Annotated[Path, typer.Option(help="File to write; with tum, a folder.")],
    namespace: Namespace = None,
) -> None:
    """Write map and paths of a run for other programs, and say what these cannot hold.

    tum: every path, for evo. g2o: poses, odometry and landmarks in the plane, for optimisers. ply:
    landmarks with their uncertainty, and paths as coloured points, for point cloud viewers.
    """
    from multi_robot_slam import runs
    from multi_robot_slam.runs import exports

    with messages.status(f"Reading {folder}"):
        lines = exports.export(runs.load(folder, namespace), to, out)
    for line in [*lines, f"Everything is in {out}"]:
        console.print(line, markup=False)
