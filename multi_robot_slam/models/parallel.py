"""Both cores where it pays: compiled loops split over threads, with the same result for any number.

Kernels release the GIL, and what they compute for one particle or column does not depend on how the
others are shared out.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from itertools import pairwise

from threadpoolctl import ThreadpoolController

BLOCK = 256
"""Particles that kernels handle together."""

one_thread = ThreadpoolController().wrap(limits=1, user_api="blas")
"""Decorator: BLAS runs with one thread; the same bytes on any number of cores."""


def over(kernel: Callable, size: int, grain: int, threads: int, *arguments) -> None:
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


def over_particles(kernel: Callable, particles: int, threads: int, *arguments) -> None:
    """Call kernel(first, last, *arguments) for parts of the particles, blocks kept whole."""
    over(kernel, particles, BLOCK, threads, *arguments)


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="filter")
