"""What `/diagnostics` says, and when it is an error."""

from collections import Counter

import numpy as np
import pytest
from helpers import fake_run

from msg_defs import wire
from multi_robot_slam.nodes.health import Health
from multi_robot_slam.pipeline.pipeline import FAILED_STEP

nodes = pytest.importorskip("nodes")

STEP = fake_run(steps=1).steps[0]


def health():
    clock = nodes.Clock()
    return Health(("robot_1", "robot_2"), 5.0, clock), clock


def level(of, dropped=()):
    return of.statuses(0, 0, Counter(dict(dropped)), {})[0].level


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


def test_a_robot_is_silent_after_a_while():
    one, clock = health()
    one.hear("robot_1")
    clock.now_s = 6.0
    one.hear("robot_2")
    _, *robots = one.statuses(0, 0, Counter(), {})
    assert [status.level for status in robots] == [wire.WARN, wire.OK]
    assert one.silence_s() == 0.0


def test_topics_that_were_never_heard_are_told():
    one, _ = health()
    values = one.statuses(0, 0, Counter(), {"/robot_1/odom": "nothing heard"})[0].values
    assert values["unheard: /robot_1/odom"] == "nothing heard"
