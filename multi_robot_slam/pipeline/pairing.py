"""What one robot has sent and the filter has not used yet, paired into frames."""

from collections import deque
from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np

from msg_defs.types import (
    DESCRIPTOR_SIZE,
    Event,
    Frame,
    FrameCount,
    ObservationSet,
    PoseSample,
    Sightings,
)
from multi_robot_slam.config import Config
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.pipeline.losses import Losses, Missing
from multi_robot_slam.pipeline.odometry import Odometry
from multi_robot_slam.pipeline.plausibility import Refusal
from multi_robot_slam.pipeline.start import start_of

NO_FRAME = Refusal("sighting without a frame", "send a cloud with the sightings, even an empty one")


ODOMETRY, FRAMES = "lost odometry", "lost frames"
"""What never arrived, as it is counted."""


class RobotInputs:
    """One robot's streams: odometry, observations, and sightings where it sends them."""

    def __init__(self, index: int, config: Config, drop: Callable[[Event, Refusal], None]) -> None:
        self.index = index
        self.name = config.robots[index]
        self.waiting: deque[Frame] = deque()
        self.newest_ns = -1
        """Stamp of the newest frame heard of, used or not [ns]."""
        self.sightings_ns = -1
        self.frames = FrameCount(0, 0)
        self.odometry = Odometry(config.plausible, config.filter.motion, drop)
        self.losses = {kind: Losses(config.apart_ns) for kind in (ODOMETRY, FRAMES)}
        self._drop = drop
        self._config = config
        self._mount = config.mount_of(index)
        self._correlated = np.float32(config.filter.correlated)
        self._sends_sightings = config.sightings
        self._sightings: deque[Sightings] = deque()

    def hear(self, event: Event) -> list[tuple[str, Missing]]:
        """Note that an event arrived, whether or not it can be used; what is lost of its kind."""
        kind = _kind(event)
        if kind == FRAMES:
            self.newest_ns = max(self.newest_ns, event.stamp_ns)
        return [(kind, one) for one in self.losses[kind].hear(event.stamp_ns)] if kind else []

    def excuse(self, event: Event) -> None:
        """An event is not used because of its stamp: it will be missing where it belongs."""
        if kind := _kind(event):
            self.losses[kind].excuse()

    def rest(self) -> list[tuple[str, Missing]]:
        """Nothing more comes; what is lost."""
        return [(kind, one) for kind, losses in self.losses.items() for one in losses.end()]

    def ready_ns(self, horizon_ns: int) -> int:
        """Stamp of the newest frame all of which has arrived, -1 when there is none [ns].

        Sightings are not waited for at `horizon_ns` and before.
        """
        complete = min(self.newest_ns, self.odometry.newest_ns)
        if self._sends_sightings:
            complete = min(complete, max(self.sightings_ns, horizon_ns))
        return complete

    def has_frame(self, until_ns: int) -> bool:
        """The oldest waiting frame is complete; one up to `until_ns` need not have sightings."""
        return bool(self.waiting) and self.waiting[0].stamp_ns <= self.ready_ns(until_ns)

    def is_stuck(self, horizon_ns: int) -> bool:
        """The oldest waiting frame is older than `horizon_ns` and its odometry has not come."""
        newest_ns = self.odometry.newest_ns
        return bool(self.waiting) and newest_ns < self.waiting[0].stamp_ns < horizon_ns

    def take(self, event: Event) -> None:
        """Keep an event that is newer than the last of its kind."""
        if isinstance(event, PoseSample):
            self.odometry.take(event)
        elif isinstance(event, Sightings):
            self._sightings.append(event)
            self.sightings_ns = event.stamp_ns
        else:
            self.waiting.append(event)

    def sightings_at(self, stamp_ns: int) -> Sightings | None:
        """Take the sightings at `stamp_ns`; older ones are dropped."""
        self.drop_sightings(stamp_ns - 1)
        if self._sightings and self._sightings[0].stamp_ns == stamp_ns:
            return self._sightings.popleft()
        return None

    def drop_sightings(self, until_ns: int) -> None:
        """Give up the sightings up to `until_ns`: no frame will come for them any more."""
        while self._sightings and self._sightings[0].stamp_ns <= until_ns:
            self._drop(self._sightings.popleft(), NO_FRAME)

    def frame(
        self, stamp_ns: int, observations: ObservationSet | None, sightings: Sightings | None
    ) -> RobotFrame:
        """The frame at `stamp_ns`, with the motion since the one used before.

        Until one was used, with where the robot starts. Without `observations` it is an empty one.
        Odometry must have reached `stamp_ns`.
        """
        moved = self.odometry.motion_to(stamp_ns)
        seen = _nothing(self.name, stamp_ns) if observations is None else observations
        if self._correlated != 1:
            seen = replace(seen, covariances=self._correlated * seen.covariances)
        start = None
        if not self.odometry.has_begun:
            start = start_of(self.index, stamp_ns, self.odometry, self._config)
        return RobotFrame.from_camera(
            self.index,
            moved.motion,
            moved.seconds,
            seen,
            self._mount,
            sightings,
            moved.extra,
            start,
        )

    def count(self, seen: int = 0, used: int = 0) -> None:
        """Frames that were seen or used, besides those counted before."""
        self.frames = FrameCount(self.frames.seen + seen, self.frames.used + used)


def _kind(event: Event) -> str:
    """What is lost where such an event never arrives; empty: nothing that is counted."""
    if isinstance(event, Sightings):
        return ""
    return ODOMETRY if isinstance(event, PoseSample) else FRAMES


def only(sightings: Sightings | None, robots: Collection[int]) -> Sightings | None:
    """The sightings of `robots` (indices in the team)."""
    if sightings is None:
        return None
    rows = np.isin(sightings.others, list(robots))
    return replace(
        sightings,
        others=sightings.others[rows],
        positions=sightings.positions[rows],
        covariances=sightings.covariances[rows],
    )


def _nothing(robot: str, stamp_ns: int) -> ObservationSet:
    empty = (np.empty((0, size), np.float32) for size in (3, 6, DESCRIPTOR_SIZE))
    return ObservationSet(robot, stamp_ns, *empty)
