"""What the evidence amounts to, in words: the worst level first, its cause and its remedy."""

from collections.abc import Sequence
from dataclasses import replace
from math import degrees
from typing import NamedTuple

import numpy as np

from msg_defs.types import PLACE_UNKNOWN, Verdict
from multi_robot_slam.filter.pieces import Pieces
from multi_robot_slam.models.motion import increment, move, wrap
from multi_robot_slam.monitor import learnt_noise
from multi_robot_slam.monitor.alignment import Alignment
from multi_robot_slam.monitor.continuity import Continuity
from multi_robot_slam.monitor.evidence import LOG_ALARM
from multi_robot_slam.monitor.in_view import InView
from multi_robot_slam.monitor.innovations import Innovations
from multi_robot_slam.monitor.recognition import Recognition

MET = 3
"""Frames that agree after which two robots' maps did once lie where they should."""


class Findings(NamedTuple):
    """All that is held for and against one robot."""

    name: str
    start: np.ndarray | None
    """(3,) its start pose as configured; None: unknown."""
    innovations: Innovations
    in_view: InView
    recognised: list[Recognition]
    """What it sees of each robot's landmarks, its own included."""
    continuity: Continuity
    before: Verdict | None = None
    """The one on which it was taken out of the map, as long as it is not in it again."""


def is_lost(team: Sequence[Findings], robot: int) -> bool:
    """The robot's own past contradicts where it is now."""
    own = team[robot]
    return own.recognised[robot].offset is not None or own.in_view.evidence.is_alarming


def blamed(team: Sequence[Findings]) -> dict[int, tuple[int, bool]]:
    """The robots whose maps lie wrong against others': against which robot, and since the start.

    Two maps that contradict each other do not say which of them is wrong. It is that of the robot
    that is lost, or else of the one that contradicts most, or else whose way may be broken, or else
    that agrees with fewest, or else the later one in the team, for the first fixes where `map` is.
    """
    robots = range(len(team))
    pairs = {
        (i, j)
        for i in robots
        for j in robots
        if i < j and _contradict(team, i, j) and not is_lost(team, i) and not is_lost(team, j)
    }
    result: dict[int, tuple[int, bool]] = {}
    while pairs:
        involved = sorted({robot for pair in pairs for robot in pair})
        worst = max(
            involved,
            key=lambda r: (
                sum(r in p for p in pairs),
                len(team[r].continuity.breaks) > 0,
                -_agreements(team, r),
                r,
            ),
        )
        other = min(sum(pair) - worst for pair in pairs if worst in pair)
        result[worst] = other, not _have_met(team, worst, other)
        pairs = {pair for pair in pairs if worst not in pair}
    return result


def _between(team: Sequence[Findings], i: int, j: int) -> tuple[Recognition, Recognition]:
    """What i sees of j's landmarks, and the other way round."""
    return team[i].recognised[j], team[j].recognised[i]


def _contradict(team: Sequence[Findings], i: int, j: int) -> bool:
    return any(one.offset is not None for one in _between(team, i, j))


def _have_met(team: Sequence[Findings], i: int, j: int) -> bool:
    return sum(one.agreed for one in _between(team, i, j)) >= MET


def _agreements(team: Sequence[Findings], i: int) -> int:
    """With how many others a robot agrees."""
    return sum(
        _have_met(team, i, j) and not _contradict(team, i, j) for j in range(len(team)) if j != i
    )


def verdict(
    team: Sequence[Findings],
    robot: int,
    wrong: dict[int, tuple[int, bool]],
    learnt: learnt_noise.Found,
) -> Verdict:
    """The verdict on one robot; `wrong` as `blamed` gives it, `learnt` of its noise."""
    told = _judged(team, robot, wrong, learnt)
    if not learnt.is_wrong or told.level == "noisier than told":
        return told
    cause, remedy = f"{told.cause}; and {learnt.cause}", f"{told.remedy}; {learnt.remedy}"
    return replace(told, cause=cause, remedy=remedy)


def with_place_unknown(
    told: Verdict, before: Verdict | None, pieces: Pieces, robot: int
) -> Verdict:
    """The verdict on a robot whose place in `map` is not known, unless there is worse to say.

    With the numbers of its piece and of the piece's last vote in any case. `before`: the verdict on
    which it was taken out of the map; None: it has not been in it.
    """
    told = replace(told, numbers=told.numbers | _of_piece(pieces, robot))
    name = told.robot
    if before is not None:
        return replace(
            told,
            level=before.level,
            cause=f"{before.cause}. It goes on in a map of its own until what it sees tells where "
            "it is; nothing of it is published",
            remedy=f"{before.remedy}; drive {name} where landmarks are known",
        )
    if told.level != "consistent":
        return told
    return replace(
        told,
        level=PLACE_UNKNOWN,
        cause=f"the place of {name} in map is not known yet: it has not seen enough of what is in "
        "the map",
        remedy=f"drive {name} where the map has landmarks, or give its start pose",
    )


def _of_piece(pieces: Pieces, robot: int) -> dict[str, float]:
    numbers, found = {"piece": float(pieces.of_robots[robot])}, pieces.vote_on(robot)
    if found is None:
        return numbers
    return numbers | {
        "vote: places that agree": float(found.things),
        "vote: places by another pose": float(found.runner_up),
        "vote: poses as good by chance": float(found.chance),
    }


def _judged(
    team: Sequence[Findings],
    robot: int,
    wrong: dict[int, tuple[int, bool]],
    learnt: learnt_noise.Found,
) -> Verdict:
    """As `verdict`, but for noise beside something worse."""
    own = team[robot]
    numbers = _numbers(own, robot) | learnt.numbers
    offset = own.recognised[robot].offset
    if offset is not None:
        return _lost(own, offset, "it knows", numbers)
    if own.in_view.evidence.is_alarming:
        return _out_of_sight(own, numbers)
    if robot in wrong:
        other, since_start = wrong[robot]
        offset = _offset(team, robot, other)
        if since_start and own.start is not None:
            return _start_wrong(own, own.start, team[other].name, offset, numbers)
        return _lost(own, offset, f"{team[other].name} mapped", numbers)
    if learnt.is_wrong:
        return Verdict(own.name, "noisier than told", learnt.cause, learnt.remedy, numbers)
    if own.innovations.evidence.is_alarming:
        return _noisier(own, numbers)
    return Verdict(own.name, "consistent", learnt.cause, learnt.remedy, numbers)


def _numbers(own: Findings, robot: int) -> dict[str, float]:
    others = [seen for other, seen in enumerate(own.recognised) if other != robot]
    return {
        "innovations: mean D below the gate": own.innovations.mean,
        "innovations: factor on standard deviations": own.innovations.factor,
        "own landmarks outside [share]": own.recognised[robot].outside,
        "others' landmarks outside [share]": max((seen.outside for seen in others), default=0.0),
        "seen again of those in view [share]": own.in_view.share,
        "evidence: innovations [of 1]": own.innovations.evidence.log / LOG_ALARM,
        "evidence: own landmarks [of 1]": own.recognised[robot].evidence.log / LOG_ALARM,
        "evidence: others' landmarks [of 1]": max(
            (seen.evidence.log / LOG_ALARM for seen in others), default=0.0
        ),
        "evidence: landmarks in view [of 1]": own.in_view.evidence.log / LOG_ALARM,
    }


def _offset(team: Sequence[Findings], robot: int, other: int) -> Alignment:
    """The motion that brings what is known through `robot` to where it is by `other`."""
    seen, known = (one.offset for one in _between(team, robot, other))
    if seen is not None:
        return seen
    assert known is not None, "robots contradict each other where one of them sees an offset"
    return known._replace(motion=increment(known.motion, np.zeros(3)))


def _with_offset(numbers: dict[str, float], offset: Alignment) -> dict[str, float]:
    x, y, yaw = offset.motion.tolist()
    told = {"offset x [m]": x, "offset y [m]": y, "offset yaw [rad]": yaw}
    agree = {"offset: landmarks that agree [share]": offset.inliers / offset.pairs}
    return numbers | told | agree


def _how_far(offset: Alignment, where: np.ndarray) -> str:
    """Of the motion at a place, for a turn moves what is far away farther."""
    x, y, yaw = _moved(offset, where) - where
    return f"{np.hypot(x, y):.2f} m and {abs(degrees(wrap(yaw))):.1f} degrees"


def _moved(offset: Alignment, pose: np.ndarray) -> np.ndarray:
    moved = offset.motion[:, None].copy()
    move(moved, pose[:, None])
    return np.array([*moved[:2, 0], wrap(moved[2, 0])])


def _start_wrong(
    own: Findings, start: np.ndarray, other: str, offset: Alignment, numbers: dict[str, float]
) -> Verdict:
    name = own.name
    x, y, yaw = _moved(offset, start)
    off, turn = np.hypot(x - start[0], y - start[1]), abs(wrap(yaw - start[2]))
    cause = (
        f"the start of {name} is off by {_how_far(offset, start)} relative to the map of "
        f"{other}: {offset.inliers} of {offset.pairs} landmarks agree on that"
    )
    remedy = (
        f"set start_poses of {name} to [{x:.2f}, {y:.2f}, {yaw:.3f}], or its start_sigma to "
        f"[{off:.2f}, {turn:.2f}] or more if it is not known better"
    )
    return Verdict(name, "start wrong", cause, remedy, _with_offset(numbers, offset))


def _lost(own: Findings, offset: Alignment, whose: str, numbers: dict[str, float]) -> Verdict:
    cause = (
        f"{own.name} sees landmarks that {whose} "
        f"{_how_far(offset, own.innovations.pose)} from where they are, by {offset.inliers} of "
        f"{offset.pairs} landmarks: it was carried away, or its wheels slipped"
    )
    return Verdict(own.name, "lost", cause, _found_out(own), _with_offset(numbers, offset))


def _out_of_sight(own: Findings, numbers: dict[str, float]) -> Verdict:
    cause = (
        f"{own.name} sees other landmarks at once, and none of those that it must have in view: "
        "carried away, or its wheels slipped"
    )
    return Verdict(own.name, "lost", cause, _found_out(own), numbers)


def _found_out(own: Findings) -> str:
    """The remedy for a robot that is lost, which by itself the fusion looks for."""
    name = own.name
    return f"see why the odometry of {name} did not tell: do not lift a robot, or let wheels slip"


def _noisier(own: Findings, numbers: dict[str, float]) -> Verdict:
    factor = own.innovations.factor
    cause = (
        f"what {own.name} sees lies {factor:.1f} times as far from where it is expected as the "
        "noise that was told allows"
    )
    remedy = (
        "raise the noise of its odometry (filter.motion) or of its observations (their "
        "covariances) by this factor, or calibrate it"
    )
    return Verdict(own.name, "noisier than told", cause, remedy, numbers)
