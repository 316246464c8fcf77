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


def main() -> None:
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    options = parse_arguments()
    os.environ.setdefault("ROS_DOMAIN_ID", str(random.randint(1, 101)))
    print("ROS_DOMAIN_ID is", os.environ["ROS_DOMAIN_ID"])
    options.out.mkdir(parents=True)
    team = options.out / "team.yaml"
    with team.open("w") as file:
        words = ("team", "--scenario", options.scenario, "--robots", str(options.robots))
        subprocess.run([sys.executable, "-m", "sim_world.cli", *words], stdout=file, check=True)
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
    return parser.parse_args()


@contextmanager
def node(module: str, *parameters: str):
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
