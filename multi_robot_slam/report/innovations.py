"""How far matches lay from where they were expected, against the law they should follow.

The squared Mahalanobis distance D of a right match is chi2 with as many degrees of freedom as the
point has coordinates, cut off at the gate, beyond which nothing is matched.
"""

from typing import NamedTuple

import numpy as np
import plotly.graph_objects as go
from scipy.special import gammainc

from multi_robot_slam.report.scene import NEUTRAL, colours
from multi_robot_slam.runs import Run

BINS = 40
"""Of a histogram."""


class Distances(NamedTuple):
    """D of one robot's matches of one kind."""

    title: str
    values: np.ndarray
    """(n,) float64, n > 0."""
    freedom: int
    gate: float

    @property
    def mean(self) -> float:
        return float(self.values.mean())

    @property
    def lawful_mean(self) -> float:
        """E[chi2_k | chi2_k < D_0] = k F_{k+2}(D_0) / F_k(D_0)."""
        below, half = self.freedom, self.gate / 2
        return float(below * gammainc(below / 2 + 1, half) / gammainc(below / 2, half))

    def told(self) -> str:
        """In one sentence what the histogram shows."""
        factor = np.sqrt(self.mean / self.lawful_mean)
        how = "as they should be" if 0.8 <= factor <= 1.25 else "larger than they should be"
        if factor < 0.8:
            how = "smaller than they should be"
        return (
            f"{self.title}: {len(self.values)}, D {self.mean:.2f} on average, by the law "
            f"{self.lawful_mean:.2f}: errors are {how}."
        )


def distances(run: Run) -> dict[str, list[Distances]]:
    """Of each robot that matched anything: of landmarks, and of robots that it saw."""
    settings = run.config.filter
    found: dict[str, list[Distances]] = {}
    for name in run.robots:
        frames = [frame for step in run.steps for frame in step.frames if frame.robot == name]
        landmarks = [frame.mahalanobis[~frame.is_new] for frame in frames]
        others = [frame.other_mahalanobis[~frame.is_other_rejected] for frame in frames]
        kinds = [
            Distances("observations of known landmarks", _known(landmarks), 3, settings.gate),
            Distances("sightings of robots", _known(others), 2, settings.sighting_gate),
        ]
        if own := [kind for kind in kinds if len(kind.values)]:
            found[name] = own
    return found


def figure(run: Run, name: str, kinds: list[Distances]) -> go.Figure:
    """Histograms of D of one robot's matches, and the density of the law as lines."""
    drawn = go.Figure()
    for kind, shade, dash in zip(
        kinds, (colours(run)[name], NEUTRAL), ("solid", "dot"), strict=False
    ):
        edges = np.linspace(0, kind.gate, BINS + 1)
        counts, _ = np.histogram(kind.values, edges)
        share = counts / (len(kind.values) * np.diff(edges))
        middles = (edges[1:] + edges[:-1]) / 2
        look = {"marker": {"color": shade, "line": {"width": 0}}, "opacity": 0.55}
        drawn.add_trace(go.Bar(x=middles, y=share, name=kind.title, width=np.diff(edges), **look))
        line = {"color": NEUTRAL, "width": 1.6, "dash": dash}
        law = f"χ² with {kind.freedom} degrees of freedom"
        drawn.add_trace(
            go.Scatter(x=middles, y=_law(edges, kind), mode="lines", name=law, line=line)
        )
    drawn.update_layout(bargap=0, barmode="overlay", meta={"is_over_time": False})
    drawn.update_yaxes(title_text="density", rangemode="tozero")
    return drawn.update_xaxes(title_text="D")


def _known(parts: list[np.ndarray]) -> np.ndarray:
    """(n,) float64: those that are numbers."""
    values = np.concatenate([np.empty(0), *parts]).astype(float)
    return values[np.isfinite(values)]


def _law(edges: np.ndarray, kind: Distances) -> np.ndarray:
    """Mean density between each two edges of chi2 cut off at the gate."""
    shares = gammainc(kind.freedom / 2, edges / 2)
    return np.diff(shares) / np.diff(edges) / shares[-1]
