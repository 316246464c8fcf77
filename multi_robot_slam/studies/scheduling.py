"""Runs a function on many jobs: on the cores of this machine, or on a Dask cluster."""

import logging
import multiprocessing
import os
import re
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection
from typing import TypeVar

from msg_defs.errors import InputError

Job = TypeVar("Job")
Answer = TypeVar("Answer")

ADDRESS = re.compile(r"tcp://[^/:]+:\d{1,5}")
CONNECT_S = 3.0
"""How long to try to reach a scheduler, and then to wait for its first worker."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""What numerical libraries read, once, when they are loaded."""


def local(
    function: Callable[[Job], Answer], jobs: Iterable[Job], processes: int | None = None
) -> Iterator[tuple[Job, Answer]]:
    """Each job with its answer, as they finish; one single-threaded process per core.

    The processes end with this one, however it ends.
    """
    count = processes or len(os.sched_getaffinity(0))
    context = multiprocessing.get_context("spawn")
    with _one_thread_each():
        pool = ProcessPoolExecutor(count, context, initializer=_end_with_parent)
        try:
            jobs_of = {pool.submit(function, job): job for job in jobs}
            for future in as_completed(jobs_of):
                yield jobs_of.pop(future), future.result()
        except BrokenProcessPool:
            raise InputError(
                "a process of the experiment was killed, perhaps for want of memory; the same "
                "command goes on where it stopped, fewer --processes need less"
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)


def on_cluster(
    function: Callable[[Job], Answer], jobs: Iterable[Job], scheduler: str
) -> Iterator[tuple[Job, Answer]]:
    """Each job with its answer, as they finish, on the Dask cluster of `scheduler` (tcp://...).

    The workers need this package. Jobs of a worker that is lost are done by the others.
    """
    if not ADDRESS.fullmatch(scheduler):
        raise InputError(f"scheduler = '{scheduler}': give tcp://host:port")
    try:
        import distributed
    except ModuleNotFoundError:
        raise InputError("no Dask here: pip install 'multi_robot_slam[dask]'") from None
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # it raises as well
    try:
        client = distributed.Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except OSError as error:
        raise InputError(f"no Dask scheduler at {scheduler}: {error}; start one there") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_S)
        except TimeoutError:
            raise InputError(f"the scheduler {scheduler} has no workers; start some") from None
        jobs_of = {client.submit(function, job, pure=False): job for job in jobs}
        try:
            for future in distributed.as_completed(jobs_of, loop=client.loop):
                yield jobs_of.pop(future), future.result()
        except (CancelledError, distributed.KilledWorker) as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"{reason} The same command goes on where it stopped") from None


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes that start meanwhile use one thread: there is one for each core already."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _end_with_parent() -> None:
    """Make this process end when its parent does, or at Ctrl-C, without a word."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if parent := multiprocessing.parent_process():
        threading.Thread(target=_exit_after, args=(parent.sentinel,), daemon=True).start()


def _exit_after(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)
