"""Options and arguments that several verbs share, and how the shell completes them."""

from pathlib import Path
from typing import Annotated

import typer

from msg_defs import cli


def _runs(incomplete: str) -> list[str]:
    """Folders in runs/ to begin with, then whatever folders the word begins."""
    found = Path().glob(f"{incomplete}*" if incomplete else "runs/*")
    return sorted(str(path) for path in found if path.is_dir())


Out = Annotated[Path | None, typer.Option(help="Folder to write; it must not exist yet.")]
ScenarioName = Annotated[
    str,
    typer.Option(
        help="Scenario: a YAML file, or paper, calibrated or cameras.", autocompletion=cli.scenarios
    ),
]
OtherScenario = Annotated[
    str | None,
    typer.Option(
        help="Scenario instead of the configuration in the bag. Robots, start poses and cameras "
        "that it leaves out are the bag's.",
        autocompletion=cli.scenarios,
    ),
]
RunFolder = Annotated[
    Path, typer.Argument(metavar="DIR", help="Folder of a run.", autocompletion=_runs)
]
RunFolders = Annotated[
    list[Path], typer.Argument(metavar="DIR...", help="Folders of runs.", autocompletion=_runs)
]
Namespace = Annotated[
    str | None,
    typer.Option(
        help="In which the team was recorded, such as /fleet. Default: the only one in the bag."
    ),
]
BagOut = Annotated[Path, typer.Option(help="Bag to write; it must not exist yet.")]
FrameRate = Annotated[
    float, typer.Option(min=0.01, max=100, help="Frames of each robot in a second [Hz].")
]
Robots = Annotated[int | None, typer.Option(min=1, max=32, help="Number of robots.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")]
FirstSeed = Annotated[int, typer.Option(min=0, help="Seed of the first repeat.")]
