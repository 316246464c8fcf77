"""How good SLAM from images is: recorded and rendered cameras x seeds -> table."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

from msg_defs import scenario_file
from msg_defs.errors import InputError
from multi_robot_slam.config import FOR_PICTURES, shipped
from multi_robot_slam.studies import cameras_recorded, cameras_rendered, cameras_table, table
from multi_robot_slam.studies.cameras_table import Key, Row

SOURCES = ("euroc", "kitti", "rendered")


@dataclass(frozen=True)
class Plan:
    """What is run: a source, its folder where it is recorded, and which set-ups of it."""

    source: str
    folder: Path | None
    setups: tuple[str, ...]
    particles: int


def plan(source: str, folder: Path | None, setups: str | None, particles: int) -> Plan:
    """Check what a user asks for; `setups` has commas between them, None: all."""
    if source not in SOURCES:
        raise InputError(f"no cameras '{source}'; there are {', '.join(SOURCES)}, library")
    if (folder is None) != (source == "rendered"):
        raise InputError(
            "rendered cameras need no folder"
            if source == "rendered"
            else f"name the folder of the recording: study cameras {source} FOLDER"
        )
    known = cameras_rendered.SETUPS if folder is None else cameras_recorded.SETUPS[source]
    chosen = known if setups is None else tuple(name.strip() for name in setups.split(","))
    if unknown := [name for name in chosen if name not in known]:
        raise InputError(f"no set-up '{unknown[0]}'; there are {', '.join(known)}")
    return Plan(source, folder, chosen, particles)


def study(
    wanted: Plan,
    seeds: range,
    out: Path,
    execute: table.Execute,
    on_progress: Callable[[float, float], None] = lambda done, total: None,
) -> list[Row]:
    """Bring `out/cameras.csv` to hold every run of the `seeds`; rows it has are not made again.

    Returns the rows asked for, in a fixed order, which `out/cameras.md` summarises.
    """
    table.claim(out, _settings(wanted))
    kept = cameras_table.opened(out / "cameras.csv")
    jobs = [job for seed in seeds for job in _jobs(wanted, seed, out)]
    done = {(setup, seed, particles) for setup, _, seed, particles in kept.rows}
    todo = [job for job in jobs if (job.setup, job.seed, job.particles) not in done]
    _make_clouds(wanted, todo, execute)
    table.fill(kept, todo, _compute, _keyed, execute, on_progress)
    asked = {(job.setup, job.seed, job.particles) for job in jobs}
    keys = [key for key in kept.rows if (key[0], key[2], key[3]) in asked]
    rows = [kept.rows[key] for key in sorted(keys, key=lambda k: (wanted.setups.index(k[0]), k))]
    (out / "cameras.md").write_text(markdown(wanted, rows))
    return rows


def _settings(wanted: Plan) -> str:
    """What all rows of a table have in common."""
    own = {
        "cameras": wanted.source,
        "folder": None if wanted.folder is None else str(wanted.folder.resolve()),
        "settings": scenario_file.to_plain(shipped(FOR_PICTURES)),
    }
    return yaml.safe_dump(own, sort_keys=False)


def markdown(wanted: Plan, rows: Sequence[Row]) -> str:
    """The summary of the rows."""
    over = cameras_rendered.LANDMARKS if wanted.source == "rendered" else None
    return cameras_table.markdown(rows, over if over in wanted.setups else None)


Job = cameras_recorded.Job | cameras_rendered.Job


def _jobs(wanted: Plan, seed: int, out: Path) -> list[Job]:
    if wanted.folder is None:
        return [cameras_rendered.Job(out, s, seed, wanted.particles) for s in wanted.setups]
    return [
        cameras_recorded.Job(wanted.source, wanted.folder, out, setup, seed, wanted.particles)
        for setup in wanted.setups
    ]


def _make_clouds(wanted: Plan, todo: Sequence[Job], execute: table.Execute) -> None:
    """Look at the images that nobody has looked at yet."""
    first = {job.setup: job for job in reversed(todo)}
    needed = list(first.values()) if wanted.folder is None else todo[:1]
    for _ in execute(_make, needed):
        pass


def _make(job: Job) -> None:
    if isinstance(job, cameras_rendered.Job):
        cameras_rendered.make_clouds(job)
    else:
        cameras_recorded.make_clouds(job)


def _compute(job: Job) -> list[Row]:
    if isinstance(job, cameras_rendered.Job):
        return cameras_rendered.compute(job)
    return cameras_recorded.compute(job)


def _keyed(job: Job, rows: list[Row]) -> dict[Key, Row]:
    return {cameras_table.key_of(row): row for row in rows}
