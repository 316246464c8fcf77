"""How long after a robot's report its pose is out, from the arrivals that a stopwatch noted.

A stopwatch is a process of its own that hears what the robots send and what the fusion publishes,
by one monotonic clock. A latency is the time between two arrivals there: it holds the way of the
report to the fusion, the wait for the other robots' reports of that instant, the filter, the
encoding of the pose and its way to the stopwatch, less the way of the report to the stopwatch.
"""

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msg_defs import topics
from msg_defs.errors import InputError

TARGETS_MS = {"median": 5.0, "99 %": 30.0, "longest": 60.0}

Arrivals = Mapping[str, Mapping[int, int]]
"""Topic -> stamp of a message [ns] -> when the last with this stamp arrived [ns]."""


@dataclass(frozen=True)
class Latencies:
    """Of a team, in the order of the stamps [ms]."""

    steps: np.ndarray
    """From a cloud to the pose of the step that it became."""
    predictions: np.ndarray
    """From the odometry of a frame that was passed over to the pose that was predicted."""
    unanswered: int
    """Clouds without a pose of their stamp."""


def read(path: Path) -> Arrivals:
    """What a stopwatch wrote."""
    found: dict[str, dict[int, int]] = {}
    try:
        with path.open() as file:
            for row in csv.DictReader(file):
                found.setdefault(row["topic"], {})[int(row["stamp_ns"])] = int(row["arrived_ns"])
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise InputError(f"cannot read {path}: {error}") from None
    return found


def latencies(arrivals: Arrivals, robots: Iterable[str]) -> Latencies:
    """The latencies of all robots; `InputError` where there are no clouds.

    A frame that became a step has a mean pose, published right after the pose; before it a
    prediction with the same stamp may have gone out, which is not what is waited for.
    """
    steps, predictions, unanswered = [], [], 0
    for robot in robots:
        sent, clouds, poses, means = (
            arrivals.get(kind(robot).name, {})
            for kind in (topics.odometry, topics.observations, topics.pose, topics.mean_pose)
        )
        for stamp, arrived in clouds.items():
            if stamp not in poses:
                unanswered += 1
            elif stamp in means:
                steps.append((stamp, poses[stamp] - arrived))
            else:
                predictions.append((stamp, poses[stamp] - sent[stamp]))
    if not steps:
        raise InputError("no pose of a step has arrived; look at what the fusion said")
    return Latencies(_ms(steps), _ms(predictions), unanswered)


def _ms(found: list[tuple[int, int]]) -> np.ndarray:
    return 1e-6 * np.array([latency for _, latency in sorted(found)], float)


def figures(latencies_ms: np.ndarray) -> dict[str, float]:
    """Median, 99 % quantile and longest [ms]."""
    values = np.quantile(latencies_ms, [0.5, 0.99, 1.0])
    return dict(zip(TARGETS_MS, map(float, values), strict=True))


def markdown(found: Latencies) -> str:
    """A table: steps, predictions, and both together, each figure with its target."""
    rows = {
        "cloud to the pose of its step": found.steps,
        "odometry to the predicted pose": found.predictions,
        "both": np.concatenate([found.steps, found.predictions]),
    }
    heads = [f"{name} [ms]" for name in TARGETS_MS]
    lines = [f"| latency | poses | {' | '.join(heads)} |", "|---|---:|---:|---:|---:|"]
    for name, values in rows.items():
        if len(values):
            cells = " | ".join(_cell(which, ms) for which, ms in figures(values).items())
            lines.append(f"| {name} | {len(values)} | {cells} |")
    lines.append(f"\nClouds without a pose of their stamp: {found.unanswered}.")
    return "\n".join(lines) + "\n"


def _cell(name: str, ms: float) -> str:
    target = TARGETS_MS[name]
    return f"{ms:.1f} (<= {target:g}{'' if ms <= target else ', **no**'})"
