"""The table of the hard worlds, `hard.csv`, its summary, and what it is held to."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np

from multi_robot_slam.studies import table
from multi_robot_slam.studies.hard_worlds import EXACT, EXACT_CERTAIN, EXACT_TWICE, EXACTS, WORLDS
from multi_robot_slam.studies.hours_table import RATIO, bounds

SOON_S = 10.0
"""What differs is good or said so long after it could be noticed."""
FEW_FRAMES = 5
FACTOR = 0.2
WRONG_RATIO, WRONG_NEES = 2.0, 3.0
"""A run is wrong whose error is over so many times that of the exact world, or whose NEES is beyond
so many times the upper bound for one run."""


@dataclass(frozen=True)
class Row:
    """Figures of one run; errors are RMS of position, beside those of the exact world's run."""

    world: str
    robots: int
    seed: int
    published_m: float | None
    exact_published_m: float | None
    aligned_m: float | None
    """After the team was aligned as one."""
    exact_aligned_m: float | None
    later_m: float | None
    """From 10 s after the difference can be noticed."""
    exact_later_m: float | None
    later_aligned_m: float | None
    exact_later_aligned_m: float | None
    others_m: float | None
    """Of the robots that the difference is not about, since it began."""
    exact_others_m: float | None
    nees: float | None
    """Of what is judged in this world."""
    map_m: float | None
    exact_map_m: float | None
    """Where a map was loaded, of that; and both of the landmarks that are in both."""
    landmark_nees: float | None
    duplicates: int
    exact_duplicates: int
    old_places: int | None
    """Landmarks that have moved and are still where they were."""
    optimum_m: float | None
    """Of the filtering optimum, at its instants."""
    exact_optimum_m: float | None
    odometry_factor: float
    """Estimated at the end, mean of the robots."""
    camera_factor: float
    factor_off: float
    """By what share the factor that differs is missed."""
    known_s: float
    """When the difference could be noticed; from the start of the run."""
    noticed_s: float | None
    """How long after that something was said; 0 if before, None if never.

    Where starts are unknown, when the last robot's place was, and rightly so.
    """
    noticed_frames: int | None
    """Frames that saw known landmarks until then."""
    away_s: float | None
    """Longest time from when a robot was lost to its next published pose, or to the end of the run;
    None where none was lost."""
    found_m: float | None
    """From 10 s after the first was lost, of all that is published."""
    exact_found_m: float | None
    found_aligned_m: float | None
    exact_found_aligned_m: float | None
    false_alarm: int
    said: str | None
    lost: int
    """Messages that the fusion says never arrived."""
    refused: int
    """Messages that it dropped."""

    @property
    def ratio(self) -> float | None:
        """Of what is judged, over the same of the exact world."""
        return _ratio(*judged(self))

    @property
    def is_noticed(self) -> bool:
        """Said soon."""
        return self.noticed_s is not None and self.noticed_s <= SOON_S

    @property
    def was_far_off(self) -> bool:
        """A robot that was lost has been far off, whatever was said and made good later."""
        ratio = _ratio(self.later_m, self.exact_later_m)
        if WORLDS[self.world].judged == "found, aligned":
            ratio = _ratio(self.later_aligned_m, self.exact_later_aligned_m)
        return self.away_s is not None and (ratio or 0.0) > WRONG_RATIO

    @property
    def is_wrong(self) -> bool:
        """So wrong that it has to be said; so is a run without poses to judge.

        What no filter could have done better is not wrong.
        """
        if self.ratio is None:
            return True
        best = _ratio(self.optimum_m, self.exact_optimum_m) or 1.0
        is_far_off = self.ratio > WRONG_RATIO * max(best, 1.0) or self.was_far_off
        return is_far_off or (self.nees or 0.0) > WRONG_NEES * bounds(1)[1]

    @property
    def is_silently_wrong(self) -> bool:
        """Wrong, and nobody says so soon: nothing is told, and the covariances do not cover it."""
        is_covered = self.nees is not None and self.nees <= bounds(1)[1] and not self.was_far_off
        return self.is_wrong and not (self.is_noticed or is_covered)


COLUMNS = tuple(field.name for field in fields(Row))
TYPES = table.types_of(Row)
Pair = tuple[float | None, float | None]
"""A figure of a run, and of the exact world's."""
Key = tuple[str, int, int]
"""World, robots, seed: the first columns."""


@dataclass(frozen=True)
class Target:
    """What the runs of a world are to reach, all together."""

    ratio: float | None = None
    or_noticed: bool = False
    """A greater ratio will do where every run with one is noticed."""
    noticed: bool = False
    few_frames: bool = False
    others: float | None = None
    nees: bool = False
    map_ratio: float | None = None
    landmark_nees: bool = False
    factor: bool = False
    gone: bool = False
    """No old places are left."""
    away_s: float | None = None
    """Whoever is lost is found again so soon."""
    optimum: bool = False
    """The error grows as the optimum's does."""
    silent: bool = False
    """Nothing is said: there is nothing to say."""


TARGETS = {
    EXACT: Target(silent=True),
    EXACT_TWICE: Target(silent=True),
    EXACT_CERTAIN: Target(silent=True),
    "start-near": Target(ratio=1.1, nees=True),
    "start-far-told": Target(ratio=1.3, nees=True),
    "first-near": Target(ratio=1.1, nees=True),
    "first-far-told": Target(ratio=1.3, nees=True),
    "start-far": Target(ratio=1.3, away_s=SOON_S),
    "swapped": Target(ratio=1.3, noticed=True, away_s=SOON_S),
    "unknown-one": Target(ratio=1.3, noticed=True, nees=True),
    "unknown-one-copies": Target(ratio=1.3),
    "unknown-all-but-one": Target(ratio=1.3, noticed=True, nees=True),
    "next-day": Target(ratio=1.1, map_ratio=1.0),
    "next-day-tenth-gone": Target(ratio=1.1, map_ratio=1.0),
    "next-day-mapping": Target(ratio=1.1, map_ratio=1.0),
    "odometry-3": Target(ratio=1.2, factor=True),
    "odometry-3-told": Target(),
    "odometry-third": Target(ratio=1.2, factor=True),
    "camera-3": Target(ratio=1.2, factor=True),
    "camera-3-told": Target(),
    "camera-third": Target(ratio=1.2, factor=True),
    "odometry-biased": Target(ratio=1.3, or_noticed=True),
    "silent": Target(ratio=1.3, nees=True),
    "lost-messages": Target(ratio=1.3, nees=True),
    "no-odometry": Target(ratio=1.3, nees=True),
    "random-descriptors": Target(ratio=1.2, map_ratio=1.2, landmark_nees=True),
    "random-positions": Target(ratio=1.2, map_ratio=1.2, landmark_nees=True),
    "mixture": Target(ratio=1.2, map_ratio=1.2, landmark_nees=True),
    "descriptor-noise": Target(optimum=True),
    "short-sight": Target(optimum=True),
    "few-observations": Target(optimum=True),
    "robot-late": Target(ratio=1.3, or_noticed=True),
    "fusion-restarted": Target(ratio=1.3, or_noticed=True),
    "fusion-killed": Target(ratio=1.1),
    "robot-restarted": Target(ratio=1.3, or_noticed=True),
    "slip": Target(ratio=1.5, few_frames=True, others=1.1, map_ratio=1.1, away_s=SOON_S),
    "carried": Target(ratio=1.5, few_frames=True, others=1.1, map_ratio=1.1, away_s=SOON_S),
    "landmarks-moved": Target(ratio=1.2, gone=True),
    "fusion-late": Target(ratio=1.3, or_noticed=True),
}


def key_of(row: Row) -> Key:
    """What sets the row apart."""
    return row.world, row.robots, row.seed


def order_of(key: Key) -> tuple[int, int, int]:
    """The order of the table: that of the worlds."""
    return list(WORLDS).index(key[0]), key[1], key[2]


def opened(path: Path) -> table.Table[Key, Row]:
    """The table at `path`."""
    form = table.Format(
        ",".join(COLUMNS), lambda _, row: table.line(astuple(row)), _from_line, order_of
    )
    return table.Table(path, form)


def _from_line(text: str) -> tuple[Key, Row]:
    row = Row(*table.cells(text, COLUMNS, TYPES))
    return key_of(row), row


def judged(row: Row) -> Pair:
    """What is judged of a run, and of the exact world's [m]."""
    return {
        "published": (row.published_m, row.exact_published_m),
        "later": (row.later_m, row.exact_later_m),
        "tied": (row.published_m, row.exact_published_m),
        "later, aligned": (row.later_aligned_m, row.exact_later_aligned_m),
        "found": (row.found_m, row.exact_found_m),
        "found, aligned": (row.found_aligned_m, row.exact_found_aligned_m),
    }[WORLDS[row.world].judged]


def unmet(rows: Sequence[Row]) -> list[str]:
    """What the runs of one world and team miss of its target, in words; nothing if they reach it.

    A law of all worlds is among it: no run is wrong and silent.
    """
    target = TARGETS[rows[0].world]
    low, high = bounds(len(rows))

    def is_above(limit: float | None, pair: Callable[[Row], Pair]) -> bool:
        found = ratio_of_means([pair(row) for row in rows])
        return limit is not None and not _is_at_most(limit, found)

    def is_outside(values: list[float | None]) -> bool:
        known = [value for value in values if value is not None]
        return len(known) < len(values) or not low <= np.mean(known) <= high

    missed = {
        "error": is_above(target.ratio, judged)
        and not (target.or_noticed and all(_is_good(row, target) for row in rows)),
        "others": is_above(target.others, lambda row: (row.others_m, row.exact_others_m)),
        "map": is_above(target.map_ratio, lambda row: (row.map_m, row.exact_map_m)),
        "NEES": target.nees and is_outside([row.nees for row in rows]),
        "landmark NEES": target.landmark_nees and is_outside([row.landmark_nees for row in rows]),
        "not noticed": target.noticed and not all(row.is_noticed for row in rows),
        "found late": target.away_s is not None
        and any((row.away_s or 0.0) > target.away_s for row in rows),
        "frames": target.few_frames
        and any(r.noticed_frames is None or r.noticed_frames > FEW_FRAMES for r in rows),
        "factor": target.factor and not _is_at_most(FACTOR, _mean(row.factor_off for row in rows)),
        "old places": target.gone and any(row.old_places for row in rows),
        "optimum": target.optimum and not _grows_as_optimum(rows),
        "false alarm": any(row.false_alarm for row in rows)
        or (target.silent and any(row.said for row in rows)),
        "wrong and silent": any(row.is_silently_wrong for row in rows),
    }
    return [what for what, is_missed in missed.items() if is_missed]


def _is_at_most(limit: float, value: float | None) -> bool:
    return value is not None and value <= limit


def _is_good(row: Row, target: Target) -> bool:
    return row.is_noticed or _is_at_most(target.ratio or 0.0, row.ratio)


def growth(rows: Sequence[Row]) -> float | None:
    """Of the optimum's error, over that in the exact world."""
    return ratio_of_means([(row.optimum_m, row.exact_optimum_m) for row in rows])


def _grows_as_optimum(rows: Sequence[Row]) -> bool:
    found, allowed = ratio_of_means([judged(row) for row in rows]), growth(rows)
    return allowed is not None and _is_at_most(RATIO * allowed, found)


def ratio_of_means(pairs: Sequence[Pair]) -> float | None:
    """The mean of the first over that of the second; None where one is missing."""
    known = [(one, other) for one, other in pairs if one is not None and other is not None]
    if len(known) < len(pairs) or not known:
        return None
    return _ratio(*np.mean(known, axis=0).tolist())


def markdown(rows: Sequence[Row]) -> str:
    """The table of `docs/results.md`, and every run that is wrong and silent."""
    head = (
        *("world", "K", "seeds", "error / exact", "at most", "later", "NEES", "others", "map"),
        *("landmark NEES", "duplicates", "old places", "factor off", "said soon", "latest [s]"),
        *("frames", "away [s]", "wrong", "and silent", "missed"),
    )
    low, high = bounds(len({row.seed for row in rows}) or 1)
    lines = [f"| {' | '.join(head)} |", f"|---|{'---:|' * (len(head) - 2)}---|"]
    groups: dict[tuple[str, int], list[Row]] = {}
    for row in sorted(rows, key=lambda row: order_of(key_of(row))):
        groups.setdefault((row.world, row.robots), []).append(row)
    for (world, robots), group in groups.items():
        lines.append(f"| {world} | {robots} | {len(group)} | {' | '.join(_cells(group))} |")
    silent = [row for row in rows if row.is_silently_wrong]
    exact = [row for row in rows if row.world in EXACTS]
    alarms = [row for row in exact if row.said]
    lines += [
        "",
        "Later: from 10 s after the difference could be noticed on, at a meeting for a start.",
        f"NEES of an honest filter lies in {low:.2f} .. {high:.2f} for so many seeds; one run is "
        f"wrong beyond {WRONG_NEES * bounds(1)[1]:.1f}, or at {WRONG_RATIO:g} times the error of "
        f"the exact world; and silent if nothing is said within 10 s and NEES is over "
        f"{bounds(1)[1]:.2f}.",
        f"Runs that are wrong and silent: {len(silent)} of {len(rows)}"
        + "".join(f"; {row.world}, K = {row.robots}, seed {row.seed}" for row in silent)
        + ".",
        f"False alarms: {len(alarms)} of {len(exact)} exact runs"
        + "".join(f"; K = {r.robots}, seed {r.seed}: {r.said}" for r in alarms)
        + ".",
    ]
    return "\n".join(lines) + "\n"


def _cells(group: list[Row]) -> list[str]:
    target = TARGETS[group[0].world]
    soon = sum(row.is_noticed for row in group)
    latest = max((row.noticed_s for row in group if row.noticed_s is not None), default=None)
    frames = max((r.noticed_frames for r in group if r.noticed_frames is not None), default=None)
    away = max((row.away_s for row in group if row.away_s is not None), default=None)
    allowed = growth(group) if target.optimum else target.ratio
    return [
        _with_spread([judged(row) for row in group]),
        _number(allowed, ".2f"),
        _with_spread([(row.later_m, row.exact_later_m) for row in group]),
        _number(_mean(row.nees for row in group), ".3g"),
        _with_spread([(row.others_m, row.exact_others_m) for row in group]),
        _with_spread([(row.map_m, row.exact_map_m) for row in group]),
        _number(_mean(row.landmark_nees for row in group), ".3g"),
        _number(_mean(row.duplicates for row in group), ".1f"),
        _number(_mean(row.old_places for row in group), ".1f"),
        _number(_mean(row.factor_off for row in group), ".2f"),
        f"{soon} of {len(group)}",
        _number(latest, ".1f"),
        _number(frames, "d"),
        _number(away, ".1f"),
        str(sum(row.is_wrong for row in group)),
        str(sum(row.is_silently_wrong for row in group)),
        ", ".join(unmet(group)) or "-",
    ]


def _with_spread(pairs: Sequence[Pair]) -> str:
    """Ratio of the means, ± the standard deviation of the runs' ratios."""
    ratio = ratio_of_means(pairs)
    if ratio is None:
        return ""
    ratios = np.array([_ratio(*pair) for pair in pairs], float)
    return f"{ratio:.2f} ± {ratios.std():.2f}"


def _ratio(value: float | None, reference: float | None) -> float | None:
    return value / reference if value is not None and reference else None


def _mean(values: Iterable[float | None]) -> float | None:
    """Of those that are known."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _number(value: float | None, form: str) -> str:
    return "" if value is None else f"{value:{form}}"
