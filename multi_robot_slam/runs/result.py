"""`result.json`: the figures of a run as other programs read them, and the same as a table."""

import csv
import json
from pathlib import Path

from msg_defs.errors import InputError
from multi_robot_slam.runs.estimates import DROPPED
from multi_robot_slam.runs.run import TEAM

FILE = "result.json"
TABLE = "figures.csv"
MACHINE = "machine: "
"""Prefix of what is known of the machine, as figures of their own."""


def write(figures: dict, folder: Path) -> None:
    """Write the figures (`evaluation.evaluate`) as `result.json` and, a row each, `figures.csv`."""
    (folder / FILE).write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n")
    with (folder / TABLE).open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["robot", "figure", "value"])
        writer.writerows([*key, value] for key, value in flat(figures).items())


def figures_in(folder: Path) -> dict:
    """What `result.json` in `folder` holds; `InputError` if there is none."""
    path = Path(folder) / FILE
    try:
        figures = json.loads(path.read_text())
    except OSError as error:
        raise InputError(
            f"cannot read {path}: {error.strerror}; name the folder of a run, "
            f"judged by `multi_robot_slam evaluate {folder}`"
        ) from None
    except ValueError as error:
        raise InputError(f"{path} is not JSON ({error}); write it again: `evaluate`") from None
    if not isinstance(figures, dict):
        raise InputError(f"{path} holds no figures of a run; write it again: `evaluate`")
    return figures


def flat(figures: dict) -> dict[tuple[str, str], object]:
    """(robot, or TEAM; figure) -> value of everything `result.json` holds.

    What was dropped becomes figures of its own, and so does what is known of the machine.
    """
    nested = ("robots", "dropped", "machine")
    team = {name: value for name, value in figures.items() if name not in nested}
    machine = figures.get("machine") or {}
    team |= {f"{MACHINE}{name}": value for name, value in machine.items()}
    team |= {f"{DROPPED}{why}": count for why, count in figures.get("dropped", {}).items()}
    whose = {TEAM: team, **figures.get("robots", {})}
    return {(who, name): value for who, own in whose.items() for name, value in own.items()}
