"""What the commands print: results to stdout; messages and progress bars to stderr."""

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

console = Console()
messages = Console(stderr=True)


def warn(text: str) -> None:
    """Say what a user should know, although the command goes on."""
    messages.print(text, style="yellow", markup=False, soft_wrap=True)


def counter(unit: str) -> Progress:
    """A bar that counts what is done, for work whose end may be unknown."""
    count = TextColumn("{task.completed} " + unit)
    columns = (TextColumn("{task.description}"), BarColumn(), count, TimeElapsedColumn())
    return Progress(*columns, console=messages, transient=True, disable=not messages.is_terminal)


def countdown(estimate_over_s: float = 30.0) -> Progress:
    """A bar with the share that is done and the time left, estimated over the last seconds."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=messages,
        speed_estimate_period=estimate_over_s,
        transient=True,
        disable=not messages.is_terminal,
    )
