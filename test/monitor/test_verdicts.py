"""Which robot is told to be wrong, and how."""

from dataclasses import replace

import numpy as np
import pytest

from msg_defs.types import CameraMount
from multi_robot_slam.filter.pieces import Pieces
from multi_robot_slam.filter.vote import Vote
from multi_robot_slam.monitor.alignment import Alignment
from multi_robot_slam.monitor.continuity import Break, Continuity
from multi_robot_slam.monitor.evidence import LOG_CAP
from multi_robot_slam.monitor.in_view import InView
from multi_robot_slam.monitor.innovations import Innovations
from multi_robot_slam.monitor.learnt_noise import Found
from multi_robot_slam.monitor.recognition import Recognition
from multi_robot_slam.monitor.verdicts import (
    MET,
    Findings,
    blamed,
    verdict,
    with_place_unknown,
)

NOTHING = Found("", "", False, {}, 1.0)
NOISY = Found("of robot_2 odometry is 3.0 times as noisy as told", "raise it", True, {}, 3.0)
OFFSET = Alignment(np.array([0.3, 0.4, np.pi / 2]), 9, 10)


def team(count=3, contradict=(), agree=()):
    robots = [
        Findings(
            f"robot_{i + 1}",
            np.array([1.0, 0.0, 0.0]),
            Innovations(11.345),
            InView(CameraMount(), 0.04),
            [Recognition(11.345) for _ in range(count)],
            Continuity(),
        )
        for i in range(count)
    ]
    for i, j in contradict:
        robots[i].recognised[j].evidence.log = LOG_CAP
        robots[i].recognised[j]._offset = OFFSET
    for i, j in agree:
        robots[i].recognised[j].agreed = MET
    return robots


def level(robots, robot, learnt=NOTHING):
    return verdict(robots, robot, blamed(robots), learnt)


@pytest.mark.parametrize(
    ("contradict", "agree", "expected"),
    [
        ([(0, 1)], [], {1: (0, True)}),
        ([(1, 0)], [], {1: (0, True)}),
        ([(0, 1)], [(0, 1)], {1: (0, False)}),
        ([(0, 1), (2, 1)], [(0, 2)], {1: (0, True)}),
        ([(1, 2)], [(0, 2)], {1: (2, True)}),
        ([(1, 2)], [], {2: (1, True)}),
        ([(0, 1), (1, 2), (0, 2)], [], {2: (0, True), 1: (0, True)}),
        ([(0, 1), (1, 1)], [], {}),
    ],
    ids=["first", "seen by the other", "met", "most", "agrees", "later", "all", "lost itself"],
)
def test_who_is_to_blame(contradict, agree, expected):
    assert blamed(team(3, contradict, agree)) == expected


def test_the_start_is_corrected_by_what_is_seen():
    told = level(team(2, [(1, 0)]), 1)
    assert told.level == "start wrong"
    assert "off by 1.57 m and 90.0 degrees relative to the map of robot_1: 9 of 10" in told.cause
    assert "[0.30, 1.40, 1.571]" in told.remedy
    assert told.numbers["offset yaw [rad]"] == np.pi / 2


def test_a_start_that_nobody_told_cannot_be_wrong():
    robots = team(2, [(1, 0)])
    robots[1] = robots[1]._replace(start=None)
    assert level(robots, 1).level == "lost"


def test_a_place_that_is_not_known_is_told_where_nothing_is_worse():
    pieces = Pieces.of_starts(np.array([True, False]))
    told = with_place_unknown(level(team(2), 1), None, pieces, 1)
    assert told.level == "place unknown"
    assert told.numbers == level(team(2), 1).numbers | {"piece": 2.0}
    assert "place of robot_2 in map is not known yet" in told.cause
    lost = level(team(2, [(1, 1)]), 1)
    told = with_place_unknown(lost, None, pieces, 1)
    assert replace(told, numbers=lost.numbers) == lost


def test_who_was_lost_is_lost_until_its_place_is_known():
    pieces = Pieces.of_starts(np.array([True, False]))
    lost = level(team(2, [(1, 1)]), 1)
    told = with_place_unknown(level(team(2), 1), lost, pieces, 1)
    assert told.level == "lost"
    assert told.cause.startswith(lost.cause)
    assert "in a map of its own" in told.cause
    assert told.remedy == f"{lost.remedy}; drive robot_2 where landmarks are known"


def test_of_two_the_one_whose_way_is_broken_is_lost():
    robots = team(2, [(0, 1)], [(0, 1)])
    assert set(blamed(robots)) == {1}
    robots[0].continuity.breaks.append(Break(10, 5))
    assert set(blamed(robots)) == {0}


def test_the_last_vote_on_a_place_is_told_believed_or_not():
    pieces = Pieces.of_starts(np.array([True, False, False]))
    pieces = pieces.with_vote(0, 2, vote(3)).with_vote(2, 3, vote(4)).with_vote(0, 2, vote(5))
    told = with_place_unknown(level(team(3), 1), None, pieces, 1).numbers
    assert told["vote: places that agree"] == 5
    assert told["vote: places by another pose"] == 2
    assert told["vote: poses as good by chance"] == 0.5
    assert (
        "vote: places that agree"
        not in with_place_unknown(level(team(3), 2), None, pieces, 2).numbers
    )
    silent = pieces.with_vote(0, 2, None)
    assert (
        "vote: places that agree"
        not in with_place_unknown(level(team(3), 1), None, silent, 1).numbers
    )


def vote(places):
    nothing = np.zeros((0, 2), int)
    return Vote(np.zeros(3), np.eye(3), nothing, places, 2, np.zeros(2), 0.5)


def test_what_the_other_sees_is_turned_round():
    told = level(team(2, [(0, 1)]), 1)
    assert "[-0.40, -0.70, -1.571]" in told.remedy


def test_lost_is_worse_than_a_wrong_start_and_that_than_noise():
    assert level(team(2, [(1, 1), (0, 1)]), 1).level == "lost"
    assert level(team(2, [(0, 1)], [(0, 1)]), 1).level == "lost"
    wrong = level(team(2, [(0, 1)]), 1, NOISY)
    assert wrong.level == "start wrong"
    assert wrong.cause.endswith("; and of robot_2 odometry is 3.0 times as noisy as told")
    assert level(team(2), 1, NOISY).level == "noisier than told"
    noisy = team(2)
    noisy[1].innovations.evidence.log = LOG_CAP
    assert level(noisy, 1).level == "noisier than told"
    assert level(noisy, 0) == level(team(2), 0)


def test_evidence_on_which_no_motion_agrees_is_no_level():
    robots = team(2, [(1, 1)])
    robots[1].recognised[1]._offset = None
    assert level(robots, 1).level == "consistent"


def test_what_must_be_in_view_and_is_not_is_lost():
    robots = team(2)
    robots[0].in_view.evidence.log = LOG_CAP
    assert level(robots, 0).level == "lost"
    assert level(robots, 1).level == "consistent"
