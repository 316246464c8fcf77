"""What an experiment leaves beside its table: a picture of each figure, and the statements."""

from pathlib import Path

from multi_robot_slam.report import plots
from multi_robot_slam.studies import exploration, figures, statements
from multi_robot_slam.studies.experiment_grid import SINGLE_RUNS
from multi_robot_slam.studies.experiment_table import Rows, Trial
from multi_robot_slam.studies.exploration import Base


def write(rows: Rows, base: Base, folder: Path) -> list[Path]:
    """Write `fig*.png` for every figure in the table, and `statements.md`; return their paths."""
    paths = figures.save(rows, folder)
    singles = {name: trial for name, trial in sorted(rows, reverse=True) if name in SINGLE_RUNS}
    for name, trial in singles.items():
        paths += _draw_run(name, base, trial, folder)
    found = statements.findings(rows)
    if found:
        paths.append(folder / "statements.md")
        paths[-1].write_text(statements.markdown(found))
    return sorted(paths)


def _draw_run(name: str, base: Base, trial: Trial, folder: Path) -> list[Path]:
    """Draw figure 3 or 4 from its run, which is done again."""
    explored = exploration.explore(base, trial)
    run, pipeline = exploration.estimate(explored, exploration.filter_of(base, trial))
    if name == "fig4":
        sheets = {"fig4": plots.error_figure(run)}
    else:
        halfway = explored.instants[len(explored.instants) // 2]
        mount = explored.scenario.camera.mount
        views = [
            figures.view(r.truth.pose, r.observations, mount) for r in halfway if r.observations
        ]
        particles = {robot: pipeline.particles(robot) for robot in run.robots}
        sheets = {
            "fig3a": figures.world_figure(run, views),
            "fig3b": figures.map_figure(run, particles),
        }
    for title, sheet in sheets.items():
        sheet.savefig(folder / f"{title}.png", dpi=plots.DPI, bbox_inches="tight")
    return [folder / f"{title}.png" for title in sheets]
