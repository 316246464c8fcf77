"""What a gap in a robot's odometry hides of its motion."""

import math
from typing import NamedTuple

import numpy as np

from multi_robot_slam.models.motion import MotionSettings, increment

STRETCH_S = 0.25
"""Speeds are means over so long at least; few robots change theirs much within it."""

MEMORY_S = 30.0
"""Speeds count for e times less after so long: a way with some bends in it."""


class Instant(NamedTuple):
    """A pose of the odometry."""

    stamp_ns: int
    pose: np.ndarray
    """(3,): x, y [m], yaw [rad]."""


class Rates(NamedTuple):
    """A robot's speed, along [m/s], backwards below 0, and turn rate [rad/s], (2,) each.

    Of stretches of `STRETCH_S`, long enough that wheels and stamps hardly err; means over time,
    weighted by `MEMORY_S`.
    """

    since: Instant
    """Where the stretch that is not complete began."""
    last: np.ndarray
    """Of the last stretch."""
    mean: np.ndarray
    square: np.ndarray
    """Mean square."""
    weight_s: float
    changing: np.ndarray
    """Mean square of their change in a second, as a random walk."""
    changing_s: float
    last_s: float
    """How long the last stretch was; 0: the one before `since` is not known [s]."""

    @classmethod
    def unknown(cls, since: Instant) -> "Rates":
        """Of a robot that was never seen to move."""
        none = np.zeros(2)
        return cls(since, none, none, none, 0.0, none, 0.0, 0.0)

    @property
    def variance(self) -> np.ndarray:
        return np.maximum(self.square - self.mean * self.mean, 0)

    def across(self, now: Instant) -> "Rates":
        """The same after a gap that ends `now`."""
        return self._replace(since=now, last_s=0.0)

    def until(self, now: Instant) -> "Rates":
        """These, when the robot is heard of `now`."""
        seconds = (now.stamp_ns - self.since.stamp_ns) / 1e9
        if seconds < STRETCH_S:
            return self
        rates = rates_of(increment(self.since.pose, now.pose), seconds)
        fading = math.exp(-seconds / MEMORY_S)
        weight_s, changing_s = fading * self.weight_s + seconds, fading * self.changing_s
        changing = self.changing
        if self.last_s:
            apart_s = (seconds + self.last_s) / 2
            changing_s += seconds
            change = np.square(rates - self.last) / apart_s
            changing = changing + seconds / changing_s * (change - changing)
        share = seconds / weight_s
        return Rates(
            now,
            rates,
            self.mean + share * (rates - self.mean),
            self.square + share * (rates * rates - self.square),
            weight_s,
            changing,
            changing_s,
            seconds,
        )


def rates_of(motion: np.ndarray, seconds: float) -> np.ndarray:
    """(2,): mean speed [m/s], backwards below 0, and turn rate [rad/s] of a motion (3,)."""
    return np.array([math.copysign(math.hypot(*motion[:2]), motion[0]), motion[2]]) / seconds


class Gap(NamedTuple):
    """Two successive samples that are further apart than usual."""

    start: Instant
    end: Instant
    before: Rates
    """How fast the robot was until then."""
    is_reset: bool = False
    """The odometry began anew: nothing is known of the motion, which is told as none."""

    def hidden(self, begin: Instant, end: Instant, noise: MotionSettings) -> np.ndarray:
        """Variances (3,) of the motion from `begin` to `end` that (7) does not tell.

        Both are interpolated; seen from the pose at `begin` [m^2, m^2, rad^2]. (G1) to (G6).
        """
        first, last = self._share(begin.stamp_ns), self._share(end.stamp_ns)
        covered = last - first
        if covered <= 0:
            return np.zeros(3)
        unknown = self._reset() if self.is_reset else self._between(noise)
        direction, heading = (angle - begin.pose[2] for angle in self._angles())
        way = increment(begin.pose, end.pose)
        arms = [way - increment(begin.pose, self._at(share)) for share in (first, last)]
        off = 4 * covered * (1 - covered) * unknown.middle  # (G3)
        off_at_begin = 4 * first * (1 - first) * unknown.middle[2]
        position = (
            _seen(off, direction)
            + _seen(covered * unknown.wheels, heading)
            + off_at_begin * _swung(way, way)
            + covered * unknown.turned * _swung(*arms)  # (G5)
        )
        return np.append(position, off[2] + covered * unknown.wheels[2])

    def _between(self, noise: MotionSettings) -> "_Unknown":
        """Where the wheels tell the motion from end to end."""
        chord, turn, seconds = *self._moved(), self._seconds
        length, turning = self._way()
        own, before = np.array([chord, turn]) / seconds, self.before
        wander = np.minimum(before.changing * seconds / 2, 2 * before.variance)
        along, yaw = np.sqrt(wander + 4 * np.square(own - before.last)) * seconds / 4  # (G2)
        across = length * math.hypot(turn, math.sqrt(8) * yaw) / 8  # (G2)
        forward, left = noise.forward_per_sqrt_m**2, noise.left_per_sqrt_m**2
        by_way, by_turn = noise.yaw_per_sqrt_m**2, noise.yaw_per_sqrt_rad**2
        longer, leak = length - abs(chord), length * min(turning**2 / 3, 1)
        wheels = (  # (G4)
            forward * longer + left * leak,
            left * longer + forward * leak,
            by_way * longer + by_turn * (turning - abs(turn)),
        )
        turned = by_way * length + by_turn * turning + noise.yaw_per_sqrt_s**2 * seconds
        return _Unknown(np.square([along, across, yaw]), np.array(wheels), turned)

    def _reset(self) -> "_Unknown":
        """As far as the robot goes in the time, in any direction (G6)."""
        length, turning = self._way()
        turned = min(turning**2, math.pi**2 / 3)
        return _Unknown(np.zeros(3), np.array([length**2 / 2, length**2 / 2, turned]), turned)

    def with_next(self, gap: "Gap") -> "Gap":
        """One gap instead of this and the next, which tells less: what lies between is unknown."""
        return self._replace(end=gap.end, is_reset=self.is_reset or gap.is_reset)

    @property
    def _seconds(self) -> float:
        return (self.end.stamp_ns - self.start.stamp_ns) / 1e9

    def _moved(self) -> tuple[float, float]:
        """The chord [m], backwards below 0, and the turn [rad]."""
        chord, turn = rates_of(increment(self.start.pose, self.end.pose), 1.0).tolist()
        return chord, turn

    def _way(self) -> tuple[float, float]:
        """How long the way is [m] and how far turned [rad]: as fast as before, or faster (G1)."""
        chord, turn = self._moved()
        speed, rate = np.sqrt(self.before.square).tolist()
        return max(abs(chord), speed * self._seconds), max(abs(turn), rate * self._seconds)

    def _angles(self) -> tuple[float, float]:
        """Direction of the chord and heading at its start [rad]."""
        dx, dy = (self.end.pose - self.start.pose)[:2].tolist()
        return math.atan2(dy, dx), float(self.start.pose[2])

    def _share(self, stamp_ns: int) -> float:
        """Of the gap's time, up to `stamp_ns`: 0 to 1."""
        whole_ns = self.end.stamp_ns - self.start.stamp_ns
        return min(max(stamp_ns - self.start.stamp_ns, 0), whole_ns) / whole_ns

    def _at(self, share: float) -> np.ndarray:
        """The pose (3,) so far along the chord; with the heading at its start."""
        return self.start.pose + share * (self.end.pose - self.start.pose) * (1, 1, 0)


class _Unknown(NamedTuple):
    """What is not known of a gap, as variances [m^2, m^2, rad^2]."""

    middle: np.ndarray
    """(3,): of the pose in the middle, along the chord, across it, and of the yaw."""
    wheels: np.ndarray
    """(3,): of the motion from end to end, along and across the heading at its start."""
    turned: float
    """Of the heading at the end, all in all."""


def _seen(variances: np.ndarray, angle: float) -> np.ndarray:
    """(2,): variances of x and y, given those along an axis at `angle` to x, and across."""
    along, across = variances[:2].tolist()
    cos, sin = math.cos(angle) ** 2, math.sin(angle) ** 2
    return np.array([cos * along + sin * across, sin * along + cos * across])


def _swung(first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """(2,): squares of how far a small turn moves x and y, their mean over arms between two."""
    squares = (first * first + first * last + last * last) / 3
    return squares[1::-1]
