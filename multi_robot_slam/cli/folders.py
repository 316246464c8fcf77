"""The folder that a command leaves its results in."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from msg_defs.errors import InputError


@contextmanager
def new_folder(out: Path | None) -> Iterator[Path]:
    """Make `out`, or runs/<time>, and then the link runs/latest; what stays empty is removed."""
    folder = out or Path("runs") / f"{datetime.now():%Y%m%d_%H%M%S}"
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise InputError(f"{folder} exists; remove it or choose another with --out") from None
    except OSError as error:
        raise InputError(f"cannot make the folder {folder}: {error.strerror}") from None
    try:
        yield folder
    finally:
        if not any(folder.iterdir()):
            folder.rmdir()
        elif out is None:
            _link_latest(folder)


def _link_latest(folder: Path) -> None:
    link = folder.parent / "latest.new"
    link.unlink(missing_ok=True)
    link.symlink_to(folder.name)
    os.replace(link, folder.parent / "latest")
