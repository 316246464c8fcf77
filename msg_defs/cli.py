"""What all commands share: bad input ends in one line and exit code 2; nodes need ROS."""

import sys
from collections.abc import Callable
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from msg_defs.errors import InputError

DISTRIBUTION = "multi_robot_slam"
"""What pip calls the two packages together."""
PASS_ON = {"allow_extra_args": True, "ignore_unknown_options": True}
"""Settings of a verb whose arguments, `--help` included, are a node's to read."""


def _tell_version(is_wanted: bool) -> None:
    if is_wanted:
        typer.echo(f"{DISTRIBUTION} {metadata.version(DISTRIBUTION)}")
        raise typer.Exit


def options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_tell_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Options of the command itself, before any verb."""


def scenarios(incomplete: str) -> list[str]:
    """The shipped scenarios and YAML files whose names begin so, for the shell."""
    from msg_defs import scenario_file

    files = (str(path) for path in Path().glob(f"{incomplete}*.yaml"))
    return [*(s for s in scenario_file.shipped() if s.startswith(incomplete)), *sorted(files)]


def run(app: Callable[[], object]) -> None:
    """Run a command-line app; an `InputError` becomes one line on stderr and exit code 2."""
    try:
        app()
    except InputError as error:
        print("error:", "; ".join(str(error).splitlines()), file=sys.stderr)
        sys.exit(2)


def require_ros() -> None:
    """`InputError` where ROS is not installed or not sourced."""
    if find_spec("rclpy") is None:
        raise InputError(
            "no module 'rclpy': source ROS 2 Jazzy, or pip install 'multi_robot_slam[ros]'"
        )


def start_node(module: str, args: list[str]) -> NoReturn:
    """Run the node in `module` until it ends, and exit with its code."""
    require_ros()
    sys.exit(import_module(module).main(args))
