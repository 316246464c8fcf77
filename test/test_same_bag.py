"""One bag, two filters: Algorithm 1 to the letter and the compiled one see the same landmarks."""

from functools import partial

import literal_algorithm1 as literal
import numpy as np
import recordings

from msg_defs.types import PoseSample, RobotFrame
from multi_robot_slam import offline
from multi_robot_slam.filter import rbpf
from multi_robot_slam.pipeline import Pipeline
from sim_world.planar import between
from sim_world.scenario import Scenario

SCENARIO = Scenario(robots=3, observations=8)
STEPS = 12
PAPER = {"proposal": "motion", "resample_below": 1.0, "exclusive": False, "particles": 6}


def paired(events, names):
    """Steps of one RobotFrame per robot: each cloud with the motion since the robot's last one."""
    events = list(events)
    odometry = {(e.robot, e.stamp_ns): e.pose for e in events if isinstance(e, PoseSample)}
    steps, before = {}, {}
    for seen in (e for e in events if not isinstance(e, PoseSample)):
        pose = odometry[seen.robot, seen.stamp_ns]
        motion = between(before.get(seen.robot, pose), pose)
        before[seen.robot] = pose
        frame = RobotFrame(names.index(seen.robot), seen.stamp_ns, motion, seen)
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
