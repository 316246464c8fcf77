"""The figures of several runs side by side."""

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.table import Table
from rich.text import Text

from msg_defs import scenario_file
from msg_defs.errors import InputError
from multi_robot_slam.config import SECTION
from multi_robot_slam.runs import result
from multi_robot_slam.runs.evaluation_table import empty, number, titles
from multi_robot_slam.runs.run import TEAM

HIGHER_IS_BETTER = {"association_precision", "association_recall"}
NOT_JUDGED = {
    *("landmarks", "landmarks_seen", "truth_coverage"),
    *("pose_nees", "landmark_nees", "refined_landmark_nees"),
}
"""Of all others less is better."""

SMALLEST_SHARE = 5e-4
"""Smaller differences are not marked."""

Key = tuple[str, str]


@dataclass(frozen=True)
class Comparison:
    """Figures of R runs."""

    folders: tuple[Path, ...]
    figures: dict[Key, tuple]
    """(robot, or "team"; name of the figure) -> R values, None where a run does not have it."""
    settings: dict[str, tuple]
    """Setting that is not the same in all runs -> R values, None where a run does not have it."""

    @property
    def bags(self) -> tuple:
        """Of which recordings the runs are."""
        return self.figures.get((TEAM, "bag"), (None,) * len(self.folders))


def compare(folders: Sequence[Path]) -> Comparison:
    """Read `result.json` and `config.yaml` of each folder, two or more."""
    if len(folders) < 2:
        raise InputError(f"cannot compare {folders[0]} with nothing; name two folders or more")
    configured = [_leaves(_settings(folder)) for folder in folders]
    joined = _joined([dict(config) for config in configured])
    return Comparison(
        folders=tuple(folders),
        figures=_joined([result.flat(result.figures_in(folder)) for folder in folders]),
        settings={name: values for name, values in joined.items() if not _same(values)},
    )


def _settings(folder: Path) -> dict:
    path = folder / "config.yaml"
    return scenario_file.sections(scenario_file.read(path), str(path))[SECTION]


def _leaves(values: dict, prefix: str = "") -> Iterator[tuple[str, object]]:
    """Nested settings as (dotted name, value)."""
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _joined(mappings: Sequence[dict]) -> dict:
    """Each key's value in each mapping, in the order in which the keys turn up."""
    keys = dict.fromkeys(key for mapping in mappings for key in mapping)
    return {key: tuple(mapping.get(key) for mapping in mappings) for key in keys}


def _same(values: tuple) -> bool:
    return all(value == values[0] for value in values)


def notes(compared: Comparison) -> list[str]:
    """What else than the estimate differs between the runs, a line each."""
    lines = []
    if not _same(compared.bags):
        lines.append("of different recordings: " + _listed(compared.bags))
    machines = [_machine(compared, row) for row in range(len(compared.folders))]
    if not _same(tuple(machines)):
        lines.append("on different machines: " + _listed(tuple(machines)))
    lines += [f"{name}: {_listed(values)}" for name, values in compared.settings.items()]
    return lines


def _machine(compared: Comparison, row: int) -> str | None:
    """Processor and cores of the run in this row, on which only its times depend."""
    names = (f"{result.MACHINE}processor", f"{result.MACHINE}cores")
    values = [compared.figures.get((TEAM, name)) for name in names]
    known = [str(value[row]) for value in values if value is not None and value[row] is not None]
    return ", ".join(known) or None


def _listed(values: tuple) -> str:
    return " | ".join("-" if value is None else str(value) for value in values)


def table(compared: Comparison) -> Table:
    """A column a run; behind each figure how much it differs from the first run's."""
    shown = empty()
    for folder in compared.folders:
        shown.add_column(Text(str(folder)), justify="right")
    for who in dict.fromkeys(who for who, _ in compared.figures):
        own = {name: values for (whose, name), values in compared.figures.items() if whose == who}
        known = {name for name, values in own.items() if set(values) != {None}}
        shown.add_section()
        shown.add_row(Text(who, style="bold"))
        for rows in titles(known):
            for name, title in rows.items():
                first, *others = own[name]
                cells = (marked(name, first, value) for value in others)
                shown.add_row(Text(title), number(first), *cells)
    return shown


def marked(name: str, first: float | None, value: float | None) -> Text:
    """The value and, where it differs, by how much; green where that is for the better."""
    if value is None or first is None or abs(value - first) <= SMALLEST_SHARE * abs(first):
        return Text(number(value))
    is_better = (value > first) == (name in HIGHER_IS_BETTER)
    style = "" if name in NOT_JUDGED else "green" if is_better else "red"
    return Text.assemble(number(value), " ", (f"({_difference(first, value)})", style))


def _difference(first: float, value: float) -> str:
    if first == 0:
        return f"{value:+.3g}"
    share = (value - first) / abs(first)
    return f"{share:+.1%}" if abs(share) < 10 else f"x {value / first:.3g}"


def write(compared: Comparison, file: Path) -> None:
    """Every figure of every run as CSV: `robot, figure`, and a column a folder."""
    try:
        with file.open("w", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(["robot", "figure", *compared.folders])
            writer.writerows([*key, *values] for key, values in compared.figures.items())
    except OSError as error:
        raise InputError(f"cannot write {file}: {error.strerror}; choose another") from None
