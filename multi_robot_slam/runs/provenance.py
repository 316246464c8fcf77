"""What made a run: the package's version, the scenario, the machine."""

import os
import platform
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

CPU_INFO = Path("/proc/cpuinfo")


@dataclass(frozen=True)
class Provenance:
    """What made a run, and where."""

    version: str
    """Of this package."""
    scenario: str | None
    """The name of a shipped scenario or the path of a file; None if the configuration came from
    elsewhere, as from the recording."""
    machine: dict[str, str | int]
    """See `machine`."""


def here(scenario: str | None = None) -> Provenance:
    """That of a run made by this package on this machine."""
    return Provenance(version(), scenario, machine())


def version() -> str:
    """The installed version of this package; `unknown` where it runs without being installed."""
    return _version_of("multi_robot_slam")


def machine() -> dict[str, str | int]:
    """`platform`, `processor`, `cores` of this process; versions of `python`, `numpy`, `numba`."""
    return {
        "platform": platform.platform(),
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "numpy": _version_of("numpy"),
        "numba": _version_of("numba"),
    }


def _processor() -> str:
    """The model as Linux tells it, else what the platform knows."""
    try:
        lines = CPU_INFO.read_text().splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.processor() or platform.machine())


def _version_of(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"
