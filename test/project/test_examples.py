import subprocess
import sys
from pathlib import Path

import pytest
import recordings

from msg_defs import wire
from multi_robot_slam.bags import BagReader

EXAMPLES = Path(__file__).parents[2] / "examples"


def test_the_readme_names_every_example():
    readme = (EXAMPLES / "README.md").read_text()
    for example in EXAMPLES.glob("*.py"):
        assert f"examples/{example.name}" in readme


def test_replay_bag_tells_where_the_robots_are(tmp_path):
    recordings.record(tmp_path / "bag")
    told = subprocess.check_output(
        [sys.executable, EXAMPLES / "replay_bag.py", tmp_path / "bag"], text=True, timeout=60
    )
    first, second, landmarks = told.splitlines()
    assert first.startswith("robot_1: 21 poses, ")
    assert second.startswith("robot_2: 21 poses, ")
    assert int(landmarks.split()[0]) > 20


def test_spawn_team_leaves_a_complete_bag(spawn, tmp_path):
    pytest.importorskip("rclpy")
    scenario = tmp_path / "small.yaml"
    scenario.write_text(
        "sim_world: {movements: 60, observations: 5}\nmulti_robot_slam: {filter: {particles: 20}}\n"
    )
    out = tmp_path / "out"
    options = ("--scenario", scenario, "--robots", "2", "--speed", "0")
    process = spawn(
        *(sys.executable, EXAMPLES / "spawn_team.py", out, *options),
        stderr=subprocess.PIPE,
        text=True,
    )
    _, said = process.communicate(timeout=60)
    assert process.returncode == 0, said

    bag = BagReader(out / "bag")
    assert bag.warnings == []
    recorded = {}
    for record in bag:
        recorded.setdefault(record.topic, []).append(record.data)
    for robot in ("robot_1", "robot_2"):
        assert len(recorded[f"/{robot}/odom"]) == 31
        assert len(recorded[f"/{robot}/pose"]) == 31
        assert len(wire.decode_path(recorded[f"/{robot}/path"][-1], robot).poses) == 31
    _, (filter_status, *_) = wire.decode_diagnostics(recorded["/diagnostics"][-1])
    assert filter_status.values["steps"] == "31"
    assert not any(key.startswith("dropped") for key in filter_status.values)
