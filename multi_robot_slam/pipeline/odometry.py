"""One robot's odometry: what of it is possible, and its motion from one frame to the next."""

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from msg_defs.types import PoseSample
from multi_robot_slam.config import Plausible
from multi_robot_slam.models.motion import NO_EXTRA, MotionSettings, increment, move, wrap
from multi_robot_slam.pipeline.gaps import STRETCH_S, Gap, Instant, Rates
from multi_robot_slam.pipeline.intervals import Intervals
from multi_robot_slam.pipeline.plausibility import Refusal

MOST_SAMPLES = 20_000
"""Kept for frames to come: minutes at any usual rate."""

MOST_GAPS = 32
"""Known one by one between two frames; of more the oldest are taken for a longer one."""

SAMPLES_OF_A_RESET = 3
"""Samples that agree with each other, and not with those before, are odometry that was reset."""

STAMP_ERROR_S = 0.01
"""How much longer than its stamps say a motion may have taken."""

NOT_KEPT = Refusal("odometry not kept", f"{MOST_SAMPLES} samples wait for a frame; send frames")
JUMP = Refusal(
    "odometry jump", "no robot is that fast; correct it, or raise plausible.fastest_m_s, _rad_s"
)
AHEAD = Refusal("odometry stamp ahead", "an older sample came after it; correct the robot's clock")
RESET = Refusal(
    "odometry reset",
    "the robot goes on from where it was, less certain by what it may have driven meanwhile; do "
    "not reset odometry",
)


class Sample(NamedTuple):
    """A sample that was taken."""

    stamp_ns: int
    pose: np.ndarray
    """(3,) in the frame of the first sample: resets leave no jump."""
    origin: np.ndarray | None
    """(3,) pose of the robot's own frame `odom` in that frame; None until the first reset."""
    rates: Rates
    """How fast the robot was up to here."""
    covariance: np.ndarray | None
    """(3, 3) of `pose` as the driver tells it; None since the first reset."""

    def in_odom(self, pose: np.ndarray) -> np.ndarray:
        """A `pose` (3,) of the frame of the first sample in the robot's own."""
        return pose if self.origin is None else increment(self.origin, pose)


class Motion(NamedTuple):
    """How a robot moved between two instants."""

    motion: np.ndarray
    """(3,): u in the `base_link` of the first [m, m, rad]."""
    seconds: float
    extra: np.ndarray
    """(3,): standard deviations of what gaps hide [m, m, rad]."""


class Odometry:
    """Takes a robot's odometry in the order of its stamps.

    A sample that is further from the last than any robot moves is doubted. If the next samples stay
    there, the odometry was reset: the robot goes on from where it was. Otherwise it is dropped. A
    sample that an older one follows was stamped ahead: it is taken back. Where successive samples
    are further apart than usual, there is a gap, and a motion across it knows less.

    Parameters
    ----------
    limits : how fast a robot can be.
    noise : of the wheels, as (7) has it.
    tell : called with each sample that is dropped, or where the odometry was reset, and why.

    """

    def __init__(
        self, limits: Plausible, noise: MotionSettings, tell: Callable[[PoseSample, Refusal], None]
    ) -> None:
        self._limits = limits
        self._noise = noise
        self._tell = tell
        self._samples: deque[Sample] = deque()
        self._last: PoseSample | None = None
        self._before_last: PoseSample | None = None
        self._doubted: list[PoseSample] = []
        self._origin: np.ndarray | None = None
        self._intervals = Intervals()
        self._gaps: list[Gap] = []
        """Those after the frame that was used last."""
        self._first: Instant | None = None
        self._used: Instant | None = None
        self._reached = Instant(0, np.zeros(3))
        self._pose_in_odom = np.zeros(3)
        self._reached_in_odom = np.zeros(3)

    @property
    def newest_ns(self) -> int:
        """Stamp up to which the odometry is known, -1 when there is none [ns]."""
        return -1 if self._last is None else self._last.stamp_ns

    @property
    def newest(self) -> PoseSample | None:
        """The last sample that was taken and is not doubted."""
        return self._last

    @property
    def first(self) -> Instant:
        """The first sample; there must be one."""
        if self._first is None:
            raise ValueError("no odometry came yet")
        return self._first

    @property
    def has_begun(self) -> bool:
        """A frame was used."""
        return self._used is not None

    @property
    def used_pose(self) -> np.ndarray:
        """(3,): the robot's pose in its own frame `odom` at the last frame that was used."""
        return self._pose_in_odom

    def is_late(self, stamp_ns: int) -> bool:
        """A sample of that stamp is older than the last two, or than one that was used already."""
        if stamp_ns > self.newest_ns:
            return False
        before = self._before_last
        is_known = stamp_ns in (self.newest_ns, -1 if before is None else before.stamp_ns)
        return is_known or before is None or len(self._samples) < 2 or stamp_ns < before.stamp_ns

    def take(self, sample: PoseSample) -> None:
        """Take a sample that is not late."""
        if self._doubted and sample.stamp_ns <= self._doubted[-1].stamp_ns:
            self.drop_doubted()
        if sample.stamp_ns <= self.newest_ns:
            self._take_back()
        if self._doubted and self._is_possible(self._doubted[-1], sample):
            self._doubted.append(sample)
            if len(self._doubted) == SAMPLES_OF_A_RESET:
                self._reset()
        elif self._last is None or self._is_possible(self._last, sample):
            self.drop_doubted()
            self._keep(sample)
        else:
            self.drop_doubted()
            self._doubted.append(sample)

    def drop_doubted(self) -> None:
        """Give up the samples that nothing has confirmed."""
        for sample in self._doubted:
            self._tell(sample, JUMP)
        self._doubted.clear()

    def at(self, stamp_ns: int) -> np.ndarray:
        """The pose (3,), interpolated at `stamp_ns`; before the first sample, the first.

        In the frame of the first sample of all. Odometry must have reached `stamp_ns`, and no
        stamp before it is asked for any more.
        """
        samples = self._samples
        while len(samples) > 1 and samples[1].stamp_ns <= stamp_ns:
            samples.popleft()
        first = samples[0]
        if len(samples) == 1 or first.stamp_ns >= stamp_ns:
            return first.pose
        share = (stamp_ns - first.stamp_ns) / (samples[1].stamp_ns - first.stamp_ns)
        difference = samples[1].pose - first.pose
        difference[2] = wrap(difference[2])
        return first.pose + share * difference

    def covariance_at(self, stamp_ns: int) -> np.ndarray | None:
        """Covariance (3, 3) of the pose at `stamp_ns`, as the driver tells it; see `at`.

        Of the sample after it, which is the less certain. None after a reset: it is of another way.
        """
        self.at(stamp_ns)
        is_between = len(self._samples) > 1 and self._samples[0].stamp_ns < stamp_ns
        return self._samples[1 if is_between else 0].covariance

    def motion_to(self, stamp_ns: int) -> Motion:
        """Motion since the frame that was used last.

        Zero as long as none was: where the robot is then, `start` tells. See `at` for `stamp_ns`.
        """
        pose = self.at(stamp_ns)
        self._reached = Instant(stamp_ns, pose)
        self._reached_in_odom = self._samples[0].in_odom(pose)
        if self._used is None:
            return Motion(np.zeros(3), 0.0, NO_EXTRA)
        return self._motion(self._reached)

    def motion_to_newest(self) -> Motion:
        """Motion from the frame that was used last to the newest sample.

        There must have been such a frame; the time is negative where the sample is older.
        """
        newest = self._samples[-1]
        return self._motion(Instant(newest.stamp_ns, newest.pose))

    def use(self) -> None:
        """The motion asked for last was used: the next one begins where it ended."""
        self._used = used = self._reached
        self._gaps = [gap for gap in self._gaps if gap.end.stamp_ns > used.stamp_ns]
        self._pose_in_odom = self._reached_in_odom

    def _motion(self, end: Instant) -> Motion:
        begin = self._used
        if begin is None:
            raise ValueError("no frame was used yet")
        hidden = [gap.hidden(begin, end, self._noise) for gap in self._gaps]
        extra = np.sqrt(np.sum(hidden, axis=0)) if hidden else NO_EXTRA
        seconds = (end.stamp_ns - begin.stamp_ns) / 1e9
        return Motion(increment(begin.pose, end.pose), seconds, extra)

    def _take_back(self) -> None:
        """Drop the last sample."""
        if self._last is not None:
            self._tell(self._last, AHEAD)
        taken = self._samples.pop()
        if not self._samples:
            self._first = None
        self._intervals.take_back()
        if self._gaps and self._gaps[-1].end.stamp_ns == taken.stamp_ns:
            self._gaps.pop()
        self._last, self._before_last = self._before_last, None

    def _is_possible(self, before: PoseSample, after: PoseSample) -> bool:
        seconds = (after.stamp_ns - before.stamp_ns) / 1e9 + STAMP_ERROR_S
        dx, dy, turn = after.pose - before.pose
        is_slow = np.hypot(dx, dy) <= self._limits.fastest_m_s * seconds
        return bool(is_slow and np.abs(wrap(turn)) <= self._limits.fastest_rad_s * seconds)

    def _keep(self, sample: PoseSample, is_reset: bool = False) -> None:
        pose, origin = sample.pose, self._origin
        if origin is not None:
            pose = _composed(origin, pose)
        now = Instant(sample.stamp_ns, pose)
        covariance = sample.covariance if origin is None else None
        rates = self._rates_until(now, is_reset)
        self._samples.append(Sample(sample.stamp_ns, pose, origin, rates, covariance))
        self._first = self._first or now
        self._before_last, self._last = self._last, sample
        if len(self._samples) > MOST_SAMPLES:
            self._samples.popleft()
            self._tell(sample, NOT_KEPT)

    def _rates_until(self, now: Instant, is_reset: bool) -> Rates:
        """How fast the robot was; what it did in a gap, which is noted, nobody knows."""
        if not self._samples:
            return Rates.unknown(now)
        before = self._samples[-1]
        interval_ns = now.stamp_ns - before.stamp_ns
        is_gap = is_reset or interval_ns > self._intervals.longest_ns
        self._intervals.add(interval_ns)
        if is_gap:
            start = Instant(before.stamp_ns, before.pose)
            self._gaps.append(Gap(start, now, before.rates, is_reset))
            if len(self._gaps) > MOST_GAPS:
                self._gaps[:2] = [self._gaps[0].with_next(self._gaps[1])]
        is_long = is_reset or (is_gap and interval_ns > STRETCH_S * 1e9)
        return before.rates.across(now) if is_long else before.rates.until(now)

    def _reset(self) -> None:
        first = self._doubted[0]
        self._tell(first, RESET)
        self._origin = _composed(self._samples[-1].pose, increment(first.pose, np.zeros(3)))
        for sample in self._doubted:
            self._keep(sample, is_reset=sample is first)
        self._doubted.clear()


def _composed(pose: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """The pose (3,) after a motion (3,) seen from `pose` (3,)."""
    result = pose[:, None].copy()
    move(result, motion[:, None])
    return result[:, 0]
