"""What the monitor said in a run, as figures."""

from dataclasses import replace

import helpers

from msg_defs.types import Verdict
from multi_robot_slam.runs import evaluation, levels

SAID = {
    3: Verdict("robot_1", "noisier than told", "noise", "raise it"),
    5: Verdict("robot_1", "lost", "slipped", "start anew"),
    6: Verdict("robot_1", "lost", "slipped again", "start anew"),
    9: Verdict("robot_1", "noisier than told", "noise", "raise it"),
}


def run():
    made = helpers.fake_run(robots=2)
    steps = [
        replace(step, verdicts=(SAID.get(t, Verdict("robot_1", "consistent")),))
        for t, step in enumerate(made.steps)
    ]
    return replace(made, steps=steps)


def test_the_worst_level_of_a_run_is_told_with_its_first_cause():
    figures = evaluation.evaluate(run())
    assert figures["worst_level"] == "lost"
    own = figures["robots"]["robot_1"]
    assert own["level"] == "consistent"
    assert (own["worst_level"], own["worst_level_cause"]) == ("lost", "slipped")
    assert own["worst_level_remedy"] == "start anew"
    assert own["worst_level_at_s"] == 5 * helpers.PERIOD_NS / 1e9


def test_a_robot_of_which_nothing_was_said_has_no_level():
    figures = evaluation.evaluate(run())
    assert figures["robots"]["robot_2"]["level"] is None
    assert evaluation.evaluate(helpers.fake_run())["worst_level"] is None


def test_levels_are_in_order():
    expected = ["consistent", "place unknown", "noisier than told", "start wrong", "lost"]
    assert expected == levels.ORDER
