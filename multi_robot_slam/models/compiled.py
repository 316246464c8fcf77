"""One spelling for all compiled loops, and a cache of machine code that follows their sources.

Numba keys its cache on the file of the function alone: machine code that has inlined a callee of
another file would outlive an edit of that file. Here the folder of the cache is named after the
content of every module that compiles; beside the code, what older sources left is removed.
"""

import hashlib
import os
import shutil
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numba

ROOMS = ("models", "smoothing", "filter", "front_end")
"""Packages beside and below this one whose functions are compiled."""

PREFIX = "kernels-"

config: Any = numba.config
"""Numba makes its settings attributes of this module while it is imported."""


def kernel(function: Callable | None = None, **options: Any) -> Callable:
    """Compile a function of plain arrays and numbers when it is first called.

    Without the interpreter's lock, so that threads share the work; without Python's errors on
    division, so that loops become SIMD code; with strict IEEE arithmetic, so that the same numbers
    come out whatever is inlined.
    """
    if function is None:
        return partial(kernel, **options)
    before = config.CACHE_DIR
    config.CACHE_DIR = str(_folder(before))
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    finally:
        config.CACHE_DIR = before


@cache
def _folder(base: str) -> Path:
    """Where machine code of the sources as they are is kept.

    In `base`, the user's NUMBA_CACHE_DIR, or else beside this file, where that can be written.
    """
    beside = Path(__file__).with_name("__pycache__")
    home = Path(base) if base else beside
    if not base and not os.access(beside if beside.exists() else beside.parent, os.W_OK):
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "multi_robot_slam"
    folder = home / f"{PREFIX}{digest(Path(__file__).parents[1])}"
    if home == beside and not folder.exists():
        for outdated in home.glob(f"{PREFIX}*"):
            shutil.rmtree(outdated, ignore_errors=True)
    return folder


def digest(package: Path) -> str:
    """A name that changes whenever a source file of the compiled rooms does."""
    files = sorted(file for room in ROOMS for file in (package / room).rglob("*.py"))
    content = hashlib.blake2b(digest_size=8)
    for file in files:
        content.update(f"{file.relative_to(package)}\n".encode())
        content.update(file.read_bytes())
    return content.hexdigest()
