"""What `/diagnostics` says, and when it is an error."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from helpers import fake_run

from msg_defs import wire
from msg_defs.types import FrameCount, Tied, Verdict
from multi_robot_slam.nodes.health import Health
from multi_robot_slam.pipeline.pipeline import FAILED_STEP
from multi_robot_slam.runs import estimates

nodes = pytest.importorskip("nodes")

STEP = fake_run(steps=1).steps[0]
NO_FRAMES = {"robot_1": FrameCount(0, 0), "robot_2": FrameCount(0, 0)}
NOTHING_LOST = {"robot_1": {}, "robot_2": {}}


def health():
    clock = nodes.Clock()
    return Health(("robot_1", "robot_2"), 5.0, clock), clock


def level(of, dropped=(), frames=NO_FRAMES):
    return of.statuses(0, 0, Counter(dict(dropped)), {}, frames, NOTHING_LOST)[0].level


def test_what_was_dropped_is_a_warning():
    one, _ = health()
    assert level(one) == wire.OK
    one.note(STEP, 0)
    assert level(one, {"late frame": 1}) == wire.WARN


def test_a_failed_step_is_an_error_told_once():
    one, _ = health()
    one.note(STEP, 0)
    assert level(one, {FAILED_STEP: 1}) == wire.ERROR
    assert level(one, {FAILED_STEP: 1}) == wire.WARN
    assert level(one, {FAILED_STEP: 2}) == wire.ERROR


def test_weights_that_are_not_finite_are_an_error():
    one, _ = health()
    one.note(STEP.__class__(**(vars(STEP) | {"effective_particles": np.nan})), 0)
    assert level(one) == wire.ERROR


def test_another_fusion_is_an_error_while_it_is_there():
    one, _ = health()
    one.rival = "another fusion"
    assert level(one) == wire.ERROR
    one.rival = ""
    assert level(one) == wire.OK


def test_nothing_but_losses_is_an_error_until_the_next_step():
    one, clock = health()
    one.note(STEP, 3)
    clock.now_s = 100.0
    assert level(one, {"late frame": 3}) == wire.WARN
    assert level(one, {"late frame": 4}) == wire.WARN
    clock.now_s = 106.0
    assert level(one, {"late frame": 9}) == wire.ERROR
    one.note(STEP, 9)
    assert level(one, {"late frame": 9}) == wire.WARN


def levels(one, clock, losses):
    """The level each second, when so much was lost by then."""
    result = []
    for lost in losses:
        clock.now_s += 1.0
        result.append(level(one, {"late frame": lost}))
    return result


@pytest.mark.parametrize("lost", [1, 500])
def test_a_loss_after_which_all_is_quiet_is_no_error(lost):
    one, clock = health()
    one.note(STEP, 0)
    assert set(levels(one, clock, [lost] * 20)) == {wire.WARN}
    assert set(levels(one, clock, [2 * lost] * 20)) == {wire.WARN}


def test_losses_now_and_then_are_an_error_until_they_end():
    one, clock = health()
    one.note(STEP, 0)
    going_on = levels(one, clock, [1, 1, 1, 2, 2, 2, 3, 3, 3, 4])
    assert going_on == [wire.WARN] * 6 + [wire.ERROR] * 4
    assert levels(one, clock, [4] * 10) == [wire.ERROR] * 5 + [wire.WARN] * 5


def test_a_team_that_stands_still_has_more_than_losses():
    """Frames that are no keyframes make no steps, and are none the worse for it."""
    one, clock = health()
    one.note(STEP, 0)
    found = []
    for count in range(1, 13):
        clock.now_s += 1.0
        frames = NO_FRAMES | {"robot_1": FrameCount(count, 1)}
        found.append(level(one, {"late frame": count}, frames))
    assert set(found) == {wire.WARN}


def test_frames_and_keyframes_are_told_of_each_robot_as_a_run_reads_them():
    one, _ = health()
    frames = {"robot_1": FrameCount(7, 3), "robot_2": FrameCount(0, 0)}
    told = wire.encode_diagnostics(0, one.statuses(0, 0, Counter(), {}, frames, NOTHING_LOST))
    assert estimates.frames([told], tuple(frames)) == frames


def test_what_never_arrived_is_told_of_each_robot():
    one, _ = health()
    lost = {"robot_1": {"lost odometry": 3, "lost frames": 0}, "robot_2": {}}
    _, first, second = one.statuses(0, 0, Counter(), {}, NO_FRAMES, lost)
    assert (first.values["lost odometry"], first.values["lost frames"]) == ("3", "0")
    assert "lost odometry" not in second.values


def test_a_robot_is_silent_after_a_while():
    one, clock = health()
    one.hear("robot_1")
    clock.now_s = 6.0
    one.hear("robot_2")
    _, *robots = one.statuses(0, 0, Counter(), {}, NO_FRAMES, NOTHING_LOST)
    assert [status.level for status in robots] == [wire.WARN, wire.OK]
    assert one.silence_s() == 0.0


def test_topics_that_were_never_heard_are_told():
    one, _ = health()
    unheard = {"/robot_1/odom": "nothing heard"}
    values = one.statuses(0, 0, Counter(), unheard, NO_FRAMES, NOTHING_LOST)[0].values
    assert values["unheard: /robot_1/odom"] == "nothing heard"


def test_a_robots_level_is_that_of_its_verdict_with_cause_remedy_and_numbers():
    one, _ = health()
    lost = Verdict("robot_2", "lost", "slipped", "start anew", {"offset x [m]": 1.5})
    one.note(replace(STEP, verdicts=(Verdict("robot_1", "consistent"), lost)), 0)
    for robot in ("robot_1", "robot_2"):
        one.hear(robot)
    _, first, second = one.statuses(0, 0, Counter(), {}, NO_FRAMES, NOTHING_LOST)
    assert (first.level, first.message) == (wire.OK, "heard")
    assert first.values["level"] == "consistent"
    assert (second.level, second.message) == (wire.ERROR, "lost: slipped; start anew")
    assert second.values["found: offset x [m]"] == "1.5"
    one.note(replace(STEP, verdicts=(Verdict("robot_1", "noisier than told"),)), 0)
    _, first, second = one.statuses(0, 0, Counter(), {}, NO_FRAMES, NOTHING_LOST)
    assert (first.level, second.level) == (wire.WARN, wire.ERROR)
    one.start_over()
    statuses = one.statuses(0, 0, Counter(), {}, NO_FRAMES, NOTHING_LOST)
    assert {status.level for status in statuses} == {wire.OK}


def test_what_told_the_place_of_a_robot_is_told_from_then_on():
    one, _ = health()
    tied = Tied(("robot_2",), True, np.array([1.0, 2.0, 0.5]), 9, 7, 2, 1.5)
    one.note(replace(STEP, tied=tied), 0)
    one.note(STEP, 0)
    _, first, second = one.statuses(0, 0, Counter(), {}, NO_FRAMES, NOTHING_LOST)
    assert not any(key.startswith("tied") for key in first.values)
    assert second.values["tied: pose [m, m, rad]"] == "1.0 2.0 0.5"
    assert second.values["tied: places that agree"] == "7"
    one.start_over()
    *_, second = one.statuses(0, 0, Counter(), {}, NO_FRAMES, NOTHING_LOST)
    assert not any(key.startswith("tied") for key in second.values)
