"""What is said of simulated teams: of exact ones nothing, of others what is wrong."""

from dataclasses import replace

import numpy as np
import pytest

from msg_defs.types import PoseSample
from multi_robot_slam import config
from multi_robot_slam.models.motion import increment, move
from multi_robot_slam.monitor.monitor import Monitor
from multi_robot_slam.pipeline.pipeline import Pipeline
from sim_world.scenario import Scenario
from sim_world.simulator import Simulation

SCENARIO = Scenario(robots=2, movements=300)
SCENARIO = replace(SCENARIO, camera=replace(SCENARIO.camera, sigma_rc_px=1.0))
SIMULATION = Simulation(SCENARIO, 0)
STARTS = [list(map(float, pose)) for pose in SIMULATION.start_poses.values()]
EVENTS = [
    event
    for _, instant in zip(range(45), SIMULATION.steps(), strict=False)
    for robot in instant
    for event in (robot.odometry, robot.observations)
]


def run(events=EVENTS, starts=STARTS, **changes):
    """The steps and what was told."""
    settings = config.shipped("calibrated")
    settings = replace(
        settings,
        robots=SCENARIO.names,
        start_poses=tuple(map(tuple, starts)),
        mount=SCENARIO.camera.mount,
        filter=replace(settings.filter, particles=200),
        **{"start_sigma": (0.0, 0.0)} | changes,
    )
    told = []
    pipeline = Pipeline(settings, told.append)
    steps = [step for event in events for step in pipeline.handle(event)] + pipeline.finish()
    pipeline.close()
    return steps, told


def levels(steps, robot):
    return [v.level for step in steps for v in step.verdicts if v.robot == robot]


def slipped(events, robot, at, motion):
    """From its sample number `at` on, odometry tells of a `motion` that never was."""
    base, count = None, 0
    for event in events:
        if isinstance(event, PoseSample) and event.robot == robot:
            count += 1
            if count == at:
                base = event.pose
            if base is not None:
                pose = base[:, None].copy()
                for part in (motion, increment(base, event.pose)):
                    move(pose, np.array(part, float)[:, None])
                event = replace(event, pose=pose[:, 0])
        yield event


@pytest.fixture(scope="module")
def exact():
    return run()


def test_of_a_team_that_is_as_told_nothing_is_said(exact):
    steps, told = exact
    assert not told
    assert {v.level for step in steps for v in step.verdicts} == {"consistent"}
    names = [[v.robot for v in step.verdicts] for step in steps]
    assert names == [[frame.robot for frame in step.frames] for step in steps]
    assert all(np.isfinite(list(v.numbers.values())).all() for s in steps for v in s.verdicts)


def test_the_monitor_changes_nothing_and_says_the_same_again(exact, monkeypatch):
    def outputs(steps):
        return [
            (e.robot, e.pose.tobytes(), e.covariance.tobytes()) for s in steps for e in s.estimates
        ]

    assert [s.verdicts for s in run()[0]] == [s.verdicts for s in exact[0]]
    monkeypatch.setattr(Monitor, "expect", lambda *_: [])
    monkeypatch.setattr(Monitor, "judge", lambda *_: ())
    assert outputs(run()[0]) == outputs(exact[0])


def test_a_start_that_is_off_is_told_with_the_right_one():
    wrong = STARTS[1][0] + 0.24, STARTS[1][1] + 0.18, STARTS[1][2] + np.radians(10)
    steps, told = run(starts=[STARTS[0], wrong])
    assert set(levels(steps, "robot_1")) == {"consistent"}
    first = next(v for s in steps for v in s.verdicts if v.level == "start wrong")
    assert first.robot == "robot_2"
    assert first.cause.startswith("the start of robot_2 is off by 0.3")
    assert "relative to the map of robot_1" in first.cause
    corrected = [float(n) for n in first.remedy.split("[")[1].split("]")[0].split(",")]
    assert (abs(np.subtract(corrected, STARTS[1])) < [0.1, 0.1, 0.03]).all()
    assert "start wrong" in told[0]


def test_a_slip_is_told_within_five_frames_and_of_that_robot_alone():
    steps, _ = run(slipped(EVENTS, "robot_1", 25, [1.0, 0.0, np.radians(30)]))
    said = levels(steps, "robot_1")
    assert set(said[:24]) == {"consistent"}
    assert "lost" in said[24:29]
    assert set(levels(steps, "robot_2")[:29]) == {"consistent"}
