"""What every test runs under, and the fixtures that start and end processes."""

import contextlib
import fcntl
import functools
import itertools
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import hypothesis
import pytest

# Before anything imports matplotlib or rclpy. Without field checks a value of the wrong Python
# type corrupts a message silently.
os.environ["MPLBACKEND"] = "Agg"
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

hypothesis.settings.register_profile("project", deadline=None, derandomize="CI" in os.environ)
hypothesis.settings.load_profile("project")

DOMAIN_IDS = range(1, 102)
"""The ROS domain ids whose ports lie below Linux's ephemeral ones."""

_rotation = itertools.count(os.getpid())


@pytest.fixture
def ros_domain_id(monkeypatch):
    """A ROS domain id of the test's own, set as ROS_DOMAIN_ID and locked against other runs."""
    folder = Path(tempfile.gettempdir(), f"ros_domain_ids_{os.getuid()}")
    folder.mkdir(exist_ok=True)
    for _ in DOMAIN_IDS:
        domain_id = DOMAIN_IDS[next(_rotation) % len(DOMAIN_IDS)]
        with open(folder / str(domain_id), "w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            monkeypatch.setenv("ROS_DOMAIN_ID", str(domain_id))
            yield domain_id
            return
    pytest.fail(f"all ROS domain ids are in use: see {folder}")


@pytest.fixture
def program(monkeypatch, capfd):
    """Run a command in this process: `program(cli, word, ...) -> (exit code, stdout, stderr)`."""

    def run(cli, *words):
        monkeypatch.setattr(sys, "argv", [cli.__name__.partition(".")[0], *map(str, words)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return end.value.code or 0, *capfd.readouterr()

    return run


@pytest.fixture
def command(program):
    """Run `multi_robot_slam`: `command(word, ...) -> (exit code, stdout, stderr)`."""
    from multi_robot_slam.cli import main as cli

    return functools.partial(program, cli)


@pytest.fixture(scope="session")
def shared_data():
    """Folder of the real recordings, which are not part of the repository."""
    beside = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("MULTI_ROBOT_SLAM_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"recordings not found at {folder}; MULTI_ROBOT_SLAM_DATA names their folder")
    return folder


@pytest.fixture
def spawn(ros_domain_id):
    """Start a process in the test's ROS domain: `spawn("command", "argument", ...) -> Popen`.

    Whatever still runs at the end of the test is ended, its children included.
    """
    processes = []

    def start(*command, **options):
        words = [str(word) for word in command]
        process = subprocess.Popen(words, start_new_session=True, **options)
        processes.append(process)
        return process

    yield start
    for process in processes:
        _signal_group(process, signal.SIGTERM)
    for process in processes:
        _end(process)


def _end(process, grace_s=5.0):
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(grace_s)
    _signal_group(process, signal.SIGKILL)
    process.wait()
    for pipe in (process.stdin, process.stdout, process.stderr):
        if pipe:
            pipe.close()


def _signal_group(process, number):
    # The group outlives its leader while children run, and its id is the leader's.
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)
