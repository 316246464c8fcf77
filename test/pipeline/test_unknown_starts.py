"""A robot whose start is unknown: nothing is said of it until it is tied in, all of it after."""

from dataclasses import replace

import numpy as np
import pytest
import short_teams
from short_teams import Ran

from msg_defs import scenario_file
from msg_defs.errors import InputError
from msg_defs.types import PoseSample
from multi_robot_slam import runs
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.filter.vote import FALSE_RATE
from multi_robot_slam.pipeline import refinement
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs.trajectory_errors import at


@pytest.fixture(scope="module")
def told():
    """What a team of two sends in its first seconds, the second from an unknown start."""
    exact = short_teams.told(particles=100, end_s=25)
    config = replace(exact.config, start_poses=(exact.config.start_poses[0], "unknown"))
    return replace(exact, config=config)


@pytest.fixture(scope="module")
def ran(told):
    return Ran(told)


def first_estimate(steps, robot):
    return next(e.stamp_ns for s in steps for e in s.estimates if e.robot == robot)


def test_nothing_is_published_of_it_before_and_the_truth_after(told, ran):
    first, second = told.config.robots
    start_ns = first_estimate(ran.steps, second)
    assert first_estimate(ran.steps, first) == ran.steps[0].stamp_ns
    assert 3e9 < start_ns - ran.steps[0].stamp_ns < 20e9
    assert (ran.run.robots[second].online.stamps_ns >= start_ns).all()
    assert len(ran.run.robots[second].predicted.stamps_ns) > 20
    for name in (first, second):
        robot = ran.run.robots[name]
        for path, limit in ((robot.online, 0.3), (robot.path, 0.3), (robot.mean, 0.3)):
            if len(path.poses):
                errors = path.poses - at(robot.truth, path.stamps_ns)
                assert np.hypot(errors[:, 0], errors[:, 1]).max() < limit
    assert ran.run.robots[second].path.stamps_ns[0] == ran.steps[0].stamp_ns  # its whole past
    assert not ran.pipeline.dropped
    assert not len(ran.pipeline.unplaced()[1])


def test_what_is_said_of_it(told, ran):
    second = told.config.robots[1]
    levels = [v.level for s in ran.steps for v in s.verdicts if v.robot == second]
    assert levels[0] == "place unknown"
    assert levels[-1] == "consistent"
    assert set(levels) == {"place unknown", "consistent"}
    first = {v.level for s in ran.steps for v in s.verdicts if v.robot != second}
    assert first == {"consistent"}
    assert "drive robot_2 where the map has landmarks" in ran.lines[0]
    (tied,) = [line for line in ran.lines if "is known from now on" in line]
    assert "landmarks of" in tied
    assert "after eight were common" in tied
    figures = runs.evaluate(ran.run)
    assert figures["worst_level"] == "place unknown"
    (own,) = [step for step in ran.steps if step.tied is not None]
    assert own.tied.robots == (second,)
    assert own.tied.is_in_map
    in_words = f"by {own.tied.landmarks} landmarks of {own.tied.places} places that agree, "
    assert in_words in tied
    robots = figures["robots"]
    assert robots[second]["place_known_from_s"] == (own.stamp_ns - ran.steps[0].stamp_ns) / 1e9
    assert robots[second]["tied_places"] == own.tied.places >= 3
    assert robots["robot_1"]["place_known_from_s"] == 0
    assert robots["robot_1"]["tied_places"] is None


def test_what_the_last_vote_said_is_among_its_numbers(told, ran):
    second = told.config.robots[1]
    said = [v for s in ran.steps for v in s.verdicts if v.robot == second]
    unknown = [v.numbers for v in said if v.level == "place unknown"]
    assert {numbers["piece"] for numbers in unknown} == {2.0}
    places = [numbers.get("vote: places that agree", 0.0) for numbers in unknown]
    assert places[-1] > places[0]
    assert unknown[-1]["vote: poses as good by chance"] <= FALSE_RATE
    assert not any("piece" in v.numbers for v in said if v.level != "place unknown")


def test_the_run_is_refined_with_its_whole_past(told, ran):
    run = refinement.complete(ran.run, ran.pipeline, with_refined=True, with_yardstick=True)
    assert not run.warnings
    for robot in run.robots.values():
        for path in (robot.refined, robot.yardstick):
            errors = path.poses - at(robot.truth, path.stamps_ns)
            assert np.hypot(errors[:, 0], errors[:, 1]).max() < 0.3


def test_a_robot_that_is_never_tied_in_disturbs_nothing(told):
    """It has no path, the map has what the other saw, and the files can be written."""
    first, second = told.config.robots
    until = told.events[0].stamp_ns + 3 * 10**9
    events = tuple(e for e in told.events if e.stamp_ns <= until)
    ran = Ran(replace(told, events=events))
    assert {e.robot for s in ran.steps for e in s.estimates} == {first}
    assert set(ran.pipeline.trajectories()) == set(ran.pipeline.mean_trajectories()) == {first}
    assert set(ran.run.landmarks.robots.tolist()) == {1}
    apart, pieces = ran.pipeline.unplaced()
    assert set(apart.robots.tolist()) == {2}
    assert set(pieces.tolist()) == {2}
    assert len(pieces) > 5
    assert not np.isin(apart.ids, ran.run.landmarks.ids).any()
    assert {record.robot for record, _ in ran.pipeline.lineage()} == {0}
    figures = runs.evaluate(ran.run)
    assert figures["worst_level"] == "place unknown"
    assert figures["robots"][second]["place_known_from_s"] is None
    run = refinement.complete(ran.run, ran.pipeline, with_refined=True, with_yardstick=True)
    assert not run.warnings
    assert not len(run.robots[second].refined.poses)
    sample = [e for e in events if isinstance(e, PoseSample) and e.robot == second][-1]
    assert ran.pipeline.predict(sample) is None


def test_the_first_robot_with_a_start_fixes_map():
    config = Config(robots=("a", "b", "c"), start_poses=("unknown", (1, 2, 0), (0, 0, 0)))
    assert [config.start_sigma_of(robot) for robot in (1, 2)] == [(0.0, 0.0), (0.05, 0.035)]
    assert config.are_known.tolist() == [False, True, True]
    assert config.starts[1].tolist() == [1, 2, 0]


def test_unknown_survives_a_file():
    config = Config(robots=("a", "b"), start_poses=((1, 2, 0), "unknown"))
    text = scenario_file.to_yaml(**{SECTION: config})
    assert scenario_file.from_yaml(Config, text, SECTION) == config
    assert "unknown" in scenario_file.to_commented_yaml(SECTION, config)


def test_all_unknown_is_refused_with_the_remedy():
    with pytest.raises(InputError, match="unknown for all robots; give x, y, yaw of one"):
        Pipeline(Config(robots=("a", "b"), start_poses=("unknown", "unknown")))


@pytest.mark.parametrize("bad", ["somewhere", [0.0, 0.0], [0.0, 0.0, "x"], None])
def test_a_start_that_is_none_is_refused_in_one_line(bad):
    values = {"robots": ["a", "b"], "start_poses": [[0.0, 0.0, 0.0], bad]}
    with pytest.raises(InputError, match="rows of 3 numbers, or unknown") as refused:
        scenario_file.from_mapping(Config, values)
    text = str(refused.value)
    assert text.startswith(f"settings: start_poses.1 = {bad!r}; give")
    assert "\n" not in text
