"""A robot whose wheels slip, and one that starts elsewhere: said, not published, found again."""

from dataclasses import replace

import numpy as np
import pytest
import short_teams
from short_teams import Ran

from multi_robot_slam import runs
from multi_robot_slam.pipeline import going_on, refinement
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs.trajectory_errors import at
from multi_robot_slam.studies.hard_changes import _driven

AT_S = 14.0
NAME = "robot_2"


@pytest.fixture(scope="module")
def exact():
    """What a team of two sends in its first seconds."""
    return short_teams.told(particles=150, end_s=26)


@pytest.fixture(scope="module")
def slipped(exact):
    """The second robot slips 1 m and 30 degrees."""
    at_ns = exact.events[0].stamp_ns + int(AT_S * 1e9)

    def untold(stamps, moved, true):
        during = (stamps > at_ns) & (stamps <= at_ns + 1e9)
        moved[during] -= np.array([0.8, 0.6, np.radians(30)]) / during.sum()
        return moved

    return _driven(exact, (NAME,), untold)


@pytest.fixture(scope="module")
def ran(slipped):
    return Ran(slipped)


def errors(told, trajectory, name):
    off = trajectory.poses - at(told.recorded.truth[name], trajectory.stamps_ns)
    return np.hypot(off[:, 0], off[:, 1])


def test_a_slip_is_said_and_the_robot_is_found_again(slipped, ran):
    said = ran.levels(NAME)
    lost = [stamp for stamp, level in said if level == "lost"]
    begins_ns = slipped.events[0].stamp_ns + AT_S * 1e9
    assert begins_ns < lost[0] < begins_ns + 4e9
    assert {level for _, level in said} == {"consistent", "lost"}
    assert said[-1][1] == "consistent"
    assert lost[-1] - lost[0] < 6e9
    assert {level for _, level in ran.levels("robot_1")} == {"consistent"}
    assert any(line.startswith(f"{NAME} at") and "lost" in line for line in ran.lines)
    assert any("the place of robot_2 in map is known from now on" in line for line in ran.lines)


def test_nothing_is_published_of_a_robot_that_is_lost(ran):
    lost = [stamp for stamp, level in ran.levels(NAME) if level == "lost"]
    told = [e.stamp_ns for s in ran.steps for e in s.estimates if e.robot == NAME]
    assert not set(told) & set(lost)
    between = ran.run.robots[NAME].predicted.stamps_ns
    assert not ((between > lost[0]) & (between < lost[-1])).any()
    assert min(between) < lost[0] < lost[-1] < max(between)


def test_since_when_its_place_is_known(slipped, ran):
    lost = [stamp for stamp, level in ran.levels(NAME) if level == "lost"]
    figures = runs.evaluate(ran.run)["robots"]
    begins_ns = ran.steps[0].stamp_ns
    assert figures["robot_1"]["place_known_from_s"] == 0.0
    assert abs(figures[NAME]["place_known_from_s"] - (lost[-1] - begins_ns) / 1e9) < 1.0
    until = [step for step in ran.steps if step.stamp_ns <= lost[0]]
    place = runs.evaluate(replace(ran.run, steps=until))["robots"][NAME]["place_known_from_s"]
    assert place is None


def test_before_and_after_all_is_right(slipped, ran):
    lost = [stamp for stamp, level in ran.levels(NAME) if level == "lost"]
    for name in ("robot_1", NAME):
        robot = ran.run.robots[name]
        assert errors(slipped, robot.online, name)[robot.online.stamps_ns > lost[-1]].max() < 0.4
        whole = robot.path
        assert (np.diff(whole.stamps_ns) > 0).all()
        is_known = (whole.stamps_ns < lost[0] - 2e9) | (whole.stamps_ns > lost[-1])
        assert errors(slipped, whole, name)[is_known].max() < 0.4
        assert len(whole.stamps_ns) == len(ran.levels(name))
    assert set(ran.run.landmarks.robots.tolist()) <= {1, 2, 3}
    assert runs.evaluate(ran.run)["map_rmse_m"] < 0.2
    assert ran.pipeline.team == [0, 1, 1]


def test_the_run_is_refined(slipped, ran):
    run = refinement.complete(ran.run, ran.pipeline, with_refined=True, with_yardstick=True)
    assert not run.warnings
    assert set(run.refined_landmarks.robots.tolist()) <= {1, 2, 3}
    after = [stamp for stamp, level in ran.levels(NAME) if level == "lost"][-1]
    for name, robot in run.robots.items():
        path = robot.refined
        assert errors(slipped, path, name)[path.stamps_ns > after].max() < 0.3
        assert not len(robot.yardstick.stamps_ns)  # of what was forgotten nothing is measured


def test_a_state_saved_while_it_is_lost_goes_on_to_the_same_bytes(slipped, ran):
    lost = [stamp for stamp, level in ran.levels(NAME) if level == "lost"]
    middle = next(i for i, e in enumerate(slipped.events) if e.stamp_ns > lost[len(lost) // 2])
    pipeline = Pipeline(slipped.config)
    for event in slipped.events[:middle]:
        pipeline.handle(event)
    parts = going_on.taken_apart(pipeline).parts()
    pipeline.close()
    again = going_on.put_back(going_on.Parts(*parts), lambda text: None)
    steps = [step for event in slipped.events[middle:] for step in again.handle(event)]
    steps += again.finish()
    again.close()
    assert len(steps) > 10
    assert bytes_of(steps) == bytes_of(ran.steps[-len(steps) :])


def bytes_of(steps):
    return [
        (e.robot, e.stamp_ns, e.pose.tobytes(), e.covariance.tobytes())
        for s in steps
        for e in s.estimates
    ]


def test_who_started_elsewhere_is_found_with_all_it_did(exact):
    x, y, yaw = exact.config.start_poses[1]
    starts = (exact.config.start_poses[0], (x + 1.5, y - 2.0, yaw + 0.8))
    told = replace(exact, config=replace(exact.config, start_poses=starts))
    ran = Ran(told)
    said = [level for _, level in ran.levels(NAME)]
    assert "start wrong" in said
    assert said[-1] == "consistent"
    assert {level for _, level in ran.levels("robot_1")} == {"consistent"}
    robot = ran.run.robots[NAME]
    assert errors(told, robot.path, NAME).max() < 0.4  # its whole past
    assert ran.pipeline.team == [0, 1]
