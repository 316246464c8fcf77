"""Compiled loops shared out over threads, with the same result for any number of them.

Kernels release the GIL, and what they compute for one particle or column does not depend on how the
others are shared out.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache, wraps
from itertools import pairwise
from typing import Any, ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")

BLOCK = 256
"""Particles that kernels handle together."""


def one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: BLAS has one thread from the first call on: the same bytes on any number of cores.

    Nor does anything wait for a core that is busy. Never given back: another thread may be inside.
    """

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        if any(library.num_threads != 1 for library in _blas().lib_controllers):
            _blas().limit(limits=1)
        return function(*args, **kwargs)

    return limited


@cache
def _blas() -> ThreadpoolController:
    """The BLAS libraries of NumPy and SciPy, both of which are loaded when this is called first."""
    return ThreadpoolController().select(user_api="blas")


def over(kernel: Callable, size: int, grain: int, threads: int, *arguments: Any) -> None:
    """Call kernel(first, last, *arguments) once a thread, for parts that begin at whole grains."""
    grains = -(-size // grain)
    threads = min(threads, grains)
    if threads <= 1:
        kernel(0, size, *arguments)
        return
    edges = [min(size, grains * t // threads * grain) for t in range(threads + 1)]
    tasks = [
        _pool(threads - 1).submit(kernel, first, last, *arguments)
        for first, last in pairwise(edges[1:])
    ]
    kernel(edges[0], edges[1], *arguments)
    wait(tasks)
    for task in tasks:
        task.result()


def over_particles(kernel: Callable, particles: int, threads: int, *arguments: Any) -> None:
    """Call kernel(first, last, *arguments) for parts of the particles, blocks kept whole."""
    over(kernel, particles, BLOCK, threads, *arguments)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="filter")
