"""Which robots belong together: a piece is robots and landmarks in a frame of their own.

Nothing in one piece says where anything in another is, until both are tied (`tying`).

A robot that was lost goes on as another one (`losing`): what the filter calls a robot is one of the
team between two losses. So there may be more robots than the team has.
"""

from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np

from multi_robot_slam.filter.vote import Vote
from multi_robot_slam.models.frames import BodySightings, Record, RobotFrame

MAP = 0
"""The piece whose frame is `map`."""

Framed = TypeVar("Framed", RobotFrame, Record)


class Pieces(NamedTuple):
    """The pieces of a team of K robots; landmarks know theirs themselves."""

    of_robots: np.ndarray
    """(K,) int64."""
    team: np.ndarray
    """(K,) int64: which one of the team each is; of several that are the same the last one goes on,
    the others have no more frames."""
    votes: tuple[tuple[int, int, Vote], ...] = ()
    """Those in a row that were believed, of each two pieces, oldest first."""
    pairs: np.ndarray = np.empty((0, 2), np.int64)
    """(n, 2) ids of landmarks that are one by the last tie, until smoothing has joined them."""

    last: tuple[tuple[int, int, Vote], ...] = ()
    """The newest of each two pieces, believed or not, where any landmarks agreed."""

    @classmethod
    def of_starts(cls, are_known: np.ndarray) -> "Pieces":
        """Each robot whose start is not among those that `are_known` (K,) is a piece of its own."""
        robots = np.arange(len(are_known))
        return cls(np.where(are_known, MAP, robots + 1), robots)

    def with_another(self, robot: int) -> "Pieces":
        """With another robot after the others, in a piece of its own: `robot` from now on."""
        of_robots = np.append(self.of_robots, self.of_robots.max() + 1)
        return self._replace(of_robots=of_robots, team=np.append(self.team, self.team[robot]))

    def bits_of_team(self, robots: np.ndarray) -> np.ndarray:
        """Bits (n,) of the team, of those of the robots."""
        bits = np.zeros_like(robots)
        for robot, own in enumerate(self.team.tolist()):
            bits |= ((robots >> robot) & 1) << own
        return bits

    @property
    def numbers(self) -> list[int]:
        """Of the pieces, ascending: `MAP`, which may have landmarks alone, and those of robots."""
        return np.union1d(MAP, self.of_robots).tolist()

    @property
    def are_many(self) -> bool:
        """There is more than one."""
        return len(self.numbers) > 1

    def with_vote(self, first: int, second: int, found: Vote | None) -> "Pieces":
        """After two pieces have voted."""
        others = tuple(own for own in self.last if own[:2] != (first, second))
        return self._replace(last=others if found is None else (*others, (first, second, found)))

    def vote_on(self, robot: int) -> Vote | None:
        """What the landmarks of the piece of `robot` said last of its place in `map`."""
        both = (MAP, int(self.of_robots[robot]))
        return next((found for *pieces, found in self.last if tuple(pieces) == both), None)

    @property
    def robots_in_map(self) -> np.ndarray:
        """(K,) bool: the robots whose place in `map` is known."""
        return self.of_robots == MAP

    def when_joined(self) -> "Pieces":
        """After smoothing."""
        return self._replace(pairs=self.pairs[:0])

    def within(self, frame: Framed) -> Framed:
        """The frame with sightings of robots of its own piece alone."""
        seen = frame.sightings
        own = self.of_robots[seen.others] == self.of_robots[frame.robot]
        if own.all():
            return frame
        return replace(frame, sightings=BodySightings(*(values[own] for values in seen)))
