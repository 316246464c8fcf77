"""The figures beside the scene: what a fusion says of itself, ready to be shown."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

from msg_defs import wire
from msg_defs.types import FrameRecord
from multi_robot_slam.report.innovations import Distances
from multi_robot_slam.watch.watched import Watched

RECENT = 20
"""Keyframes of a robot over whose matches innovations are averaged."""
FREEDOM = 3
"""Coordinates of an observation: degrees of freedom of D (18)."""
NONE = "–"
"""In place of what is not known."""
DROPPED, UNHEARD = "dropped: ", "unheard: "


class Row(NamedTuple):
    """What is told of one robot."""

    name: str
    level: int
    """Of `wire.OK`, `WARN`, `ERROR`, `STALE`."""
    state: str
    """Its level in words."""
    advice: str
    """Cause and remedy, where something is wrong."""
    seen: tuple[str, str, str]
    """Observations of its last keyframe: matched, new, and of these rejected by the gate."""
    innovation: str
    """Mean D of its matches in its last `RECENT` keyframes."""


def lawful_mean(watched: Watched) -> float:
    """Mean of D of right matches, by the law."""
    return Distances("", np.empty(0), FREEDOM, watched.config.filter.gate).lawful_mean


def team(watched: Watched) -> list[tuple[str, str]]:
    """What is told of the fusion as a whole: name and value."""
    values = _status(watched, "fusion").values
    step = watched.steps[-1] if watched.steps else None
    particles = watched.config.filter.particles
    landmarks = 0 if watched.landmarks is None else len(watched.landmarks.ids)
    waiting = f"{values.get('messages in the queue', NONE)} messages, "
    waiting += f"{values.get('frames held back', NONE)} frames"
    drops = {k.removeprefix(DROPPED): v for k, v in values.items() if k.startswith(DROPPED)}
    rows = [
        ("time", NONE if step is None else f"{watched.seconds(watched.stamp_ns or 0):.1f} s"),
        ("steps", "0" if step is None else str(step.step)),
        ("landmarks", str(landmarks)),
        (
            "effective particles",
            NONE if step is None else f"{step.effective_particles:.0f} of {particles}",
        ),
        ("a step takes", NONE if step is None else f"{step.duration_ms:.1f} ms"),
        ("lag", f"{values.get('lag [s]', NONE)} s"),
        ("waiting", waiting),
        ("dropped", ", ".join(f"{count} {reason}" for reason, count in drops.items()) or "nothing"),
    ]
    rows += [("unheard", text) for key, text in values.items() if key.startswith(UNHEARD)]
    return rows


def health(watched: Watched) -> tuple[int, str]:
    """Level of the fusion, and what it says."""
    status = _status(watched, "fusion")
    return status.level, status.message or "nothing heard on /diagnostics yet"


def rows(watched: Watched) -> list[Row]:
    """What is told of each robot."""
    return [_row(watched, name) for name in watched.robots]


def _row(watched: Watched, name: str) -> Row:
    robot, status = watched.robots[name], _status(watched, f"fusion: {name}")
    level, state, advice = status.level, status.message or "not heard of", ""
    verdict = robot.verdict
    if verdict is not None:
        level = max(level, wire.LEVELS[verdict.level])
        state = "silent" if status.message == "silent" else verdict.level
        if verdict.level != "consistent":
            advice = "; ".join(filter(None, (verdict.cause, verdict.remedy)))
    camera = _status(watched, f"camera: {name}")
    if camera.level != wire.OK:
        level, advice = max(level, camera.level), "; ".join(filter(None, (advice, camera.message)))
    mean = innovation(watched, name)
    return Row(
        name,
        level,
        state,
        advice,
        (NONE,) * 3 if robot.frame is None else _seen(robot.frame),
        NONE if mean is None else f"{mean:.1f}",
    )


def _seen(frame: FrameRecord) -> tuple[str, str, str]:
    new, rejected = int(frame.is_new.sum()), int(frame.is_rejected.sum())
    return str(len(frame.is_new) - new), str(new), str(rejected)


def innovation(watched: Watched, name: str) -> float | None:
    """Mean D of a robot's matches in its last `RECENT` keyframes; None without matches."""
    own = [f for step in watched.steps for f in step.frames if f.robot == name][-RECENT:]
    mean = _mean(own)
    return mean if np.isfinite(mean) else None


def _mean(frames: Iterable[FrameRecord]) -> float:
    """Mean D of what was matched; NaN where nothing was."""
    parts = [frame.mahalanobis[~frame.is_new] for frame in frames]
    values = np.concatenate([np.empty(0), *parts])
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else np.nan


def _status(watched: Watched, name: str) -> wire.Status:
    return watched.statuses.get(name, wire.Status(name, {}))


class Curves(NamedTuple):
    """Curves over one time axis."""

    seconds: np.ndarray
    """(n,) since the first step [s]."""
    values: tuple[np.ndarray, ...]
    """Of each curve (n,), all finite: a chart with a gap would be empty."""


def particle_curve(watched: Watched) -> Curves:
    """Effective particles after each step."""
    values = np.array([step.effective_particles for step in watched.steps], float)
    return Curves(_times(watched), (_held(values, 0.0),))


def match_curves(watched: Watched) -> Curves:
    """Matches of each robot's newest keyframe."""
    curves = _by_robot(watched, lambda frames: float((~frames[-1].is_new).sum()))
    return Curves(_times(watched), tuple(_held(curve, 0.0) for curve in curves))


def innovation_curves(watched: Watched) -> Curves:
    """Mean D of each robot's matches in its last `RECENT` keyframes, and last what is lawful."""
    curves, law = _by_robot(watched, _mean), lawful_mean(watched)
    lawful = np.full(len(watched.steps), law)
    return Curves(_times(watched), (*(_held(curve, law) for curve in curves), lawful))


def lag_curve(watched: Watched) -> Curves:
    """How far the fusion was behind, once a second."""
    stamps, lags = zip(*watched.lags, strict=True) if watched.lags else ((), ())
    seconds = np.array([watched.seconds(stamp) for stamp in stamps], float)
    return Curves(seconds, (_held(np.array(lags, float), 0.0),))


def _times(watched: Watched) -> np.ndarray:
    return np.array([watched.seconds(step.stamp_ns) for step in watched.steps], float)


def _by_robot(
    watched: Watched, value: Callable[[list[FrameRecord]], float]
) -> Iterator[np.ndarray]:
    """Of each robot what `value` tells of its last keyframes; NaN where a step has none of it."""
    for name in watched.robots:
        recent: deque[FrameRecord] = deque(maxlen=RECENT)
        curve = np.full(len(watched.steps), np.nan)
        for row, step in enumerate(watched.steps):
            own = [frame for frame in step.frames if frame.robot == name]
            recent.extend(own)
            if own:
                curve[row] = value([*recent])
        yield curve


def _held(curve: np.ndarray, before: float) -> np.ndarray:
    """A curve (n,) that keeps its last finite value; `before` the first one."""
    rows = np.where(np.isfinite(curve), np.arange(len(curve)), -1)
    last = np.maximum.accumulate(rows) if len(rows) else rows
    return np.where(last >= 0, curve[last], before)
