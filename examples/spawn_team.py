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
from contextlib import contextmanager
from pathlib import Path

FUSION_S = 300
"""Longest time the fusion may take after the robots have ended."""
END_S = 5
"""Longest time a process may take to end after SIGINT."""


def main() -> None:
    options = parse_arguments()
    os.environ.setdefault("ROS_DOMAIN_ID", str(random.randint(1, 101)))
    print("ROS_DOMAIN_ID is", os.environ["ROS_DOMAIN_ID"])
    options.out.mkdir(parents=True)
    team = options.out / "team.yaml"
    with team.open("w") as file:
        arguments = ("--scenario", options.scenario, "--robots", str(options.robots))
        python("sim_world.cli", "team", *arguments, stdout=file).wait()
    # Each input has two subscribers, recorder and fusion; only the recorder wants the truth.
    counts = ("subscribers:=2", "truth_subscribers:=1")
    names = ", ".join(f"robot_{i + 1}" for i in range(options.robots))
    with (
        node("multi_robot_slam.recorder", f"out:={options.out / 'bag'}", f"robots:=[{names}]") as r,
        node("multi_robot_slam.fusion", f"scenario:={team}", "stop_after_s:=2.0") as fusion,
        node("sim_world.robots", f"scenario:={team}", f"speed:={options.speed}", *counts) as robots,
    ):
        wait(robots, needed=[r, fusion])
        wait(fusion, needed=[r], timeout_s=FUSION_S)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder to write; it must not exist yet")
    parser.add_argument("--scenario", default="calibrated", help="a YAML file, or a name")
    parser.add_argument("--robots", type=int, default=3, help="number of robots")
    parser.add_argument("--speed", type=float, default=5.0, help="times real time; 0: at once")
    return parser.parse_args()


def python(module: str, *arguments: str, **options) -> subprocess.Popen:
    # In a session of its own, a Ctrl-C reaches this script alone, which then ends the nodes.
    command = [sys.executable, "-m", module, *arguments]
    return subprocess.Popen(command, start_new_session=True, **options)


@contextmanager
def node(module: str, *parameters: str):
    process = python(module, "--ros-args", *(word for p in parameters for word in ("-p", p)))
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()


def wait(process: subprocess.Popen, needed: list, timeout_s: float = float("inf")) -> None:
    """Wait until `process` has ended well; exit if it has not, or if a `needed` one ends before."""
    deadline = time.monotonic() + timeout_s
    while process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
        if any(other.poll() is not None for other in needed):
            break
    if process.poll() != 0:
        sys.exit(f"{process.args[2]} did not come to its end")


if __name__ == "__main__":
    main()
