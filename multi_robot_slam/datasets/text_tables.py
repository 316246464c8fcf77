"""Files of numbers, one row a line, as recordings bring them."""

import math
from pathlib import Path

import numpy as np

from msg_defs.errors import InputError


def read_table(path: Path, columns: int, separator: str | None = None) -> np.ndarray:
    """(n, columns) float64: the numbers of each line; `#` begins a comment line.

    `separator` is that of the columns, by default white space. `InputError` names the line.
    """
    rows = [_numbers(line, columns, separator, path, number) for number, line in read_lines(path)]
    if not rows:
        raise InputError(f"{path} holds no numbers; unpack the recording again")
    return np.array(rows)


def read_lines(path: Path) -> list[tuple[int, str]]:
    """The lines that are neither empty nor comments, each with its number from 1."""
    try:
        text = path.read_text()
    except OSError as error:
        raise InputError(
            f"{path}: {error.strerror}; name the folder of a whole recording"
        ) from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is no text file; unpack the recording again") from None
    lines = enumerate(text.splitlines(), start=1)
    return [(n, line) for n, line in lines if line.strip() and not line.startswith("#")]


def _numbers(
    line: str, columns: int, separator: str | None, path: Path, number: int
) -> list[float]:
    try:
        values = [float(word) for word in line.split(separator)]
    except ValueError:
        values = []
    if len(values) != columns or not all(map(math.isfinite, values)):
        raise InputError(
            f"{path}, line {number}: {line.strip()!r} is not {columns} finite numbers; "
            "correct or remove the line"
        )
    return values
