"""One bag, the same result: live and offline, now and again, compiled and to the letter."""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import literal_algorithm1 as literal
import numpy as np
import pytest
import recordings
import worlds
from patience import PATIENCE_S

from msg_defs import topics, wire
from msg_defs.types import PoseSample
from multi_robot_slam.bags import BagReader, absolute
from multi_robot_slam.filter import rbpf
from multi_robot_slam.filter.settings import NO_REJUVENATION, ExistenceSettings
from multi_robot_slam.pipeline import offline
from multi_robot_slam.pipeline.pipeline import Pipeline
from sim_world.planar import between
from sim_world.scenario import Scenario

SCENARIO = Scenario(robots=3, observations=8)
STEPS = 12
PAPER = {
    "proposal": "motion",
    "resample_below": 1.0,
    "exclusive": False,
    "particles": 6,
    "rejuvenation": NO_REJUVENATION,
    "existence": ExistenceSettings(published_from=1, gone_below=0.0),
}


def paired(events, names):
    """Steps of one RobotFrame per robot: each cloud with the motion since the robot's last one."""
    events = list(events)
    odometry = {(e.robot, e.stamp_ns): e.pose for e in events if isinstance(e, PoseSample)}
    steps, before = {}, {}
    for seen in (e.decode() for e in events if not isinstance(e, PoseSample)):
        pose = odometry[seen.robot, seen.stamp_ns]
        motion = between(before.get(seen.robot, pose), pose)
        before[seen.robot] = pose
        frame = worlds.frame(names.index(seen.robot), motion, seen)
        steps.setdefault(seen.stamp_ns, []).append(frame)
    return [sorted(steps[stamp], key=lambda frame: frame.robot) for stamp in sorted(steps)]


def test_same_bag_same_associations(tmp_path, monkeypatch):
    _, config = recordings.record(tmp_path / "bag", SCENARIO, steps=STEPS, **PAPER)
    infos = []
    step = rbpf.step
    monkeypatch.setattr(rbpf, "init", partial(rbpf.init, dtype=np.float64))
    monkeypatch.setattr(rbpf, "step", lambda *args: infos.append(step(*args)) or infos[-1])
    pipeline = Pipeline(config)
    records = []
    for event in offline.events(tmp_path / "bag", config):
        records += pipeline.handle(event)
    records += pipeline.finish()

    steps = paired(offline.events(tmp_path / "bag", config), config.robots)
    rng = np.random.default_rng(config.seed)
    S, choices = literal.run(steps, config.start_poses, config.filter, config.mount, rng)

    frames = [frame for info in infos for frame in info.frames]
    origin = {
        int(landmark): (t, robot, b)
        for t, info in enumerate(infos)
        for robot, frame in enumerate(info.frames)
        for b, landmark in enumerate(frame.new_ids)
    }
    assert len(frames) == len(choices) == 3 * STEPS
    for frame, choice in zip(frames, choices, strict=True):
        matched = [[origin[int(i)] for i in column] for column in frame.matches.T]
        assert matched == [[c for c, _, _ in row] for row in choice]
    landmarks = pipeline.landmark_map()
    best = S[literal.best(S)]
    assert [origin[int(i)] for i in landmarks.ids] == [n.origin for n in best.landmarks]
    np.testing.assert_allclose(landmarks.positions, [n.mu for n in best.landmarks], atol=1e-5)
    matched = sum((~frame.is_new).sum() for record in records for frame in record.frames)
    assert matched > 100


EXAMPLES = Path(__file__).parents[2] / "examples"
SMALL = """
sim_world: {movements: 90, observations: 8, landmarks: 300}
multi_robot_slam: {filter: {particles: 50}}
"""


def test_what_was_published_live_is_what_the_bag_gives_offline(spawn, tmp_path):
    """Byte for byte, but for the zeros with which DDS fills up each message."""
    pytest.importorskip("rclpy")
    scenario, out = tmp_path / "small.yaml", tmp_path / "out"
    scenario.write_text(SMALL)
    options = ("--scenario", scenario, "--robots", "2", "--speed", "0")
    assert spawn(sys.executable, EXAMPLES / "spawn_team.py", out, *options).wait(PATIENCE_S) == 0
    published = {}
    for record in BagReader(out / "bag"):
        published.setdefault(record.topic, []).append(record.data)

    run = offline.estimate(out / "bag", offline.recorded_config(out / "bag"), warn=pytest.fail)
    assert len(run.steps) == 46
    for name, robot in run.robots.items():
        estimates = [e for step in run.steps for e in step.estimates if e.robot == name]
        poses = [recordings.padded(wire.encode_estimate(e)) for e in estimates]
        means = [recordings.padded(wire.encode_mean(e)) for e in estimates]
        assert [data for data in published[f"/{name}/pose"] if data in poses] == poses
        assert published[f"/{name}/mean_pose"] == means
        path = wire.encode_path(robot.path, run.steps[-1].stamp_ns)
        assert published[f"/{name}/path"][-1] in (path, recordings.padded(path))
    landmarks = wire.encode_map(run.landmarks, run.steps[-1].stamp_ns)
    assert published["/map/landmarks"][-1] in (landmarks, recordings.padded(landmarks))


def test_three_runs_leave_the_same_bytes(command, tmp_path):
    """All files, but for how long the steps took."""
    recordings.record(tmp_path / "bag", SCENARIO, steps=STEPS, particles=50)
    left = []
    for number in range(3):
        out = tmp_path / f"{number}"
        assert command("run", tmp_path / "bag", "--refine", "--out", out)[0] == 0
        left.append({path.name: timeless(path) for path in out.iterdir()})
    assert len(left[0]) > 8
    assert left[0] == left[1] == left[2]


def timeless(path):
    """What the file or bag of a run holds, without durations."""
    if path.is_dir():
        steps = absolute(topics.STEPS.name)
        return [
            record if record.topic != steps else record._replace(data=timeless_step(record.data))
            for record in BagReader(path)
        ]
    if path.suffix in (".json", ".csv"):
        return [line for line in path.read_text().splitlines() if "step_ms" not in line]
    return path.read_bytes()


def timeless_step(data):
    return wire.encode_step(replace(wire.decode_step(data), duration_ms=0.0))
