"""What never arrived is counted, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest
import recordings
from hypothesis import given
from hypothesis import strategies as st

from msg_defs.types import ObservationSet, PoseSample
from multi_robot_slam.config import Config
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.pipeline import offline
from multi_robot_slam.pipeline.losses import LONGEST_NS, Losses
from multi_robot_slam.pipeline.pairing import FRAMES, ODOMETRY
from multi_robot_slam.pipeline.pipeline import Pipeline

SECOND = 10**9
PATIENCE_NS = 5 * SECOND


def counted(stamps_s):
    losses = Losses(PATIENCE_NS)
    lost = [one for second in stamps_s for one in losses.hear(round(second * SECOND))]
    lost += losses.end()
    assert losses.total == sum(one.messages for one in lost)
    return losses.total


def jittered(rng, rate_hz, count, jitter=0.1):
    return (np.arange(count) + rng.uniform(-jitter, jitter, count) + 1) / rate_hz


@given(st.floats(0.5, 200), st.integers(0, 1000), st.floats(0, 0.1))
def test_of_a_complete_stream_nothing_is_lost(rate_hz, seed, jitter):
    assert counted(jittered(np.random.default_rng(seed), rate_hz, 200, jitter)) == 0


@given(st.floats(0.5, 200), st.integers(0, 1000), st.floats(0, 0.1))
def test_what_is_missing_now_and_then_is_counted(rate_hz, seed, jitter):
    rng = np.random.default_rng(seed)
    stamps = jittered(rng, rate_hz, 200, jitter)
    missing = 12 + 8 * rng.choice(22, 5, replace=False) + rng.integers(0, 3, 5)
    assert counted(np.delete(stamps, missing)) == 5


def test_of_three_lost_in_ten_nearly_all_are_counted():
    rng = np.random.default_rng(3)
    is_lost = rng.random(4000) < 0.3
    assert 0.85 * is_lost.sum() < counted(jittered(rng, 20, 4000)[~is_lost]) <= is_lost.sum()


def test_a_silence_counts_what_would_have_come_unless_it_was_switched_off():
    stamps = np.arange(0, 100, 0.1)
    assert counted(stamps[(stamps < 30) | (stamps > 59.95)]) == 300
    later = stamps[300:] + LONGEST_NS / SECOND
    assert counted([*stamps[:300], *later]) == 0


@given(st.integers(0, 1000))
def test_what_comes_late_is_not_lost(seed):
    rng = np.random.default_rng(seed)
    stamps = np.arange(1, 400) / 10
    arrivals = stamps + rng.uniform(0, 2, len(stamps)) * (rng.random(len(stamps)) < 0.2)
    arrivals[:20] = stamps[:20]
    assert counted(stamps[np.argsort(arrivals, kind="stable")]) == 0


def test_who_sends_seldom_from_now_on_has_lost_nothing():
    assert counted([*np.arange(0, 10, 0.05), *np.arange(10, 60, 0.5)]) == 0


def test_nothing_is_missing_where_nothing_is_regular():
    """As clouds of the node `camera`: when a robot has moved so far, or rested for a second."""
    rng = np.random.default_rng(0)
    waits = rng.choice([0.2, 0.3, 0.4, 0.5, 1.0], 400, p=[0.15, 0.25, 0.25, 0.25, 0.1])
    assert counted(np.cumsum(waits)) == 0
    assert counted(np.cumsum(np.tile([0.2, 0.8], 100))) == 0


def team(told):
    config = Config(filter=FilterSettings(particles=5))
    return Pipeline(config, told.append)


def sent(seconds):
    nothing = (np.empty((0, size), np.float32) for size in (3, 6, 128))
    empty = ObservationSet("robot_1", 0, *nothing)
    for tenth in range(10, 10 * seconds):
        ns = tenth * SECOND // 10
        yield PoseSample("robot_1", ns, np.array([0.02 * tenth, 0.0, 0.0]))
        if tenth % 5 == 0:
            yield replace(empty, stamp_ns=ns)


def test_losses_are_told_and_counted_of_each_robot_and_kind():
    told = []
    pipeline = team(told)
    for event in sent(40):
        is_odometry = isinstance(event, PoseSample)
        if is_odometry and 20 * SECOND < event.stamp_ns < 21 * SECOND:
            continue
        if not is_odometry and event.stamp_ns in (25 * SECOND, 30 * SECOND):
            continue
        pipeline.handle(event)
    pipeline.finish()
    assert pipeline.dropped == {ODOMETRY: 9, FRAMES: 2}
    assert pipeline.lost() == {"robot_1": {ODOMETRY: 9, FRAMES: 2}}
    assert "lost odometry of robot_1: 9 between 20.000 s and 21.000 s" in told[0]
    assert all("they never arrived: look at the network" in line for line in told)
    assert len(told) == 3


def test_what_cannot_be_used_has_arrived():
    told = []
    pipeline = team(told)
    for event in sent(40):
        is_odd = event.stamp_ns == 20 * SECOND
        if is_odd and isinstance(event, PoseSample):
            event = replace(event, pose=np.array([1e12, 0.0, 0.0]))
        pipeline.handle(event)
    pipeline.finish()
    assert pipeline.dropped == {"implausible odometry": 1}


@pytest.mark.parametrize("ahead_s", [0.35, 3.0, 7.0, 3600.0])
def test_a_stamp_that_is_wrong_is_no_loss_besides(ahead_s):
    told = []
    pipeline = team(told)
    for event in sent(40):
        if event.stamp_ns == 20 * SECOND and isinstance(event, PoseSample):
            event = replace(event, stamp_ns=event.stamp_ns + int(ahead_s * SECOND))
        pipeline.handle(event)
    pipeline.finish()
    assert pipeline.dropped[ODOMETRY] == 0
    assert pipeline.dropped.total() >= 1


def test_a_recording_and_its_replay_have_lost_nothing(tmp_path):
    _, config = recordings.record(tmp_path / "bag", particles=5)
    run = offline.estimate(tmp_path / "bag", config, pytest.fail)
    assert not run.dropped


def test_what_came_while_nobody_listened_is_not_missed():
    losses = Losses(10**9)
    stamps = [n * 10**8 for n in range(20)]
    later = [stamp + 4 * 10**9 for stamp in stamps]
    assert [losses.hear(stamp) for stamp in stamps] == [[]] * 20
    losses.pause()
    assert [losses.hear(stamp) for stamp in later] == [[]] * 20
    assert losses.end() == []
    assert losses.total == 0
