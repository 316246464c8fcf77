"""The report of a run: one HTML file that needs neither network nor anything beside it."""

import json
from pathlib import Path

import plotly.graph_objects as go
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from plotly.offline import get_plotlyjs

from msg_defs import scenario_file
from msg_defs.errors import InputError
from multi_robot_slam.config import SECTION
from multi_robot_slam.report import charts, innovations, levels, scene, sights, size, slider
from multi_robot_slam.report.timeline import Timeline, timeline
from multi_robot_slam.runs import Run, evaluation_table, places
from multi_robot_slam.runs.evaluation import Figures

FILE = "report.html"

COLUMNS = {
    "online_path_rmse_m": ("path [m]", "live"),
    "path_rmse_m": ("path [m]", "after the run"),
    "refined_path_rmse_m": ("path [m]", "refined"),
    "batch_path_rmse_m": ("path [m]", "yardstick"),
    "odometry_path_rmse_m": ("path [m]", "odometry"),
    "online_heading_rmse_rad": ("heading [rad]", "live"),
    "heading_rmse_rad": ("heading [rad]", "after the run"),
    "odometry_heading_rmse_rad": ("heading [rad]", "odometry"),
    "map_rmse_m": ("map [m]", "at the end"),
    "refined_map_rmse_m": ("map [m]", "refined"),
}
"""Figures in the table of errors, where the run has them: the quantity, and what claims it."""

FIGURES = {
    "landmarks": ("landmarks in map", "{:d}"),
    "landmarks_seen": ("true landmarks seen", "{:d}"),
    "duplicates": ("duplicates in map", "{:d}"),
    "association_precision": ("matches that are right", "{:.1%}"),
    "association_recall": ("known landmarks matched", "{:.1%}"),
    "pose_nees": ("NEES of poses, ideally 3", "{:.1f}"),
    "landmark_nees": ("NEES of landmarks, ideally 3", "{:.1f}"),
    "step_ms_mean": ("mean step [ms]", "{:.1f}"),
    "step_ms_p99": ("99 % of steps within [ms]", "{:.1f}"),
}
"""Figures of the whole team beside the table of errors: what they are called, how written."""


def write(run: Run, figures: Figures, folder: Path) -> Path:
    """Write `report.html` of a run and its figures (`evaluation.evaluate`); return its path.

    The same run gives the same bytes. Long runs are thinned (`timeline.MOST_SAMPLES`,
    `slider.MOST_LANDMARKS`), as the page itself says.
    """
    path = Path(folder) / FILE
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page(run, figures, path.parent.resolve().name), encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}; make it writable") from None
    return path


def page(run: Run, figures: Figures, title: str) -> str:
    """The whole page as HTML."""
    times = timeline(run)
    drawn = charts.charts(run, times)
    matched = innovations.distances(run)
    laws = {f"law {name}": innovations.figure(run, name, own) for name, own in matched.items()}
    pictures = {"scene": scene.figure(run, times), **drawn, **laws}
    seen = sights.sights(run, times)
    data = {
        "frames": slider.frames(run, times),
        "sights": seen,
        "figures": {name: json.loads(figure.to_json()) for name, figure in pictures.items()},
    }
    here = Path(__file__).with_name("template")
    environment = Environment(
        loader=FileSystemLoader(here),
        autoescape=True,
        undefined=StrictUndefined,
    )
    return environment.get_template("report.html").render(
        title=title,
        run=run,
        figures=figures,
        headline=_headline(run, times),
        made_by=_made_by(run),
        columns={key: head for key, head in COLUMNS.items() if figures[key] is not None},
        facts=_facts(figures),
        sections=_sections(figures),
        number=evaluation_table.number,
        charts=drawn,
        worst=levels.worst(run),
        placed=places.placed(run.steps),
        seconds=times.seconds,
        matched=matched,
        seen=seen,
        colours=scene.colours(run),
        layers=_layers(pictures["scene"]),
        scales=size.SCALES,
        first_scale=size.first_scale(run),
        hidden=scene.HIDDEN_AT_FIRST,
        inside={name: charts.inside(run, name) for name in run.robots},
        thinning=_thinning(run, times),
        config=scenario_file.to_yaml(**{SECTION: run.config}),
        plotly=get_plotlyjs(),
        data=data,
    )


def _headline(run: Run, times: Timeline) -> str:
    stamps = [step.stamp_ns for step in run.steps]
    count, team = len(stamps), len(run.robots)
    duration_s = (stamps[-1] - stamps[0]) / 1e9 if stamps else 0.0
    minutes = f" ({duration_s / 60:.0f} min)" if duration_s >= 120 else ""
    return (
        f"{team} {'robot' if team == 1 else 'robots'}, {duration_s:.0f} s{minutes}, {count} steps, "
        f"{run.config.filter.particles} particles"
    )


def _made_by(run: Run) -> str:
    """Version, scenario, seed and machine, as far as they are known."""
    told, made = [f"seed {run.config.seed}"], run.provenance
    if made is not None:
        machine = made.machine
        told.insert(0, f"multi_robot_slam {made.version}")
        if made.scenario is not None:
            told.insert(1, f"scenario {made.scenario}")
        told.append(f"{machine.get('processor')}, {machine.get('cores')} cores")
        told.append(f"{machine.get('platform')}")
        kinds = ("python", "numpy", "numba")
        told.append(", ".join(f"{kind} {machine.get(kind)}" for kind in kinds))
    return "; ".join(told)


def _facts(figures: Figures) -> dict[str, str]:
    return {
        label: form.format(figures[key])
        for key, (label, form) in FIGURES.items()
        if figures[key] is not None
    }


def _sections(figures: Figures) -> dict[str, dict[str, str]]:
    """The sections of `evaluation_table` with those figures the run has."""
    return {
        section: known
        for section, titles in evaluation_table.SECTIONS.items()
        if (known := {k: title for k, title in titles.items() if figures.get(k) is not None})
    }


def _layers(figure: go.Figure) -> dict[str, str]:
    """The layers the scene has, and what they are called."""
    present = {trace.meta["layer"] for trace in figure.data}
    return {layer: label for layer, label in scene.LAYERS.items() if layer in present}


def _thinning(run: Run, times: Timeline) -> list[str]:
    """What a long run does not show, in sentences."""
    told = []
    if times.every > 1:
        told.append(
            f"Every point in time stands for {times.every} steps: their mean numbers of "
            "observations, least effective particles, longest step, and their last pose."
        )
    longest = max(len(r.odometry.stamps_ns) for r in run.robots.values())
    if longest > times.most + 1:
        told.append(f"Curves and paths show every n-th sample, {times.most} at most.")
    left_out = len(run.landmarks.ids) - slider.MOST_LANDMARKS
    if left_out > 0:
        told.append(f"{left_out} landmarks with the fewest observations are not drawn.")
    return told
