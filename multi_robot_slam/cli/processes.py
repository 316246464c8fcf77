"""All at once: simulated robots, fusion and a listener as processes that talk over DDS.

Where robots send pictures, a camera node for each robot, too.
"""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from subprocess import Popen
from typing import NamedTuple

from msg_defs import scenario_file
from msg_defs.errors import InputError
from multi_robot_slam.cli import maps
from multi_robot_slam.cli.terminal import warn
from multi_robot_slam.watch.address import Serving, free, require_viser
from sim_world.scenario import SECTION as WORLD_SECTION
from sim_world.scenario import Scenario

END_S = 1.8
"""How long the processes may take to end, all together, but for the listener."""
LISTENER_S = 10.0
"""How long the listener may, after them: usually a tenth of a second, but a bag must be whole."""
PAGE_S = 0.4
"""How long the page may take to end, after them."""
OFTEN_S, RARELY_S = 1.0, 5.0
"""Time between two maps; one made of pictures has thousands of landmarks, each of 600 bytes."""
IDLE_S = 2.0
IDLE_PERIODS = 4
"""Silence after which the fusion takes the exploration for over: so long, and so many frames."""


def record(
    folder: Path, scenario: Path, seed: int, speed: float, begun_in: Path | None = None
) -> None:
    """Spawn recorder, fusion, cameras and robots; leave `folder/bag` when the exploration is over.

    And the map of it, in `maps.FILE`. `scenario` is the file of all their settings, `begun_in` that
    of the map to begin with, if there is one. SIGINT, SIGTERM or a process that fails end all of
    them, the recorder last, so that its bag is whole; then the program exits.
    """
    bag = folder / "bag"
    recorder = _Listener("multi_robot_slam.nodes.recorder", bag, truths=1)
    kept = [f"autosave:={folder.resolve() / maps.FILE}", "autosave_s:=0.0"]
    kept += [] if begun_in is None else [f"map:={begun_in}"]
    if failed := _play(recorder, scenario, seed, speed, kept):
        left = f"what was recorded so far is in {bag}" if bag.exists() else "nothing was recorded"
        sys.exit(f"error: {failed}; {left}")


def clock(arrivals: Path, scenario: Path, seed: int) -> None:
    """The same in real time with a stopwatch instead of the recorder, which writes `arrivals`."""
    stopwatch = _Listener("multi_robot_slam.nodes.stopwatch", arrivals, truths=0)
    if failed := _play(stopwatch, scenario, seed, speed=1.0):
        sys.exit(f"error: {failed}")


@contextmanager
def watching() -> Iterator[None]:
    """Serve a page of the fusion to come while the block runs, and print where.

    Where that cannot be, the reason is said, and all goes on without it.
    """
    _choose_domain()
    try:
        require_viser()
        address = free(Serving())
    except InputError as error:
        warn(f"no page to watch it: {error}")
        yield
        return
    where = f"host:={address.host}", f"port:={address.port}"
    page = _spawn("multi_robot_slam.nodes.watch", *where, f"ends_with:={os.getpid()}")
    print(f"Watch it at {address}", flush=True)
    try:
        yield
    finally:
        _end_by([page], time.monotonic() + PAGE_S)


class _Listener(NamedTuple):
    """The node that hears robots and fusion."""

    module: str
    out: Path
    """What it writes."""
    truths: int
    """Subscriptions of it to each topic of the truth."""


def _play(
    listener: _Listener, scenario: Path, seed: int, speed: float, kept: Sequence[str] = ()
) -> str:
    """Have all of them play the exploration to its end; what went wrong, if anything has.

    `kept` are the fusion's parameters of maps.
    """
    _choose_domain()
    print(f"ROS_DOMAIN_ID={os.environ['ROS_DOMAIN_ID']} lets other ROS tools listen", flush=True)
    world = scenario_file.from_file(Scenario, scenario, WORLD_SECTION)
    idle_s = max(IDLE_S, IDLE_PERIODS * world.period_s / speed if speed else 0.0)
    shared = f"scenario:={scenario}"
    seeing = world.names if world.images.enabled else ()
    # The listener, the fusion, and each robot's own camera hear its odometry.
    pace = f"seed:={seed}", f"speed:={speed}", f"subscribers:={3 if seeing else 2}"
    period_s = RARELY_S if seeing else OFTEN_S
    truths = f"truth_subscribers:={listener.truths}"
    processes: list[Popen[bytes]] = []

    def start(module: str, *parameters: str) -> Popen[bytes]:
        processes.append(_spawn(module, *parameters))
        return processes[-1]

    with _stops_noted() as stops:
        try:
            names = f"robots:=[{','.join(world.names)}]"
            hearing = start(listener.module, f"out:={listener.out}", names)
            ends = f"stop_after_s:={idle_s}", "subscribers:=1", f"picture_period_s:={period_s}"
            fusion = start("multi_robot_slam.nodes.fusion", shared, *ends, *kept)
            cameras = [
                start("multi_robot_slam.nodes.camera", shared, f"only:={robot}", "subscribers:=2")
                for robot in seeing
            ]
            robots = start("sim_world.robots", shared, *pace, truths)
            needed = [hearing, *cameras]
            return _wait(robots, [fusion, *needed], stops) or _wait(fusion, needed, stops)
        finally:
            _end(processes)


def _choose_domain() -> None:
    """Have all processes talk among themselves, where the user has not said otherwise."""
    os.environ.setdefault("ROS_DOMAIN_ID", str(random.randint(1, 101)))
    os.environ.setdefault("RCUTILS_CONSOLE_OUTPUT_FORMAT", "[{severity}] {name}: {message}")


@contextmanager
def _stops_noted() -> Iterator[list[int]]:
    """Note the signals that ask to stop in a list; they interrupt nothing in the block."""
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # as `nohup` has it
        numbers.append(signal.SIGHUP)
    stops: list[int] = []
    before = {n: signal.signal(n, lambda number, _: stops.append(number)) for n in numbers}
    try:
        yield stops
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _spawn(module: str, *parameters: str) -> Popen[bytes]:
    """Start a node in a session of its own, where no Ctrl-C of the terminal reaches it."""
    arguments = [word for parameter in parameters for word in ("-p", parameter)]
    return Popen([sys.executable, "-m", module, "--ros-args", *arguments], start_new_session=True)


def _wait(process: Popen[bytes], needed: list[Popen[bytes]], stops: list[int]) -> str:
    """Wait until `process` has ended well; what went wrong if it has not, else an empty string."""
    while process.poll() is None:
        if stops:
            return f"ended by {signal.Signals(stops[0]).name}"
        for other in needed:
            if other.poll() is not None:
                return f"{_module(other)} ended too early, with exit code {other.returncode}"
        time.sleep(0.02)
    code = process.returncode
    return f"{_module(process)} failed with exit code {code}" if code else ""


def _module(process: Popen[bytes]) -> str:
    """The module that `_spawn` started it with."""
    words = process.args
    return str(words[2]) if isinstance(words, list) else ""


def _end(processes: list[Popen[bytes]]) -> None:
    """End all by their process ids: SIGINT, for the listener (the first) when the others ended."""
    _end_by(processes[1:], time.monotonic() + END_S)
    _end_by(processes[:1], time.monotonic() + LISTENER_S)


def _end_by(processes: list[Popen[bytes]], deadline_s: float) -> None:
    for process in processes:
        process.send_signal(signal.SIGINT)
    for process in processes:
        try:
            process.wait(max(0.0, deadline_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
