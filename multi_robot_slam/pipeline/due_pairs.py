"""Which pairs of pictures are worth looking at: those that the filter may make a keyframe of."""

from collections import deque

from msg_defs.types import PoseSample
from multi_robot_slam.config import Config
from multi_robot_slam.front_end.sync import Pair
from multi_robot_slam.pipeline.keyframes import Keyframes
from multi_robot_slam.pipeline.odometry import Odometry

PATIENCE_NS = 10**9
"""So far behind the newest pair odometry may be; then pairs are looked at without it."""

MOST_UNPLACED = 1000
"""Pairs that were looked at before odometry came, and that may have been keyframes."""

_ONLY = 0
"""The one robot, in a list of its own."""


class DuePairs:
    """Chooses among one robot's pairs by its odometry, as the filter will choose its keyframes.

    The rule is `Keyframes` on odometry interpolated at the pair's stamp, both the filter's own: a
    pair that is given out is a keyframe there unless the filter lost the one before. A pair waits
    until odometry has come so far. A robot that rests has one looked at every `rest_s`, so that a
    filter that begins later has seen something before the robot moves. Without odometry, where
    every frame is to be a step, and where robots see robots, whose motion decides as well, all
    pairs are due.
    """

    def __init__(self, config: Config) -> None:
        self.passed_over = 0
        self._config = config
        self._chooses = config.keyframe.is_on and not config.sightings
        self._rest_ns = round(config.camera.rest_s * 1e9)
        self._begin()

    def _begin(self) -> None:
        self._odometry = Odometry(
            self._config.plausible, self._config.filter.motion, lambda sample, refusal: None
        )
        self._keyframes = Keyframes(self._config.keyframe)
        self._undecided: deque[Pair] = deque()
        self._unplaced: deque[int] = deque(maxlen=MOST_UNPLACED)
        self._given_out_ns = -self._rest_ns
        self._newest_ns = 0

    def take(self, pair: Pair) -> list[Pair]:
        """Take a pair; those that are due now, oldest first."""
        if not self._chooses:
            return [pair]
        if pair.stamp_ns < self._newest_ns - self._config.apart_ns:
            self._begin()  # time went back
        self._newest_ns = pair.stamp_ns
        self._undecided.append(pair)
        return self._decided()

    def move(self, sample: PoseSample) -> list[Pair]:
        """Take odometry; the pairs that are due now, oldest first."""
        if not self._chooses:
            return []
        if sample.stamp_ns < self._odometry.newest_ns - self._config.apart_ns:
            self._begin()
        if not self._odometry.is_late(sample.stamp_ns):
            self._odometry.take(sample)
        return self._decided()

    def rest(self) -> list[Pair]:
        """No more odometry comes: what is undecided is due."""
        left = [*self._undecided]
        self._undecided.clear()
        return left

    def _decided(self) -> list[Pair]:
        due = []
        while self._undecided and self._can_decide(self._undecided[0].stamp_ns):
            pair = self._undecided.popleft()
            if self._is_due(pair.stamp_ns):
                self._given_out_ns = pair.stamp_ns
                due.append(pair)
            else:
                self.passed_over += 1
        return due

    def _can_decide(self, stamp_ns: int) -> bool:
        odometry_ns = self._odometry.newest_ns
        is_overdue = stamp_ns <= self._newest_ns - PATIENCE_NS
        return odometry_ns < 0 or stamp_ns <= odometry_ns or is_overdue

    def _is_due(self, stamp_ns: int) -> bool:
        if self._odometry.newest_ns < stamp_ns:
            self._unplaced.append(stamp_ns)
            return True
        while self._unplaced:
            self._is_keyframe(self._unplaced.popleft())
        return self._is_keyframe(stamp_ns) or stamp_ns >= self._given_out_ns + self._rest_ns

    def _is_keyframe(self, stamp_ns: int) -> bool:
        pose = self._odometry.at(stamp_ns)
        if not self._keyframes.is_due(_ONLY, pose, {}):
            return False
        self._keyframes.use(_ONLY, pose, {})
        return True
