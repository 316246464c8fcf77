"""What the verbs that end with a run leave in its folder and print."""

from pathlib import Path

from multi_robot_slam import runs
from multi_robot_slam.cli.terminal import console, messages, warn


def finish(result: runs.Run, folder: Path, with_pictures: bool = True) -> dict:
    """Write and print what there is to say of a run; its figures."""
    from multi_robot_slam.runs import evaluation, evaluation_table

    for warning in result.warnings:
        warn(warning)
    figures = evaluation.evaluate(result)
    runs.write(result, figures, folder)
    if with_pictures:
        from multi_robot_slam.report import plots

        plots.save(result, folder)
    console.print(evaluation_table.table(figures, console.width))
    console.print(f"Everything is in {folder}", markup=False)
    return figures


def draw(result: runs.Run, figures: dict, folder: Path) -> None:
    """Write the page of a run and print where it is."""
    from multi_robot_slam.report import page

    with messages.status(f"Drawing {folder / page.FILE}"):
        path = page.write(result, figures, folder)
    console.print(path, markup=False, highlight=False, soft_wrap=True)
