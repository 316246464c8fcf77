"""The panel beside the scene: health in words and numbers, charts, pictures, what is shown."""

from collections.abc import Callable
from html import escape
from typing import Any

import numpy as np
from viser import ClientHandle, GuiEvent, ViserServer
from viser.uplot import Legend, Scale, Series

from msg_defs import wire
from multi_robot_slam.report.size import SCALES
from multi_robot_slam.runs.colours import ROBOT_COLOURS
from multi_robot_slam.watch import figures
from multi_robot_slam.watch.figures import Curves
from multi_robot_slam.watch.scene import LAYERS, Scene, coloured
from multi_robot_slam.watch.watched import Watched

LEVEL_COLOURS = {
    wire.OK: "#2b8a3e",
    wire.WARN: "#b35c00",
    wire.ERROR: "#c92a2a",
    wire.STALE: "#5a636e",
}
NEUTRAL = "#5a636e"
CHART_PX = 150


class Panel:
    """What the page says beside the scene."""

    def __init__(
        self, server: ViserServer, scene: Scene, look: Callable[[ClientHandle], None]
    ) -> None:
        """`look` has a browser look at everything."""
        self._gui, self._scene = server.gui, scene
        self._text = self._gui.add_html("")
        self._pictures: dict[str, Any] = {}
        self._shown: dict[str, object] = {}
        self._charts: list[tuple[Any, Callable[[Watched], Curves]]] = []
        self._parts: list[Any] = []
        self._add_layers()
        self._gui.add_button("look at all", order=5).on_click(
            lambda event: look(event.client) if event.client else None
        )

    def say(self, text: str) -> None:
        """Show one sentence in place of the health of a fusion."""
        self._text.content = f"<div style='padding:0 0.8em'>{escape(text)}</div>"

    def begin(self, watched: Watched) -> None:
        """Make room for another team."""
        for part in self._parts:
            part.remove()
        self._pictures.clear()
        self._shown.clear()
        self._charts.clear()
        self._parts = [
            self._gui.add_folder("Charts", order=2),
            self._gui.add_folder("Pictures", order=3, visible=False),
        ]
        names = [*watched.robots]
        with self._parts[0]:
            self._chart("Effective particles", figures.particle_curve, ["effective particles"])
            self._chart("Matches of a keyframe", figures.match_curves, names)
            self._chart(
                "Innovation: mean D (dashed: its law)", figures.innovation_curves, [*names, "law"]
            )
            self._chart("Lag [s]", figures.lag_curve, ["lag"])

    def draw(self, watched: Watched) -> None:
        """Bring words, numbers and pictures up to date."""
        self._text.content = _health(watched)
        for name, robot in watched.robots.items():
            if robot.picture is not None and robot.picture is not self._shown.get(name):
                self._shown[name] = robot.picture
                self._picture(name, coloured(robot.picture.pixels))

    def draw_charts(self, watched: Watched) -> None:
        """Bring the charts up to date."""
        for chart, curves in self._charts:
            seconds, values = curves(watched)
            chart.data = (seconds, *values)

    def _picture(self, name: str, pixels: np.ndarray) -> None:
        if name in self._pictures:
            self._pictures[name].image = pixels
            return
        self._parts[1].visible = True
        with self._parts[1]:
            self._pictures[name] = self._gui.add_image(pixels, label=name, format="jpeg")

    def _chart(self, title: str, curves: Callable[[Watched], Curves], names: list[str]) -> None:
        nothing = np.empty(0)
        series = [Series(label="time [s]"), *map(_series, range(len(names)), names)]
        chart = self._gui.add_uplot(
            (nothing, *(nothing for _ in names)), tuple(series), title=title,
            scales={"x": Scale(time=False)}, legend=Legend(show=False), height=CHART_PX,
        )  # fmt: skip
        self._charts.append((chart, curves))

    def _add_layers(self) -> None:
        with self._gui.add_folder("Shown", order=4, expand_by_default=False):
            for layer, name in LAYERS.items():
                self._add_layer(layer, name)
            scales = self._gui.add_dropdown(
                "uncertainty", tuple(f"{scale} times" for scale in SCALES), hint="2 sigma, enlarged"
            )

        @scales.on_update
        def _(event: GuiEvent) -> None:
            self._scene.scale = int(event.target.value.partition(" ")[0])

    def _add_layer(self, layer: str, name: str) -> None:
        box = self._gui.add_checkbox(name, initial_value=True)

        @box.on_update
        def _(event: GuiEvent) -> None:
            self._scene.show(layer, event.target.value)


def _series(place: int, name: str) -> Series:
    if name == "law":
        return Series(label=name, stroke=NEUTRAL, width=1.5, dash=(6, 4))
    return Series(
        label=name, stroke=ROBOT_COLOURS[place % len(ROBOT_COLOURS)], width=1.5, spanGaps=True
    )


_COLUMNS = {
    "robot": "",
    "state": "what the monitor says; docs/monitor.md has what to do",
    "matched": "observations of the last keyframe that are known landmarks",
    "new": "observations of the last keyframe that made landmarks",
    "out": "of these, what looked like a known landmark that is elsewhere: outside the gate",
    "D": "mean squared Mahalanobis distance of matches in the last 20 keyframes; "
    "{:.1f} is what it should be",
}
"""Heads of the robots' table, and what they mean."""


def _health(watched: Watched) -> str:
    level, message = figures.health(watched)
    team = "".join(
        f"<tr><td style='opacity:0.65;padding-right:0.8em;vertical-align:top'>{escape(name)}</td>"
        f"<td data-figure='{escape(name)}'>{escape(value)}</td></tr>"
        for name, value in figures.team(watched)
    )
    law = figures.lawful_mean(watched)
    head = "".join(
        f"<th title='{escape(told.format(law))}' style='text-align:left;padding-right:0.7em'>"
        f"{name}</th>"
        for name, told in _COLUMNS.items()
    )
    rows = "".join(
        _robot(row, ROBOT_COLOURS[place % len(ROBOT_COLOURS)])
        for place, row in enumerate(figures.rows(watched))
    )
    return (
        "<div style='padding:0 0.8em;font-size:0.85em;line-height:1.5'>"
        f"<div>{_badge(level)} fusion: {escape(message)}</div>"
        f"<table style='border-spacing:0'>{team}</table>"
        f"<table style='border-spacing:0;margin-top:0.6em'><tr>{head}</tr>{rows}</table>"
        "</div>"
    )


def _robot(row: figures.Row, colour: str) -> str:
    name = f"<span style='color:{colour}'>⬤</span> {escape(row.name)}"
    cells = name, f"{_badge(row.level)} {escape(row.state)}", *row.seen, row.innovation
    style = "padding-right:0.7em;white-space:nowrap"
    text = "".join(f"<td style='{style}'>{cell}</td>" for cell in cells)
    text = f"<tr data-robot='{escape(row.name)}'>{text}</tr>"
    if row.advice:
        said = LEVEL_COLOURS[max(row.level, wire.WARN)]
        text += f"<tr><td colspan='6' style='color:{said}'>{escape(row.advice)}</td></tr>"
    return text


def _badge(level: int) -> str:
    mark = "●" if level == wire.OK else "▲"
    return f"<span style='color:{LEVEL_COLOURS[level]}'>{mark}</span>"
