"""Evidence rises to an alarm as rarely as it is meant to, and ends when it is gone."""

import math

import numpy as np
import pytest
from scipy import integrate
from scipy.stats import chi2

from multi_robot_slam.monitor import evidence, innovations, recognition
from multi_robot_slam.monitor.evidence import LOG_ALARM, LOG_CAP, Evidence, log_e_value


def test_the_mean_e_value_of_a_p_value_is_one():
    mean, _ = integrate.quad(lambda p: math.exp(log_e_value(p)), 0, 1)
    assert mean == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("q", [0.7, 1.0, 1.25])
def test_the_mean_e_value_of_innovations_is_one_at_most_where_noise_is_tolerated(q):
    """D below the gate, of standard deviations q times as large; 1 where q is just tolerated."""
    gate = 11.345
    one = innovations.Innovations(gate)

    def e_value(d):
        return math.exp(one.log_e_value(d))

    law = chi2(3, scale=q * q)
    mean, _ = integrate.quad(lambda d: law.pdf(d) / law.cdf(gate) * e_value(d), 0, gate)
    assert mean <= 1 + 1e-6
    if q == innovations.TOLERATED:
        assert mean == pytest.approx(1, abs=1e-6)


def test_alarms_of_what_is_consistent_are_as_rare_as_one_in_a():
    """With a lower alarm, so that it can be counted: T / A at most."""
    rng, frames, alarm = np.random.default_rng(0), 100, 1000.0
    runs = [[log_e_value(p) for p in rng.random(frames)] for _ in range(2000)]
    alarms = 0
    for run in runs:
        one = Evidence()
        logs = []
        for e in run:
            one.add(e)
            logs.append(one.log)
        alarms += max(logs) >= math.log(alarm)
    assert 0 < alarms / len(runs) <= frames / alarm


def test_one_frame_is_no_alarm_and_two_are():
    one = Evidence()
    one.add(log_e_value(1e-100))
    assert not one.is_alarming
    one.add(log_e_value(1e-100))
    assert one.is_alarming


def test_frames_that_agree_end_an_alarm():
    one = Evidence()
    for _ in range(100):
        one.add(log_e_value(1e-100))
    assert one.log == LOG_CAP
    frames = 0
    while one.is_alarming:
        one.add(log_e_value(0.7))
        frames += 1
    assert frames == math.ceil((LOG_CAP - LOG_ALARM) / -log_e_value(0.7)) == 3


def test_the_tail_is_that_of_chi2_with_three_degrees():
    at = np.array([0.0, 0.1, 1, 3, 11.345, 50, 500])
    np.testing.assert_allclose([recognition.tail(x) for x in at], chi2.sf(at, 3), rtol=1e-9)


def test_the_budget_is_what_is_said():
    per_run = 15 * 150 / math.exp(evidence.LOG_ALARM)
    assert 1 / 5000 < per_run < 1 / 2000
