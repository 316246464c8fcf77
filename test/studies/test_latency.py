"""Latency from arrivals: what is waited for, and what a stopwatch writes down."""

import subprocess
import sys

import numpy as np
import pytest
from patience import PATIENCE_S

from msg_defs import topics, wire
from msg_defs.errors import InputError
from multi_robot_slam.studies import latency

MS = 1_000_000
ODOM, CLOUD, POSE, MEAN = (
    kind("robot_1").name
    for kind in (topics.odometry, topics.observations, topics.pose, topics.mean_pose)
)


def written(tmp_path, *rows):
    path = tmp_path / "arrivals.csv"
    path.write_text("topic,stamp_ns,arrived_ns\n" + "".join(f"{t},{s},{a}\n" for t, s, a in rows))
    return latency.read(path)


def test_a_step_counts_from_the_cloud_to_its_pose_and_a_prediction_from_the_odometry(tmp_path):
    arrivals = written(
        tmp_path,
        *[(ODOM, 1, 10 * MS), (POSE, 1, 11 * MS), (CLOUD, 1, 12 * MS)],  # predicted at first
        *[(POSE, 1, 19 * MS), (MEAN, 1, 20 * MS)],
        *[(ODOM, 2, 110 * MS), (POSE, 2, 113 * MS), (CLOUD, 2, 112 * MS)],
        *[(ODOM, 3, 210 * MS), (CLOUD, 3, 212 * MS)],
    )
    found = latency.latencies(arrivals, ["robot_1"])
    assert found.steps.tolist() == [7.0]
    assert found.predictions.tolist() == [3.0]
    assert found.unanswered == 1


def test_figures_are_those_of_the_order_and_each_has_its_target():
    values = np.arange(1.0, 102.0)
    assert latency.figures(values) == {"median": 51.0, "99 %": 100.0, "longest": 101.0}
    found = latency.Latencies(np.array([6.0, 6.0]), np.array([1.0]), 4)
    text = latency.markdown(found)
    assert "| cloud to the pose of its step | 2 | 6.0 (<= 5, **no**) | 6.0 (<= 30) |" in text
    assert "stamp: 4." in text


@pytest.mark.parametrize(
    "text", ["", "topic,stamp_ns\na,1\n", "topic,stamp_ns,arrived_ns\na,1,x\n"]
)
def test_what_no_stopwatch_wrote_is_refused(tmp_path, text):
    path = tmp_path / "arrivals.csv"
    path.write_text(text)
    with pytest.raises(InputError):
        latency.latencies(latency.read(path), ["robot_1"])


def test_live_robots_are_timed(spawn, tmp_path):
    pytest.importorskip("rclpy")
    scenario = tmp_path / "small.yaml"
    scenario.write_text(
        "sim_world: {robots: 2, movements: 20, observations: 5}\n"
        "multi_robot_slam: {keyframe: {distance_m: 4.0, yaw_rad: 4.0}, filter: {particles: 20}}\n"
    )
    words = ("--scenario", scenario, "--robots", 2, "--rate", 5, "--out", tmp_path / "out")
    command = (sys.executable, "-m", "multi_robot_slam.cli", "study", "latency", *words)
    process = spawn(*command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    printed, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, said
    out = tmp_path / "out"
    assert (out / "latency.md").read_text() in printed
    arrivals = latency.read(out / "arrivals.csv")
    found = latency.latencies(arrivals, ["robot_1", "robot_2"])
    clouds = [len(arrivals[topics.observations(name).name]) for name in ("robot_1", "robot_2")]
    assert clouds == [26, 26]
    assert len(found.steps) + len(found.predictions) + found.unanswered == 52
    assert len(found.steps) == len(arrivals[MEAN]) + len(arrivals["robot_2/mean_pose"])
    assert found.steps.min() > 0
    assert found.predictions.min() > 0
    assert found.unanswered == 0


def test_a_stopwatch_writes_the_clock_of_each_arrival(ros_domain_id, tmp_path):
    nodes = pytest.importorskip("nodes")
    from msg_defs.types import PoseSample
    from multi_robot_slam.nodes.stopwatch import Stopwatch

    out, clock = tmp_path / "arrivals.csv", iter([100, 70])
    with nodes.ros("-p", f"out:={out}", "-p", "robots:=[robot_1]"):
        stopwatch = Stopwatch(lambda: next(clock))
        for stamp in (5, 6):
            pose = PoseSample("robot_1", stamp, np.zeros(3))
            stopwatch._note(ODOM, wire.encode_pose(pose, "odom", "base"))
        stopwatch.close()
        stopwatch.destroy_node()
    assert latency.read(out) == {ODOM: {5: 100, 6: 70}}
