"""The table that a study fills: a CSV file, one row a run, which survives being interrupted.

Rows are appended as runs finish; a row is whole when its line ends. The finished table is in the
order of its keys, so it does not depend on the order in which the runs ended.
"""

import csv
import io
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, get_args, get_type_hints

from msg_defs.errors import InputError

Key = TypeVar("Key")
Value = TypeVar("Value")
Job = TypeVar("Job")
Answer = TypeVar("Answer")


class Format(NamedTuple, Generic[Key, Value]):
    """How a table writes its rows."""

    header: str
    to_line: Callable[[Key, Value], str]
    from_line: Callable[[str], tuple[Key, Value]]
    """The inverse; `InputError` says what does not fit."""
    order: Callable[[Key], Any] = lambda key: key
    """What the finished table is sorted by."""


class Table(Generic[Key, Value]):
    """The rows of the file at `path`, none if it does not exist.

    A last line that was cut off is left out. `InputError` for a file that is no such table.
    """

    def __init__(self, path: Path, form: Format[Key, Value]) -> None:
        self.path = path
        self.rows: dict[Key, Value] = {}
        self._form = form
        header, *lines = self._read().split("\n")[:-1] or [form.header]
        if header != form.header:
            raise InputError(
                f"{path} has other columns than this version writes; use another --out"
            )
        try:
            self.rows.update(map(form.from_line, lines))
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def append(self, rows: Mapping[Key, Value]) -> None:
        """Add `rows` to the file, at once and for good."""
        with self.path.open("a") as file:
            file.writelines(f"{self._form.to_line(*row)}\n" for row in rows.items())
            file.flush()
            os.fsync(file.fileno())
        self.rows.update(rows)

    def write(self) -> None:
        """Write the whole table, sorted, in place of the old one."""
        keys = sorted(self.rows, key=self._form.order)
        lines = [self._form.header, *(self._form.to_line(key, self.rows[key]) for key in keys)]
        new = self.path.with_suffix(".new")
        new.write_text("\n".join(lines) + "\n")
        os.replace(new, self.path)

    def _read(self) -> str:
        try:
            return self.path.read_text()
        except FileNotFoundError:
            return ""
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"cannot read {self.path}: {error}") from None


class Execute(Protocol):
    """Runs a function on jobs, here or elsewhere: `scheduling.local`, `scheduling.on_cluster`."""

    def __call__(
        self, function: Callable[[Job], Answer], jobs: Sequence[Job], /
    ) -> Iterator[tuple[Job, Answer]]:
        """Each job with its answer, as they finish."""


def fill(
    table: Table[Key, Value],
    jobs: Sequence[Job],
    compute: Callable[[Job], Answer],
    rows_of: Callable[[Job, Answer], Mapping[Key, Value]],
    execute: Execute,
    on_progress: Callable[[float, float], None] = lambda done, total: None,
    cost: Callable[[Job], float] = lambda job: 1.0,
) -> None:
    """Compute the jobs and add the rows of each as it finishes; then sort the table.

    `on_progress` is told the share of the work that is done, and all of it, in units of `cost`.
    """
    table.write()
    done, total = 0.0, sum(map(cost, jobs))
    on_progress(done, total)
    for job, answer in execute(compute, jobs) if jobs else ():
        table.append(rows_of(job, answer))
        done += cost(job)
        on_progress(done, total)
    table.write()


def claim(folder: Path, settings: str) -> None:
    """Make the folder, or make sure that its rows come from the same `settings`, as YAML."""
    path = folder / "settings.yaml"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            path.write_text(settings)
        known = path.read_text()
    except OSError as error:
        raise InputError(f"cannot write into {folder}: {error.strerror}") from None
    if known != settings:
        raise InputError(
            f"{folder} holds an experiment with other settings (settings.yaml there); remove it "
            "or choose another folder with --out"
        )


def line(values: Iterable[float | str | None]) -> str:
    """A row as CSV: floats with six digits, None as an empty cell."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(map(_cell, values))
    return text.getvalue()


def cells(text: str, columns: Sequence[str], types: Sequence[type]) -> list[Any]:
    """The inverse of `line`, empty cells as None; `InputError` names the cell that does not fit."""
    words = next(csv.reader([text.strip()]), [])
    if len(words) != len(columns):
        raise InputError(
            f"not a row of the table: '{text.strip()}'; its columns are {','.join(columns)}"
        )
    return [_parse(*cell) for cell in zip(types, columns, words, strict=True)]


def types_of(cls: type) -> tuple[type, ...]:
    """The types of a dataclass's fields, in their order; that of `float | None` is float."""
    hints = get_type_hints(cls)
    return tuple(get_args(hint)[0] if get_args(hint) else hint for hint in hints.values())


def _cell(value: float | str | None) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _parse(kind: type, name: str, word: str) -> float | int | str | None:
    if not word:
        return None
    try:
        return kind(word)
    except ValueError:
        raise InputError(f"{name} = '{word}' is no number") from None
