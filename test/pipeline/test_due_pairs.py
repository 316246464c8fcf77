"""The pairs that are looked at are those that the filter makes keyframes of."""

from dataclasses import replace

import numpy as np
import pictures
import pytest
from hypothesis import given
from hypothesis import strategies as st

from msg_defs.types import PoseSample
from multi_robot_slam.config import EVERY_FRAME
from multi_robot_slam.front_end.settings import CameraSettings
from multi_robot_slam.front_end.sync import Pair
from multi_robot_slam.pipeline import due_pairs
from multi_robot_slam.pipeline.due_pairs import DuePairs
from multi_robot_slam.pipeline.keyframes import Keyframes

PERIOD_NS = 10**8
LONG = CameraSettings(rest_s=1000.0)


def sample(stamp_ns, x, yaw=0.0):
    return PoseSample("robot_1", stamp_ns, np.array([x, 0.0, yaw]))


def pair(stamp_ns):
    return Pair(stamp_ns, b"", b"")


def given_out(due, events):
    found = []
    for event in events:
        found += due.move(event) if isinstance(event, PoseSample) else due.take(event)
    return [one.stamp_ns for one in found]


def merged(pairs, samples, lag_ns=0):
    """Pairs, and the samples that come `lag_ns` later."""
    events = [(p.stamp_ns, 0, n, p) for n, p in enumerate(pairs)]
    events += [(s.stamp_ns + lag_ns, 1, n, s) for n, s in enumerate(samples)]
    return [event[-1] for event in sorted(events, key=lambda event: event[:3])]


speeds = st.lists(st.floats(-1.5, 1.5), min_size=40, max_size=40)


@given(speeds, st.integers(0, 5 * PERIOD_NS))
def test_they_are_the_filter_s_keyframes_however_late_odometry_comes(velocities, lag_ns):
    config = pictures.team(camera=LONG)
    along = np.cumsum(velocities) * 0.1
    stamps = 10**9 + PERIOD_NS * np.arange(len(along))
    samples = [sample(int(s) - 3, x) for s, x in zip(stamps, along, strict=True)]
    pairs = [pair(int(stamp)) for stamp in stamps[:-1]]
    found = given_out(DuePairs(config), merged(pairs, samples, lag_ns))
    keyframes, expected = Keyframes(config.keyframe), []
    for one in pairs:
        x = np.interp(one.stamp_ns, stamps - 3, along)
        pose = np.array([x, 0.0, 0.0])
        if keyframes.is_due(0, pose, {}):
            keyframes.use(0, pose, {})
            expected.append(one.stamp_ns)
    before_odometry = [p.stamp_ns for p in pairs if p.stamp_ns <= samples[0].stamp_ns + lag_ns]
    assert found == sorted({*expected, *before_odometry})


def test_a_robot_at_rest_is_looked_at_now_and_then():
    config = pictures.team(camera=CameraSettings(rest_s=0.5))
    stamps = 10**9 + PERIOD_NS * np.arange(21)
    events = [e for s in stamps.tolist() for e in (sample(s, 0.0), pair(s))]
    due = DuePairs(config)
    assert np.diff(given_out(due, events)).tolist() == [5 * PERIOD_NS] * 4
    assert due.passed_over == 16


def test_a_look_at_rest_does_not_put_off_the_next_keyframe():
    config = pictures.team(camera=CameraSettings(rest_s=0.3))
    stamps = (10**9 + PERIOD_NS * np.arange(11)).tolist()
    events = [e for n, s in enumerate(stamps) for e in (sample(s, 0.05 * n), pair(s))]
    found = given_out(DuePairs(config), events)
    assert {stamps[0], stamps[5], stamps[10]} <= set(found)


def test_without_odometry_all_are_due_at_once_and_then_those_that_moved():
    due = DuePairs(pictures.team(camera=LONG))
    assert [p.stamp_ns for n in (1, 2, 3) for p in due.take(pair(n * PERIOD_NS))] == [
        n * PERIOD_NS for n in (1, 2, 3)
    ]
    events = [
        e for n in range(4, 14) for e in (sample(n * PERIOD_NS, 0.1 * (n - 4)), pair(n * PERIOD_NS))
    ]
    assert given_out(due, events) == [n * PERIOD_NS for n in (7, 10, 13)]


def test_odometry_that_ends_holds_nothing_up_for_long(monkeypatch):
    due = DuePairs(pictures.team(camera=LONG))
    due.move(sample(10**9, 0.0))
    stamps = [10**9 + PERIOD_NS * n for n in range(30)]
    found = given_out(due, map(pair, stamps))
    late = due_pairs.PATIENCE_NS // PERIOD_NS
    assert found == stamps[:1] + stamps[1:-late]
    assert [p.stamp_ns for p in due.rest()] == stamps[-late:]


@pytest.mark.parametrize("changes", [{"keyframe": EVERY_FRAME}, {"sightings": True}])
def test_all_are_due_where_every_frame_is_a_step_or_robots_see_robots(changes):
    due = DuePairs(replace(pictures.team(camera=LONG), **changes))
    events = [e for n in range(5) for e in (sample(n, 0.0), pair(n))]
    assert given_out(due, events) == [0, 1, 2, 3, 4]


def test_time_that_goes_back_begins_anew():
    due = DuePairs(pictures.team(camera=LONG))
    events = [e for n in range(3) for e in (sample(10**11 + n, 0.0), pair(10**11 + n))]
    given_out(due, events)
    again = [e for n in range(4) for e in (sample(10**9 + n, 0.1 * n), pair(10**9 + n))]
    assert given_out(due, again) == [10**9, 10**9 + 3]
