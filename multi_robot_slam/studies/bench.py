"""`multi_robot_slam study bench`: how fast the filter is, and how fast it could be on this machine.

Everything is measured in a process of its own, whose libraries are told by environment variables
to use one thread, with the filter's `threads` at 1; a team that is live has the default, and its
rejuvenation a thread of its own.
Time is processor time, which on an idle machine is the time that passes, and on a shared one leaves
out what others run; only `first_step_s`, which also waits for files, and how long a `run` takes are
time that passes.
"""

import json
import os
import subprocess
import sys
from dataclasses import asdict, replace

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from multi_robot_slam.studies import rivals
from multi_robot_slam.studies.bench_limits import QUICK, Sizes
from multi_robot_slam.studies.bench_rows import measure
from multi_robot_slam.studies.bench_table import ONE_THREAD, TARGETS, Row


def run(quick: bool, seed: int = 0) -> list[Row]:
    """Measure in a fresh process of one thread."""
    rivals.check_literal()
    sizes = replace(QUICK if quick else Sizes(), seed=seed)
    command = [sys.executable, "-m", __name__, json.dumps(asdict(sizes))]
    done = subprocess.run(command, env=os.environ | ONE_THREAD, stdout=subprocess.PIPE, check=True)
    return [Row(**values) for values in json.loads(done.stdout)]


def to_json(rows: list[Row]) -> str:
    """A list of objects, one for each row."""
    return json.dumps([asdict(row) for row in rows], indent=1) + "\n"


def report(rows: list[Row]) -> Group:
    """The rows for a terminal: a table, and how each figure came about."""
    title = "Performance, one thread"
    caption = f"{', '.join(ONE_THREAD)} = 1; filter.threads = 1; processor time"
    table = Table(title=title, caption=caption, box=box.SIMPLE_HEAD, padding=0)
    for name in ("figure", "value", "unit", "target", "limit", "met"):
        is_number = name in ("value", "target", "limit")
        table.add_column(name, justify="right" if is_number else "left", no_wrap=True)
    notes = []
    for row in rows:
        target = f"{TARGETS[row.name][1]} {row.target:g}"
        met = "yes" if row.met else "[red]no"
        table.add_row(row.name, f"{row.value:.4g}", row.unit, target, f"{row.limit:.3g}", met)
        notes.append(
            f"{row.name}: {row.spread[0]:.3g} to {row.spread[1]:.3g} {row.unit}; {row.note}"
        )
    return Group(table, Text("\n".join(notes)))


if __name__ == "__main__":
    print(to_json(measure(Sizes(**json.loads(sys.argv[1])))))
