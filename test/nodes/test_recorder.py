import errno
import resource
import signal
import subprocess
import sys

import pytest
import recordings

from msg_defs import topics, wire
from multi_robot_slam.bags import BagReader, BagWriter, absolute
from sim_world.scenario import Scenario
from sim_world.simulator import Simulation
from sim_world.team import team_scenario

nodes = pytest.importorskip("nodes")
recorder = pytest.importorskip("multi_robot_slam.nodes.recorder")

pytestmark = pytest.mark.usefixtures("ros_domain_id")

ODOMETRY = topics.odometry("robot_1")


def module(name, *parameters):
    words = [word for parameter in parameters for word in ("-p", parameter)]
    return sys.executable, "-m", name, "--ros-args", *words


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_nothing_is_lost_at_full_speed(spawn, tmp_path, end):
    scenario = Scenario(robots=2, movements=400, observations=10)
    # The robots are there first: what they latched must be recorded all the same.
    robots = spawn(
        *module(
            "sim_world.robots",
            *("robots:=2", "movements:=400", "observations:=10"),
            *("speed:=0.0", "truth_subscribers:=1"),
        ),
        stderr=subprocess.PIPE,
        text=True,
    )
    nodes.wait_for_line(robots, "waiting for subscribers")
    bag = tmp_path / "bag"
    process = spawn(
        *module("multi_robot_slam.nodes.recorder", f"out:={bag}", "robots:=[robot_1,robot_2]")
    )
    robots.communicate(timeout=nodes.PATIENCE_S)
    process.send_signal(end)
    assert process.wait(nodes.PATIENCE_S) == 0

    reader = BagReader(bag)
    assert reader.warnings == []
    recorded = {}
    for record in reader:
        recorded.setdefault(record.topic, []).append(record.data)
    for topic in (topics.GROUND_TRUTH_LANDMARKS, topics.GROUND_TRUTH_WALLS, topics.WORLD_CONFIG):
        assert len(recorded[absolute(topic.name)]) == 1
    for step in zip(*Simulation(scenario, seed=0).steps(), strict=True):
        name = step[0].odometry.robot
        assert recorded[f"/{name}/stereo/landmarks"] == [
            recordings.padded(wire.encode_observations(s.observations)) for s in step
        ]
        assert recorded[f"/{name}/stereo/truth"] == [
            recordings.padded(wire.encode_observation_truth(s.observation_truth)) for s in step
        ]
        odom, base = topics.odom_frame(name), topics.base_frame(name)
        assert recorded[f"/{name}/odom"] == [
            recordings.padded(wire.encode_pose(s.odometry, odom, base)) for s in step
        ]
        assert recorded[f"/{name}/ground_truth"] == [
            recordings.padded(wire.encode_pose(s.truth, topics.MAP_FRAME, base)) for s in step
        ]


def endless(speed):
    """Two robots that explore for longer than any test lasts."""
    world = "robots:=2", "movements:=20000", "landmarks:=100", "period_s:=0.1"
    return module("sim_world.robots", *world, f"speed:={speed}")


def wait_for_size(bag, size):
    """Wait until the recorded file has so many bytes."""
    nodes.wait_until(lambda: any(f.stat().st_size > size for f in bag.glob("*.mcap")))


def test_a_killed_recorder_leaves_all_that_it_has_written(spawn, tmp_path, command):
    bag = tmp_path / "bag"
    process = spawn(
        *module("multi_robot_slam.nodes.recorder", f"out:={bag}", "robots:=[robot_1,robot_2]")
    )
    spawn(*endless(speed=2.0), stderr=subprocess.DEVNULL)
    wait_for_size(bag, 1_000_000)
    written = [record.data for record in BagReader(bag)]
    process.kill()
    process.wait()
    reader = BagReader(bag)
    assert [record.data for record in reader][: len(written)] == written != []
    for name in ("robot_1", "robot_2"):
        odometry = [r.data for r in reader if r.topic == f"/{name}/odom"]
        stamps = [wire.decode_pose(data, name).stamp_ns for data in odometry]
        assert stamps == [10**9 + i * 10**8 for i in range(len(stamps))]
        assert len(stamps) > 10

    count = reader.summary.message_count
    scenario = tmp_path / "team.yaml"
    scenario.write_text(team_scenario("calibrated", 2) + "  filter: {particles: 5}\n")
    code, _, said = command("run", bag, "--scenario", scenario, "--out", tmp_path / "out")
    assert code == 0, said
    assert (
        f"breaks off: its recorder was killed or failed, or it was cut; {count} messages over"
        in " ".join(said.split())
    )


def test_a_full_disk_ends_the_recording_with_one_line_and_exit_code_1(spawn, tmp_path):
    """The file may grow no further, which is the same to the recorder as a disk that is full."""
    bag, most = tmp_path / "bag", 400_000
    process = spawn(
        *module("multi_robot_slam.nodes.recorder", f"out:={bag}", "robots:=[robot_1,robot_2]"),
        stderr=subprocess.PIPE,
        text=True,
    )
    nodes.wait_for_line(process, "recording robot_1, robot_2")
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (most, most))
    spawn(*endless(speed=0.0), stderr=subprocess.DEVNULL)
    _, said = process.communicate(timeout=nodes.PATIENCE_S)
    assert process.returncode == 1
    assert said.count("cannot write") == 1
    assert "Traceback" not in said
    assert "Exception" not in said
    reader = BagReader(bag)
    assert "breaks off" in reader.warnings[0]
    assert 0.5 * most < sum(len(record.data) for record in reader) < most


def test_existing_folder_is_refused_with_exit_code_2(spawn, tmp_path):
    process = spawn(
        *module("multi_robot_slam.nodes.recorder", f"out:={tmp_path}"),
        stderr=subprocess.PIPE,
        text=True,
    )
    _, said = process.communicate(timeout=nodes.PATIENCE_S)
    assert process.returncode == 2
    assert said == f"error: {tmp_path} exists already; remove it or name another bag\n"


def test_a_folder_that_cannot_be_made_is_refused_at_once(spawn, tmp_path):
    (tmp_path / "file").touch()
    process = spawn(
        *module("multi_robot_slam.nodes.recorder", f"out:={tmp_path / 'file' / 'bag'}"),
        stderr=subprocess.PIPE,
        text=True,
    )
    _, said = process.communicate(timeout=nodes.PATIENCE_S)
    assert process.returncode == 2
    assert said == f"error: cannot write the bag {tmp_path / 'file' / 'bag'}: Not a directory\n"


def test_a_name_that_is_no_part_of_a_topic_is_refused_before_the_bag_is_made(spawn, tmp_path):
    process = spawn(
        *module("multi_robot_slam.nodes.recorder", f"out:={tmp_path / 'bag'}", 'robots:=["bo b"]'),
        stderr=subprocess.PIPE,
        text=True,
    )
    _, said = process.communicate(timeout=nodes.PATIENCE_S)
    assert (process.returncode, said.count("\n")) == (2, 1)
    assert "robot name 'bo b'" in said
    assert not (tmp_path / "bag").exists()


def record(tmp_path, *arguments, messages):
    """The bag of a recorder that was sent `messages` (topic, bytes)."""
    with nodes.ros("-p", f"out:={tmp_path / 'bag'}", *arguments):
        recording, sender = recorder.Recorder(), nodes.Listener()
        sender.send(messages)
        nodes.spin_until(lambda: recording.received == len(messages), recording, sender)
        recording.close()
        return recording, list(BagReader(tmp_path / "bag"))


def test_bytes_are_recorded_as_they_are_with_the_topic_they_came_on(tmp_path):
    garbage = b"\0\1\0\0 is no odometry"
    topic = ODOMETRY._replace(name=f"/team/{ODOMETRY.name}")
    _, (written,) = record(tmp_path, "-r", "__ns:=/team", messages=[(topic, garbage)])
    assert (written.topic, written.type, written.data) == (topic.name, topic.type, garbage)


def test_everything_the_fusion_and_the_simulator_say_is_recorded():
    of_robots = [t.name for t in recorder.recorded(("robot_1", "robot_2"))]
    assert len(of_robots) == len(set(of_robots))
    singles = {value for value in vars(topics).values() if isinstance(value, topics.Topic)}
    singles.remove(topics.REFINED_LANDMARKS)  # what `run --refine` finds, which nobody publishes
    assert singles <= set(recorder.recorded(("robot_1",)))
    assert {t.replace("robot_1", "robot_2") for t in of_robots} <= set(of_robots)


def test_full_disk_ends_the_recording_with_one_message(tmp_path, monkeypatch, capfd):
    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(BagWriter, "write", fail)
    recording, _ = record(tmp_path, messages=3 * [(ODOMETRY, b"\0\1\0\0")])
    assert recording.done
    assert recording.exit_code == 1
    assert capfd.readouterr().err.count("No space left on device") == 1
