"""A simulated team, its fusion and a recorder, each a process of its own.

    python examples/spawn_team.py OUT [--scenario FILE] [--robots 3] [--speed 5]

Leaves in the folder OUT: team.yaml, the settings of all nodes, and bag, everything that was said.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import NoReturn


def main() -> None:
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    options = parse_arguments()
    domain = os.environ.setdefault("ROS_DOMAIN_ID", str(random.randint(1, 101))) or "0"
    if not (domain.isdecimal() and int(domain) <= 232):
        refuse(f"ROS_DOMAIN_ID = {domain!r}; use a whole number from 0 to 232")
    if find_spec("rclpy") is None:
        refuse("no module 'rclpy': source ROS 2 Jazzy, or pip install 'multi_robot_slam[ros]'")
    print("ROS_DOMAIN_ID is", domain)
    words = ("team", "--scenario", options.scenario, "--robots", str(options.robots))
    told = subprocess.run(
        [sys.executable, "-m", "sim_world.cli", *words], stdout=subprocess.PIPE, text=True
    )
    if told.returncode:  # it has said why
        sys.exit(told.returncode)
    try:
        options.out.mkdir(parents=True)
    except OSError as error:
        refuse(f"cannot make the folder {options.out}: {error.strerror}; choose another")
    team = options.out / "team.yaml"
    team.write_text(told.stdout)
    # Each input has two subscribers, recorder and fusion; only the recorder wants the truth.
    pace = f"speed:={options.speed}", "subscribers:=2", "truth_subscribers:=1"
    names = ", ".join(f"robot_{i + 1}" for i in range(options.robots))
    what = f"out:={options.out / 'bag'}", f"robots:=[{names}]"
    patience = f"stop_after_s:={2.0 + (2.0 / options.speed if options.speed else 0.0)}"
    with (
        node("multi_robot_slam.nodes.recorder", *what) as recorder,
        node(
            "multi_robot_slam.nodes.fusion", f"scenario:={team}", patience, "subscribers:=1"
        ) as fusion,
        node("sim_world.robots", f"scenario:={team}", *pace) as robots,
    ):
        wait(robots, needed=[recorder, fusion])
        wait(fusion, needed=[recorder], timeout_s=300)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder to write, which must not exist")
    parser.add_argument("--scenario", default="calibrated", help="a YAML file, or a name")
    parser.add_argument("--robots", type=int, default=3, help="number of robots")
    parser.add_argument("--speed", type=float, default=5.0, help="times real time; 0 is at once")
    options = parser.parse_args()
    if not 0 <= options.speed < float("inf"):
        refuse(f"--speed {options.speed}: give a number from 0 on")
    return options


def refuse(reason: str) -> NoReturn:
    print("error:", reason, file=sys.stderr)
    sys.exit(2)


@contextmanager
def node(module: str, *parameters: str) -> Iterator[subprocess.Popen]:
    words = [word for parameter in parameters for word in ("-p", parameter)]
    command = [sys.executable, "-m", module, "--ros-args", *words]
    # Ctrl-C reaches this script alone, which then ends the nodes in their order.
    process = subprocess.Popen(command, start_new_session=True)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            process.kill()


def wait(process: subprocess.Popen, needed: list, timeout_s: float = float("inf")) -> None:
    """Wait until `process` has ended well; exit if it has not, or if a `needed` one ends before."""
    deadline = time.monotonic() + timeout_s
    while process.poll() is None and time.monotonic() < deadline:
        if any(other.poll() is not None for other in needed):
            break
        time.sleep(0.05)
    if process.poll() != 0:
        sys.exit(f"{process.args[2]} did not come to its end")


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit("interrupted")
