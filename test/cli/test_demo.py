"""The demo as a user starts it: real processes, real DDS."""

import json
import os
import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from patience import PATIENCE_S

from msg_defs import scenario_file, topics, wire
from multi_robot_slam.bags import BagReader
from multi_robot_slam.cli import processes, simulated
from multi_robot_slam.cli.maps import FILE
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.front_end.settings import DESCRIPTOR_GATE
from multi_robot_slam.pipeline import map_files
from multi_robot_slam.watch import address
from sim_world import cli as sim_world_cli
from sim_world.scenario import SECTION as WORLD_SECTION
from sim_world.scenario import Scenario

nodes = pytest.importorskip("nodes")

SMALL = "{robots: 3, movements: 90, observations: 5, camera: {mount: {up_m: 0.7}}}"
FEW = "multi_robot_slam: {filter: {particles: 20}}"


@pytest.fixture
def start(spawn, tmp_path):
    """Start a demo of a scenario's section `sim_world`, with its results in `tmp_path/out`."""

    def command(world, *options, **environment):
        scenario = tmp_path / "given.yaml"
        scenario.write_text(f"sim_world: {world}\n{FEW}\n")
        words = ("--scenario", scenario, "--out", tmp_path / "out", *options)
        return spawn(
            *(sys.executable, "-m", "multi_robot_slam.cli", "demo", *words),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | environment,
        )

    return command


def recorded(bag):
    """Topic -> data of its messages, from a bag that is whole."""
    reader = BagReader(bag)
    assert reader.warnings == []
    messages = {}
    for record in reader:
        messages.setdefault(record.topic, []).append(record.data)
    return messages


def alive(folder):
    """Processes that were told of `folder` on their command line."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            command = path.read_bytes()
        except OSError:
            continue
        if os.fsencode(folder) in command:
            found.append(command.replace(b"\0", b" "))
    return found


def test_no_message_is_missing_in_the_bag_or_in_the_steps(start, tmp_path):
    process = start(SMALL, "--seed", "7", "--speed", "0")
    printed, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    out = tmp_path / "out"
    messages = recorded(out / "bag")
    expected = [1_000_000_000 + 500_000_000 * i for i in range(31)]
    steps = [wire.decode_step(data) for data in messages["/fusion/steps"]]
    assert [step.stamp_ns for step in steps] == expected
    for robot in ("robot_1", "robot_2", "robot_3"):
        odometry = [wire.decode_pose(d, robot).stamp_ns for d in messages[f"/{robot}/odom"]]
        clouds = messages[f"/{robot}/stereo/landmarks"]
        seen = [wire.decode_observations(data, robot) for data in clouds]
        assert odometry == [frame.stamp_ns for frame in seen] == expected
        assert len(messages[f"/{robot}/ground_truth"]) == len(expected)
        assert len(messages[f"/{robot}/stereo/truth"]) == len(expected)
        filtered = [f for step in steps for f in step.frames if f.robot == robot]
        assert [len(f.landmarks) for f in filtered] == [len(f.positions) for f in seen]

    assert "team" in printed
    assert printed.splitlines()[-1] == str(out / "report.html")
    assert "step 31, 3 robots, " in said
    result = json.loads((out / "result.json").read_text())
    assert (result["steps"], result["seed"], result["dropped"]) == (31, 7, {})
    assert result["scenario"] == str(tmp_path / "given.yaml")
    wanted = {"scenario.yaml", "config.yaml", "map.csv", "map.png", "errors.png", "report.html"}
    assert wanted <= {path.name for path in out.iterdir()}
    config = scenario_file.from_file(Config, out / "config.yaml", SECTION)
    assert config.mount.up_m == 0.7
    assert config.filter.particles == 20


def test_places_that_nobody_told_are_found_also_in_the_map_of_another_day(start, tmp_path):
    alike = "{robots: 2, movements: 200}"
    process = start(alike, "--unknown-starts", "--speed", "0")
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    assert "the place of robot_2 in map is known from now on" in said
    first, out = tmp_path / "first", tmp_path / "out"
    out.rename(first)
    config = scenario_file.from_file(Config, first / "config.yaml", SECTION)
    assert config.are_known.tolist() == [True, False]

    process = start(alike, "--map", first / "map", "--speed", "0", "--seed", "1")
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    for robot in ("robot_1", "robot_2"):
        assert f"the place of {robot} in map is known from now on" in said
    starts = [(folder / "truth_robot_1.tum").read_text().split()[1:3] for folder in (first, out)]
    assert starts[0] != starts[1]
    before, after = (map_files.read(folder / FILE).kept for folder in (first, out))
    assert np.isin(before.ids, after.ids).mean() > 0.5
    assert after.observations.sum() > 1.5 * before.observations.sum()


def served(where):
    try:
        with urllib.request.urlopen(where, timeout=PATIENCE_S) as answer:
            return b"<html" in answer.read()
    except urllib.error.URLError:
        return False


def test_the_page_is_there_from_the_beginning_to_the_end(start):
    process = start(SMALL, "--speed", "5")
    first = process.stdout.readline()
    where = re.fullmatch(r"Watch it at (http://127\.0\.0\.1:\d+)\n", first)[1]
    nodes.wait_until(lambda: served(where) or process.poll() is not None)
    assert served(where)
    for line in process.stdout:
        if "Figures of merit" in line:
            assert served(where)
    assert process.wait(PATIENCE_S) == 0, process.stderr.read()
    assert not served(where)


def test_there_is_no_page_if_none_is_wanted_and_the_results_are_the_same(start, tmp_path):
    process = start(SMALL, "--speed", "0", "--no-watch")
    printed, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    assert "http://" not in printed + said
    without = (tmp_path / "out" / "trajectory_robot_1.tum").read_bytes()
    (tmp_path / "out").rename(tmp_path / "without")
    process = start(SMALL, "--speed", "0")
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    assert (tmp_path / "out" / "trajectory_robot_1.tum").read_bytes() == without


def test_without_viser_the_demo_goes_on(monkeypatch, capfd):
    monkeypatch.setattr(address, "find_spec", lambda name: None)
    with processes.watching():
        pass
    said = capfd.readouterr()
    assert "no page to watch it: no module 'viser'" in said.err
    assert said.out == ""


def test_a_generated_bag_holds_what_a_recorded_one_does(start, tmp_path, program):
    process = start(SMALL, "--seed", "7", "--speed", "0")
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    given, bag = tmp_path / "given.yaml", tmp_path / "generated"
    words = ("--scenario", given, "--seed", "7", "--out", bag)
    assert program(sim_world_cli, "generate", *words)[0] == 0
    played, generated = recorded(tmp_path / "out" / "bag"), recorded(bag)
    assert len(generated) == 4 + 4 * 3
    for topic, messages in generated.items():
        # DDS fills up messages with zeros to a multiple of four bytes.
        filled = [data + bytes(-len(data) % 4) for data in messages]
        assert [data + bytes(-len(data) % 4) for data in played[topic]] == filled, topic


LONG = "{robots: 2, movements: 2000, observations: 5}"


@pytest.mark.parametrize(
    ("number", "send", "when"),
    [
        (signal.SIGINT, os.kill, "effective particles"),
        (signal.SIGINT, os.killpg, "effective particles"),
        (signal.SIGTERM, os.kill, "publishing"),
        (signal.SIGTERM, os.kill, "ready for"),
    ],
)
def test_a_signal_ends_every_process(start, tmp_path, number, send, when):
    process = start(LONG)
    nodes.wait_for_line(process, when)
    assert len(alive(tmp_path)) == 4
    send(process.pid, number)
    _, said = process.communicate(timeout=PATIENCE_S)
    assert alive(tmp_path) == []
    assert process.returncode == 1
    bag = tmp_path / "out" / "bag"
    assert said.endswith(f"error: ended by {number.name}; what was recorded so far is in {bag}\n")
    messages = recorded(bag)
    if when == "effective particles":
        odometry = messages[f"/{topics.odometry('robot_1').name}"]
        assert len(odometry) >= len(messages["/fusion/steps"]) > 0


def test_a_process_that_fails_ends_the_demo(start, tmp_path):
    process = start(SMALL, RMW_IMPLEMENTATION="rmw_of_no_kind")
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 1
    assert "exit code" in said.splitlines()[-1]
    assert said.splitlines()[-1].startswith("error: ")
    assert ("recorded so far is in" in said) == (tmp_path / "out" / "bag").exists()
    assert alive(tmp_path) == []


@pytest.mark.parametrize(
    ("scenario", "told"),
    [
        ("sim_world: {robots: 0}", "robots = 0"),
        ("sim_world: {d_max_m: -1}", "d_max_m = -1"),
        ("multi_robot_slam: {particels: 9}", "unknown key 'particels'"),
        ("multi_robot_slam: 5", "section 'multi_robot_slam' is 5"),
        ("sim_world: {descriptor_database: nowhere.npz}", "nowhere.npz"),
        ("sim_world: {robots: 3, movements: 2}", "movements = 2"),
    ],
)
def test_bad_scenario_is_one_line_and_leaves_nothing(tmp_path, scenario, told, command):
    given = tmp_path / "given.yaml"
    given.write_text(scenario)
    code, out, err = command("demo", "--scenario", given, "--out", tmp_path / "out")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("error: ")
    assert told in err
    assert not (tmp_path / "out").exists()


def test_a_map_that_is_none_is_refused_before_anything_starts(tmp_path, command):
    (tmp_path / "empty").mkdir()
    for named, told in (("no", "no file"), ("empty", "holds no map.npz")):
        code, _, err = command("demo", "--map", tmp_path / named, "--out", tmp_path / "out")
        assert (code, err.count("\n")) == (2, 1)
        assert told in err
        assert not (tmp_path / "out").exists()


def test_a_domain_that_ros_does_not_have_is_refused_before_anything_starts(
    tmp_path, monkeypatch, command
):
    monkeypatch.setenv("ROS_DOMAIN_ID", "999")
    code, out, err = command("demo", "--out", tmp_path / "out")
    told = "error: ROS_DOMAIN_ID = '999'; use a whole number from 0 to 232\n"
    assert (code, out, err) == (2, "", told)
    assert not (tmp_path / "out").exists()


def test_configuration_is_whole_and_tells_both_sides_of_one_team(tmp_path):
    given = tmp_path / "given.yaml"
    given.write_text(f"sim_world: {SMALL}")
    text = simulated.to_yaml(*simulated.configure(str(given), robots=2, seed=5))
    world = scenario_file.from_yaml(Scenario, text, WORLD_SECTION)
    config = scenario_file.from_yaml(Config, text, SECTION)
    assert config.robots == world.names == ("robot_1", "robot_2")
    assert config.mount == world.camera.mount
    assert config.seed == 5
    assert "reorder_window_s" in text


SEEING = (
    "{robots: 2, movements: 100, images: {enabled: true}, "
    "camera: {width_px: 320, height_px: 240, focal_px: 250}}"
)


def test_from_pixels_to_a_map_and_a_page_with_pictures(start, tmp_path):
    process = start(SEEING, "--speed", "4")
    printed, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    out = tmp_path / "out"
    messages = recorded(out / "bag")
    for robot in ("robot_1", "robot_2"):
        assert len(messages[f"/{robot}/odom"]) == 51
        clouds = messages[f"/{robot}/stereo/landmarks"]
        stamps = [wire.peek_stamp(data, "cloud") for data in clouds]
        odometry = {wire.peek_stamp(data, "odometry") for data in messages[f"/{robot}/odom"]}
        assert set(stamps) <= odometry  # a busy camera leaves out pairs, also the first
        previews = messages[f"/{robot}/preview/image/compressed"]
        assert [wire.peek_stamp(data, "preview") for data in previews] == stamps
    assert not any("image_rect" in topic for topic in messages)
    steps = [wire.decode_step(data) for data in messages["/fusion/steps"]]
    matched = [f.landmarks[~f.is_new] for step in steps for f in step.frames]
    assert sum(map(len, matched)) > 50
    assert f"descriptor_gate: {DESCRIPTOR_GATE}" in (out / "config.yaml").read_text()
    shown = (out / "report.html").read_text()
    assert 'data-sight="robot_2"' in shown
    assert "team" in printed
