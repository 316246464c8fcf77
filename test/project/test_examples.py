import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import recordings
from patience import PATIENCE_S

from msg_defs import wire
from multi_robot_slam.bags import BagReader

PACKAGE = "multi_robot_slam"
EXAMPLES = Path(__file__).parents[2] / "examples"


def test_the_readme_names_every_example():
    readme = (EXAMPLES / "README.md").read_text()
    for example in EXAMPLES.glob("*.py"):
        assert f"examples/{example.name}" in readme


def test_replay_bag_tells_where_the_robots_are(tmp_path):
    recordings.record(tmp_path / "bag")
    told = subprocess.check_output(
        [sys.executable, EXAMPLES / "replay_bag.py", tmp_path / "bag"],
        text=True,
        timeout=PATIENCE_S,
    )
    first, second, landmarks = told.splitlines()
    assert first.startswith("robot_1: 21 poses, ")
    assert second.startswith("robot_2: 21 poses, ")
    assert int(landmarks.split()[0]) > 20


def test_own_data_finds_the_robots_and_the_posters():
    told = subprocess.check_output(
        [sys.executable, EXAMPLES / "own_data.py"], text=True, timeout=PATIENCE_S
    )
    ends = re.findall(r"^(\w+) ends at x = (\S+) m, y = (\S+) m", told, re.MULTILINE)
    assert [(name, float(x), float(y)) for name, x, y in ends] == [
        ("alice", pytest.approx(2.0, abs=0.03), pytest.approx(0.0, abs=0.03)),
        ("bob", pytest.approx(2.5, abs=0.03), pytest.approx(0.0, abs=0.03)),
    ]
    assert told.count("a poster at") == 3


@pytest.mark.parametrize("example", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.stem)
def test_an_example_needs_no_import_but_of_the_package_itself(example):
    ours = {
        node.module if isinstance(node, ast.ImportFrom) else alias.name
        for node in ast.walk(ast.parse(example.read_text()))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    assert {name for name in ours if name.startswith(("multi", "sim", "msg"))} <= {PACKAGE}


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("replay_bag.py",), "name the bag"),
        (("replay_bag.py", "nowhere"), "no bag nowhere"),
        (("replay_bag.py", "."), "no .mcap file"),
        (("spawn_team.py", "taken"), "File exists"),
        (("spawn_team.py", "new", "--scenario", "nowhere"), "no scenario 'nowhere'"),
        (("spawn_team.py", "new", "--speed", "nan"), "--speed nan"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, words, told):
    (tmp_path / "taken").mkdir()
    result = subprocess.run(
        [sys.executable, EXAMPLES / words[0], *words[1:]],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert (result.returncode, result.stderr.count("\n")) == (2, 1), result.stderr
    assert result.stderr.startswith("error: ")
    assert told in result.stderr
    assert not (tmp_path / "new").exists()


def test_spawn_team_refuses_a_domain_that_ros_does_not_have(tmp_path):
    result = subprocess.run(
        [sys.executable, EXAMPLES / "spawn_team.py", tmp_path / "new"],
        env=os.environ | {"ROS_DOMAIN_ID": "999"},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    told = "error: ROS_DOMAIN_ID = '999'; use a whole number from 0 to 232\n"
    assert (result.returncode, result.stdout, result.stderr) == (2, "", told)
    assert not (tmp_path / "new").exists()


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
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said

    bag = BagReader(out / "bag")
    assert bag.warnings == []
    recorded = {}
    for record in bag:
        recorded.setdefault(record.topic, []).append(record.data)
    for robot in ("robot_1", "robot_2"):
        assert len(recorded[f"/{robot}/odom"]) == 31
        poses = [wire.decode_estimate(data, robot) for data in recorded[f"/{robot}/pose"]]
        assert len({pose.stamp_ns for pose in poses}) == 31
        assert len(wire.decode_path(recorded[f"/{robot}/path"][-1], robot).poses) == 31
    _, (filter_status, *_) = wire.decode_diagnostics(recorded["/diagnostics"][-1])
    assert filter_status.values["steps"] == "31"
    assert not any(key.startswith("dropped") for key in filter_status.values)
