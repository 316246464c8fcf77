"""Time goes back for the whole team, or for nobody."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from msg_defs.types import ObservationSet, PoseSample
from multi_robot_slam.pipeline.rewind import Rewind

SECOND = 10**9
WINDOW = 5 * SECOND
ROBOTS = ("robot_1", "robot_2", "robot_3")


def odometry(robot, second):
    return PoseSample(robot, second * SECOND, np.zeros(3))


def frame(robot, second):
    nothing = np.zeros((0, 3), np.float32)
    return ObservationSet(robot, second * SECOND, nothing, nothing, nothing)


def streams(seconds):
    return [
        [kind(robot, s) for s in range(seconds)] for robot in ROBOTS for kind in (odometry, frame)
    ]


def shuffled(some, seed):
    """All events of the streams, each stream in order; of one second after those of the last."""
    rng = np.random.default_rng(seed)
    return [e for row in zip(*some, strict=True) for e in rng.permutation(np.array(row, object))]


def runs(events):
    """The events by run, as a fusion tells the runs apart."""
    rewind, found = Rewind(WINDOW), [[]]
    for event in events:
        if rewind.note(event):
            beginning = rewind.beginning()
            rewind = Rewind(WINDOW)
            assert not any(map(rewind.note, beginning))
            # The last of these began the run, the others were kept back from the run before.
            del found[-1][len(found[-1]) - len(beginning) + 1 :]
            found.append(beginning)
        else:
            found[-1].append(event)
    return found


@given(seeds=st.tuples(*[st.integers(0, 1000)] * 3), seconds=st.integers(7, 20))
def test_what_is_played_again_is_a_run_of_its_own(seeds, seconds):
    played = [shuffled(streams(seconds), seed) for seed in seeds]
    assert runs([e for once in played for e in once]) == played


@given(st.integers(0, 1000), st.integers(1, 60))
def test_a_robot_that_is_late_is_no_rewind(seed, delay):
    """Whatever one robot sends comes `delay` seconds late, and once more at the end."""
    some = streams(60)
    late = [e for row in zip(*some[:2], strict=True) for e in row]
    others = shuffled(some[2:], seed)
    place = min(len(others), 4 * delay)
    assert len(runs([*late[:2], *others[:place], *late, *others[place:], *late])) == 1


@given(
    seed=st.integers(0, 1000),
    place=st.integers(0, 100),
    ahead=st.sampled_from([6, 60, 3600]),
)
def test_one_stamp_ahead_of_all_is_no_rewind(seed, place, ahead):
    """Whoever sent it, and whenever."""
    events = shuffled(streams(20), seed)
    wild = events[place]
    events[place] = replace(wild, stamp_ns=wild.stamp_ns + ahead * SECOND)
    assert len(runs(events)) == 1


def test_odometry_alone_that_goes_back_is_no_rewind():
    some = streams(20)
    assert len(runs([*shuffled(some, 0), *(e for stream in some[::2] for e in stream)])) == 1


def test_robots_that_fell_silent_are_not_waited_for():
    first = [e for e in shuffled(streams(30), 0) if e.robot != "robot_3" or e.stamp_ns < SECOND]
    again = [e for e in first if e.robot != "robot_3"]
    assert len(runs([*first, *again])) == 2


@given(seed=st.integers(0, 1000), early=st.integers(0, 30), seconds=st.integers(2, 20))
def test_once_the_clock_went_back_the_first_that_is_not_newer_begins_the_run(seed, early, seconds):
    """However short the run is, and however many of its messages are taken after the clock."""
    events = shuffled(streams(seconds), seed)
    rewind, early = Rewind(WINDOW), min(early, len(events))
    assert not any(map(rewind.note, events[: len(events) - early]))
    rewind.clock_went_back()
    assert not any(map(rewind.note, events[len(events) - early :]))
    assert rewind.note(events[0])
    assert rewind.beginning() == events[:1]
