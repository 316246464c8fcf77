"""Where a robot's way may be broken: moments since when it saw nothing again of what it had known.

A robot that drives sees in each frame what it saw in frames before. One that was carried away sees
other landmarks at once; the frames since hang together, and nothing but its odometry ties them to
those before. Sooner or later a robot that was not carried sees something from before again.
"""

from typing import NamedTuple

import numpy as np

from multi_robot_slam.filter.losing import Misled

HOLD = 3
"""Landmarks from before that a frame must match to be tied to them. One may be a wrong match: of
another one that looks alike, and lies where it should by chance."""

LEAST = 6
"""Observations of a frame in which nothing that is known tells anything."""


class Break(NamedTuple):
    """A frame that is tied to nothing from before, as those since."""

    stamp_ns: int
    first_id: int
    """Of the landmarks that were made since."""


class Continuity:
    """The breaks in the way of one robot."""

    def __init__(self) -> None:
        self.breaks: list[Break] = []
        """Oldest first."""
        self._has_begun = False

    def note(self, stamp_ns: int, matches: np.ndarray, new_ids: np.ndarray) -> None:
        """Take a frame with the landmark of each observation (B,), and the ids it might make."""
        known = np.sort(matches[matches != new_ids])
        if len(known) >= HOLD:
            self.breaks = [each for each in self.breaks if each.first_id <= known[HOLD - 1]]
        elif self._has_begun and len(matches) >= LEAST:
            self.breaks.append(Break(stamp_ns, int(new_ids[0])))
        self._has_begun |= len(matches) > 0

    def is_broken_at(self, stamp_ns: int) -> bool:
        """Whether that frame is tied to nothing from before it."""
        return len(self.breaks) > 0 and self.breaks[-1].stamp_ns == stamp_ns

    def misled(self, seen_ns: int) -> Misled:
        """Where its odometry misled the robot that was not where it seemed at `seen_ns`."""
        stamps = [own.stamp_ns for own in self.breaks]
        first_ns = max((own for own in stamps if own <= seen_ns), default=seen_ns)
        return Misled(first_ns, max(first_ns, *stamps, first_ns))
