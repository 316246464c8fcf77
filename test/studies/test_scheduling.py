"""Experiments on several processes and on a Dask cluster, and what survives a kill."""

import json
import os
import re
import signal
import socket
import sys
import time
from pathlib import Path

import pytest
import small_experiment
from patience import PATIENCE_S

from msg_defs.errors import InputError
from multi_robot_slam.studies import experiments, scheduling

SCRIPT = Path(small_experiment.__file__)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The table of the small experiment, done in one go in this process."""
    folder = tmp_path_factory.mktemp("reference")
    base = small_experiment.base()
    experiments.run(small_experiment.wanted(), base, folder, small_experiment.serially)
    return small_experiment.untimed(folder / "table.csv")


def rows(folder):
    path = folder / "table.csv"
    return path.read_text().count("\n") - 1 if path.exists() else 0


def wait_for(condition):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def children(pid):
    return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_running(pid):
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != "Z"


def test_killed_experiment_goes_on_and_gives_the_same_table(spawn, tmp_path, reference):
    process = spawn(sys.executable, SCRIPT, tmp_path)
    wait_for(lambda: rows(tmp_path) > 0)
    workers = children(process.pid)
    process.kill()
    assert len(workers) >= 2
    wait_for(lambda: not any(map(is_running, workers)))
    kept = (tmp_path / "table.csv").read_text().splitlines()
    assert 0 < rows(tmp_path) < len(reference)

    done = []

    def counted(function, jobs):
        done.extend(trial for job in jobs for trial in job.trials)
        return small_experiment.serially(function, jobs)

    experiments.run(small_experiment.wanted(), small_experiment.base(), tmp_path, counted)
    assert small_experiment.untimed(tmp_path / "table.csv") == reference
    assert set(kept) <= set((tmp_path / "table.csv").read_text().splitlines())
    assert len(done) == len(reference) - (len(kept) - 1)


def test_local_processes_use_one_thread_each(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    ((name, value),) = scheduling.local(os.getenv, ["OMP_NUM_THREADS"], processes=1)
    assert (name, value) == ("OMP_NUM_THREADS", "1")
    assert os.environ["OMP_NUM_THREADS"] == "7"


def test_worker_that_dies_is_told_in_a_line():
    with pytest.raises(InputError, match="goes on where it stopped"):
        list(scheduling.local(os._exit, [1], processes=1))


@pytest.fixture
def start_dask(spawn, tmp_path):
    pytest.importorskip("distributed")

    def start(kind, *arguments):
        command = (sys.executable, "-m", f"distributed.cli.dask_{kind}", *arguments)
        with open(tmp_path / "dask.log", "a") as log:
            return spawn(*command, "--host", "127.0.0.1", stdout=log, stderr=log)

    return start


@pytest.fixture
def scheduler(start_dask, tmp_path):
    """The address of a scheduler in a process of its own."""
    file = tmp_path / "scheduler.json"
    options = ("--port", "0", "--dashboard-address", "127.0.0.1:0", "--scheduler-file", file)
    start_dask("scheduler", *options)
    wait_for(lambda: file.exists() and file.read_text().endswith("}"))
    return json.loads(file.read_text())["address"]


def test_cluster_that_loses_a_worker_gives_the_same_table(
    spawn, start_dask, scheduler, tmp_path, reference
):
    options = ("--no-nanny", "--nthreads", "1", "--no-dashboard")
    options += ("--local-directory", tmp_path)
    workers = [start_dask("worker", scheduler, *options) for _ in range(2)]
    folder, log = tmp_path / "out", tmp_path / "dask.log"
    wait_for(lambda: len(re.findall("Registered to", log.read_text())) == 2)
    process = spawn(sys.executable, SCRIPT, folder, scheduler)
    wait_for(lambda: rows(folder) > 0)
    workers[0].send_signal(signal.SIGKILL)
    assert rows(folder) < len(reference)
    assert process.wait(PATIENCE_S) == 0
    assert workers[1].poll() is None
    workers[1].kill()  # its goodbye to the scheduler would take seconds
    assert small_experiment.untimed(folder / "table.csv") == reference


def refused(command, tmp_path, address):
    words = ("study", "experiment", "fig3", "--out", tmp_path / "out", "--scheduler", address)
    code, _, err = command(*words)
    assert (code, err.count("\n")) == (2, 1), err
    return err


def test_scheduler_without_workers_is_refused(command, scheduler, tmp_path, monkeypatch):
    monkeypatch.setattr(scheduling, "CONNECT_S", 1.0)
    assert "no workers" in refused(command, tmp_path, scheduler)


def test_scheduler_that_is_not_there_is_refused(command, tmp_path):
    pytest.importorskip("distributed")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound and deaf: nobody else can listen there
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        assert f"no Dask scheduler at {address}" in refused(command, tmp_path, address)


@pytest.mark.parametrize("address", ["nonsense", "tcp://", "udp://127.0.0.1:1", "127.0.0.1:1"])
def test_address_that_is_none_is_refused(command, tmp_path, address):
    assert "tcp://host:port" in refused(command, tmp_path, address)
