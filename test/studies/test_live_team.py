"""A team as it reports live: what it sends, how fast, and what the filter takes for it."""

from dataclasses import replace

import numpy as np
import pytest

from msg_defs import topics, wire
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.studies import accuracy, exploration, live_rows, live_team
from multi_robot_slam.studies.live_team import LiveFilter, Spent
from sim_world.simulator import Simulation


@pytest.fixture(scope="module")
def base():
    return accuracy.calibrated()


def simulated(base, robots=2, seconds=4.0, rate_hz=10.0):
    return Simulation(live_team.team(base.scenario, robots, rate_hz, seconds), seed=3)


def live(base, simulation, **settings):
    few = replace(base.filters[accuracy.REJUVENATED], particles=40, **settings)
    return LiveFilter(
        Pipeline(exploration.configure(simulation, base.keyframe, few), keeps_frames=False)
    )


@pytest.mark.parametrize(("robots", "seconds"), [(1, 10.0), (3, 200.0), (10, 200.0)])
def test_a_team_drives_on_for_as_long_as_asked_at_the_same_pace(base, robots, seconds):
    usual = Simulation(replace(base.scenario, robots=robots), 0)
    faster = Simulation(live_team.team(base.scenario, robots, 10.0, seconds), 0)
    assert faster.instants - 1 >= seconds * 10
    speeds = [
        np.abs(np.diff(run.truth_path("robot_1").poses[:, :2], axis=0)).sum()
        / np.diff(run.truth_path("robot_1").stamps_ns).sum()
        for run in (usual, faster)
    ]
    assert speeds[1] == pytest.approx(speeds[0], rel=0.1)


def test_the_filter_takes_what_is_sent_as_bytes_and_nothing_else(base):
    simulation = simulated(base)
    feed, whole = live(base, simulation), 0
    stamps = set()
    for instant in live_team.instants(simulation, 3.0):
        messages = live_team.sent(instant)
        assert [topic for topic, _ in messages] == [
            kind(name)
            for name in ("robot_1", "robot_2")
            for kind in (topics.odometry, topics.observations)
        ]
        for topic, data in messages:
            taken = feed.take(topic, data)
            whole += len(taken.steps)
            if taken.prediction:
                stamps.add(taken.prediction.stamp_ns)
    assert max(stamps) == wire.peek_stamp(data, "")
    spent = feed.spent()
    assert spent.steps == whole > 3
    assert spent.observations >= spent.steps
    assert spent.whole >= spent.stepping >= spent.own_stepping > 0
    assert feed.pictures(max(stamps)) > 10
    again = feed.spent()
    assert (again.steps, again.own_stepping, again.longest_ms) == (0, 0.0, 0.0)


def test_what_other_threads_do_counts_and_what_the_simulation_does_not(base, monkeypatch):
    clocks = {"process": 10.0, "thread": 4.0}
    monkeypatch.setattr(live_team, "process_time", lambda: clocks["process"])
    monkeypatch.setattr(live_team, "thread_time", lambda: clocks["thread"])
    simulation = simulated(base)
    feed = live(base, simulation)
    steps = iter([[], ["a step"], []])

    def handle(event):
        for clock in clocks:
            clocks[clock] += 0.5  # the filter's own thread
        clocks["process"] += 0.25  # another one beside it
        return next(steps)

    monkeypatch.setattr(feed.pipeline, "handle", handle)
    monkeypatch.setattr(feed.pipeline, "predict", lambda event: None)
    first = live_team.sent(next(live_team.instants(simulation, 1.0)))
    for topic, data in first[:3]:
        for clock in clocks:
            clocks[clock] += 7.0  # the simulation
        feed.take(topic, data)
    monkeypatch.setattr(feed, "_steps", [])
    spent = feed.spent()
    assert spent[:3] == (1.5 + 0.75, 0.5 + 0.75, 0.5)


def test_rejuvenation_is_held_to_the_same_run_without():
    def second(stepping, own, steps):
        return Spent(9.0, stepping, own, steps, 10, 1.0)

    taken, without = [second(6.0, 1.0, 2), second(2.0, 2.0, 2)], [second(1.0, 1.0, 4)]
    whole, own = live_rows.rejuvenation_ratios(taken, without)
    assert (whole.value, own.value) == (8.0, 3.0)
    assert (whole.met, own.met) == (False, False)


def test_seconds_hold_all_that_is_sent_in_them_once(base):
    seconds = live_rows._by_second(simulated(base), 3.0, 10.0)
    assert [len(messages) for messages in seconds] == [2 * 2 * 10] * 3
    stamps = [wire.peek_stamp(data, "") for messages in seconds for _, data in messages]
    assert stamps == sorted(stamps)
    assert len(set(stamps)) == 30
