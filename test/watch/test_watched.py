"""What is known after each message, and the figures made of it."""

from dataclasses import replace

import numpy as np
import pytest

from msg_defs import wire
from msg_defs.types import Estimate, Trajectory, Verdict
from multi_robot_slam.watch import figures
from multi_robot_slam.watch.watched import MOST_TRAIL, Watched
from test.helpers import fake_run
from test.watch import published

RUN = fake_run(robots=2, steps=6)
NAMES = ["robot_1", "robot_2"]


def watched(run=RUN, steps=None):
    found = Watched(run.config)
    for step in run.steps[:steps]:
        found.take_step(step)
        for estimate in step.estimates:
            found.take_pose(estimate)
    return found


def pose_at(stamp_ns, x=0.0):
    return Estimate("robot_1", stamp_ns, np.array([x, 0.0, 0.0]), np.eye(3))


def test_a_trail_goes_on_from_the_path():
    found = Watched(RUN.config)
    for stamp_ns in (1, 2, 3):
        found.take_pose(pose_at(stamp_ns))
    found.take_path("robot_1", Trajectory(np.array([1, 2]), np.zeros((2, 3))))
    robot = found.robots["robot_1"]
    assert [pose.stamp_ns for pose in robot.trail] == [3]
    found.take_pose(pose_at(4))
    assert [pose.stamp_ns for pose in robot.trail] == [3, 4]
    assert robot.estimate.stamp_ns == 4


def test_a_trail_without_a_path_stays_short_and_holds_both_ends():
    found = Watched(RUN.config)
    for stamp_ns in range(5 * MOST_TRAIL):
        found.take_pose(pose_at(stamp_ns))
    trail = [pose.stamp_ns for pose in found.robots["robot_1"].trail]
    assert len(trail) <= MOST_TRAIL
    assert (trail[0], trail[-1]) == (0, 5 * MOST_TRAIL - 1)
    assert trail == sorted(trail)


def test_a_fusion_that_begins_anew_is_watched_anew():
    found = watched()
    found.take_map(RUN.landmarks)
    found.take_walls(RUN.walls)
    found.take_step(RUN.steps[0])
    assert [step.step for step in found.steps] == [RUN.steps[0].step]
    assert found.landmarks is None
    assert found.walls is RUN.walls
    assert found.robots["robot_2"].estimate is None


def test_entries_of_others_in_the_diagnostics_are_passed_over():
    found = watched(steps=1)
    found.take_diagnostics((wire.Status("battery", {"lag [s]": "9"}), wire.Status("fusion", {})))
    assert list(found.statuses) == ["fusion"]
    assert not found.lags
    found.take_diagnostics((wire.Status("fusion", {"lag [s]": "much"}),))
    assert not found.lags
    found.take_diagnostics((wire.Status("fusion", {"lag [s]": "0.5"}),))
    assert list(found.lags) == [(RUN.steps[0].stamp_ns, 0.5)]


def test_the_extent_holds_all_there_is():
    found = watched(steps=1)
    _, small = found.extent()
    found.take_walls(RUN.walls)
    middle, wide = found.extent()
    assert (small, wide) == (6.0, pytest.approx(10.0, rel=0.05))
    assert middle[2] == 0


def test_the_extent_where_nobody_told_where_a_robot_starts():
    anywhere = replace(RUN.config, start_poses=("unknown",) * len(RUN.config.robots))
    found = Watched(anywhere)
    middle, width = found.extent()
    assert (middle.tolist(), width) == ([0, 0, 0], 6.0)
    found.take_walls(RUN.walls)
    assert found.extent()[1] == pytest.approx(10.0, rel=0.05)


def test_figures_before_anything_was_heard():
    found = Watched(RUN.config)
    assert dict(figures.team(found))["steps"] == "0"
    assert figures.health(found) == (wire.OK, "nothing heard on /diagnostics yet")
    assert [row.state for row in figures.rows(found)] == ["not heard of"] * 2
    assert figures.innovation(found, "robot_1") is None
    for curves in (figures.particle_curve, figures.match_curves, figures.innovation_curves):
        assert len(curves(found).seconds) == 0
    assert len(figures.lag_curve(found).seconds) == 0


def test_figures_of_the_team():
    found = watched()
    found.take_map(RUN.landmarks)
    found.take_diagnostics(tuple(published.statuses(RUN, RUN.steps[-1])))
    told = dict(figures.team(found))
    last = RUN.steps[-1]
    assert told["time"] == "0.5 s"
    assert told["steps"] == str(last.step)
    assert told["landmarks"] == "8"
    assert told["effective particles"] == "12 of 500"
    assert told["a step takes"] == "6.0 ms"
    assert told["dropped"] == "2 late"
    assert told["lag"] == "0.050 s"
    assert figures.health(found) == (wire.WARN, "messages were dropped")
    assert figures.lag_curve(found).values[0].tolist() == [0.05]


def test_figures_of_each_robot():
    verdict = Verdict("robot_2", "lost", "it sees what is elsewhere", "put it back")
    last = replace(RUN.steps[-1], verdicts=(verdict,))
    found = watched(replace(RUN, steps=[*RUN.steps[:-1], last]))
    found.take_diagnostics(tuple(published.statuses(RUN, last)))
    first, second = figures.rows(found)
    frame = last.frames[0]
    new = int(frame.is_new.sum())
    assert first.seen == (str(3 - new), str(new), "0")
    assert (first.level, first.state, first.advice) == (wire.OK, "heard", "")
    assert (second.level, second.state) == (wire.ERROR, "lost")
    assert second.advice == "it sees what is elsewhere; put it back"
    found.take_diagnostics((wire.Status("camera: robot_1", {}, wire.ERROR, "no pictures"),))
    assert figures.rows(found)[0].advice == "no pictures"
    assert figures.rows(found)[0].level == wire.ERROR


def test_innovations_are_means_of_recent_matches(monkeypatch):
    monkeypatch.setattr(figures, "RECENT", 2)
    steps = []
    for place, step in enumerate(RUN.steps):
        frames = tuple(
            replace(
                f, is_new=np.array([False, False, True]), mahalanobis=np.array([place, 3, np.nan])
            )
            for f in step.frames
        )
        steps.append(replace(step, frames=frames))
    found = watched(replace(RUN, steps=steps))
    seconds, (first, second, law) = figures.innovation_curves(found)
    assert seconds == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    # Of 0 3, then 0 3 1 3, then 1 3 2 3, ...
    assert first.tolist() == second.tolist() == [1.5, 1.75, 2.25, 2.75, 3.25, 3.75]
    assert figures.innovation(found, "robot_1") == first[-1]
    assert law == pytest.approx(figures.lawful_mean(found))
    assert 2.0 < law[0] < 3.0
    assert figures.match_curves(found).values[0].tolist() == [2.0] * 6


def test_curves_have_no_gaps():
    """A chart with one would be empty."""
    steps = [
        replace(step, frames=step.frames[place % 2 :][:1]) for place, step in enumerate(RUN.steps)
    ]
    steps[2] = replace(steps[2], effective_particles=np.nan)
    found = watched(replace(RUN, steps=steps))
    found.take_diagnostics((wire.Status("fusion", {"lag [s]": "nan"}),))
    for make in (
        figures.particle_curve,
        figures.match_curves,
        figures.innovation_curves,
        figures.lag_curve,
    ):
        for curve in make(found).values:
            assert np.isfinite(curve).all()
    first, second = figures.match_curves(found).values
    seen = [int((~step.frames[0].is_new).sum()) for step in steps]
    assert first.tolist() == [seen[0], seen[0], seen[2], seen[2], seen[4], seen[4]]
    assert second.tolist() == [0, seen[1], seen[1], seen[3], seen[3], seen[5]]
    assert figures.particle_curve(found).values[0].tolist() == [12.5] * 6
