"""The order of time: frames leave by (stamp, robot), however their messages arrived.

A frame waits until every active robot has sent one at least as new, or until the newest is
`reorder_window_s` ahead. Time is message time throughout, so a recorded run gives the live run's
estimates. Keyframes of one stamp make one step (`keyframes`); the other frames are passed over, not
even decoded. Each robot that is seen in a keyframe has a frame in the step, too: its own of that
instant, or one without observations.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from msg_defs.types import Event, Frame, ObservationSet, PoseSample, Sightings
from multi_robot_slam.config import Config
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.pipeline.keyframes import Keyframes
from multi_robot_slam.pipeline.losses import Missing
from multi_robot_slam.pipeline.pairing import NO_FRAME, RobotInputs, only
from multi_robot_slam.pipeline.plausibility import Refusal

LATE_REMEDY = "raise reorder_window_s, or synchronise the robots' clocks"
NO_ODOMETRY = Refusal("frame without odometry", "send odometry with every frame")
LOST_REMEDY = "they never arrived: look at the network, the queues, and who records"
LATE_FRAME = Refusal("late frame", LATE_REMEDY)
UNPLACED = "sighting of a robot without odometry"


class Reorder:
    """Takes what a team sends and gives out the frames of one instant after the other.

    Parameters
    ----------
    drop : called with each event that cannot be used, and why.
    open_frame : decodes and checks a frame that is to be used; None, and dropped, if it cannot be.
    lose : called with what never arrived: the reason, a line that tells of it, and how many.

    """

    def __init__(
        self,
        config: Config,
        drop: Callable[[Event, Refusal], None],
        open_frame: Callable[[Frame], ObservationSet | None],
        lose: Callable[[str, str, int], None],
    ) -> None:
        self._drop = drop
        self._open = open_frame
        self._lose = lose
        self._keyframes = Keyframes(config.keyframe)
        self._with_cloud: set[int] = set()
        """Of the frames given out last, the robots whose frame is a cloud."""
        self._window_ns = int(config.reorder_window_s * 1e9)
        self.robots = [RobotInputs(index, config, drop) for index in range(len(config.robots))]
        self._by_name = {robot.name: robot for robot in self.robots}
        self._first_ns: int | None = None
        self._given_out_ns = -1

    @property
    def pending(self) -> int:
        """Frames held back."""
        return sum(len(robot.waiting) for robot in self.robots)

    def hear(self, event: Event) -> None:
        """Note that a robot has come this far, whether or not its event can be used."""
        if self._first_ns is None:
            self._first_ns = event.stamp_ns
        robot = self._by_name[event.robot]
        self._tell_of_losses(robot, robot.hear(event))

    def excuse(self, event: Event) -> None:
        """An event is not even heard of, because of its stamp."""
        self._by_name[event.robot].excuse(event)

    def take(self, event: Event) -> None:
        """Keep an event of a robot of the team, or drop what comes too late."""
        robot = self._by_name[event.robot]
        refusal = self._refusal(robot, event)
        self.hear(event)
        if refusal:
            self._drop(event, refusal)
        else:
            robot.take(event)

    def ready(self) -> Iterator[list[RobotFrame]]:
        """The frames of each instant that is complete, oldest first."""
        return self._until(self._complete_until())

    def rest(self) -> Iterator[list[RobotFrame]]:
        """The frames that are still held back; those whose odometry never came are dropped."""
        yield from self._until(self._newest_ns())
        for robot in self.robots:
            robot.odometry.drop_doubted()
            self._tell_of_losses(robot, robot.rest())
            while robot.waiting:
                self._drop(robot.waiting.popleft(), NO_ODOMETRY)

    def use(self, frames: Iterable[RobotFrame]) -> None:
        """The frames given out last were used: the next motions begin where they ended."""
        for frame in frames:
            robot = self.robots[frame.robot]
            robot.odometry.use()
            if frame.robot in self._with_cloud:
                robot.count(seen=1, used=1)
                others = self._places(frame.sightings.others, frame.stamp_ns)
                self._keyframes.use(frame.robot, robot.odometry.at(frame.stamp_ns), others)

    def _refusal(self, robot: RobotInputs, event: Event) -> Refusal | None:
        """Why an event cannot be used, and the remedy."""
        if isinstance(event, PoseSample):
            if robot.odometry.is_late(event.stamp_ns):
                return Refusal("odometry out of order", "stamps must ascend")
        elif isinstance(event, Sightings):
            if event.stamp_ns <= max(robot.sightings_ns, self._given_out_ns):
                return Refusal("late sightings", LATE_REMEDY)
            strangers = [n for n in event.others if n >= len(self.robots) or n == robot.index]
            if strangers:
                told = f"robot {strangers[0]} is no other one of the team"
                return Refusal("sighting of nobody", told)
        elif event.stamp_ns == robot.newest_ns:
            return Refusal("duplicate frame", "send each stamp once")
        elif event.stamp_ns <= max(robot.newest_ns, self._given_out_ns):
            return LATE_FRAME
        return None

    def _newest_ns(self) -> int:
        return max(robot.newest_ns for robot in self.robots)

    def _complete_until(self) -> int:
        """Newest stamp up to which no active robot can still send a frame [ns]."""
        horizon = self._newest_ns() - self._window_ns
        for robot in self.robots:
            while robot.is_stuck(horizon):
                self._drop(robot.waiting.popleft(), NO_ODOMETRY)
        before_first = -1 if self._first_ns is None else self._first_ns - 1
        last_signs = (max(r.ready_ns(horizon), before_first) for r in self.robots)
        return min((stamp for stamp in last_signs if stamp >= horizon), default=horizon)

    def _until(self, until_ns: int) -> Iterator[list[RobotFrame]]:
        """The waiting frames up to `until_ns`, those of one stamp together."""
        while True:
            ready = [r for r in self.robots if r.has_frame(until_ns)]
            stamp = min((r.waiting[0].stamp_ns for r in ready), default=until_ns + 1)
            if stamp > until_ns:
                return
            together = [r for r in ready if r.waiting[0].stamp_ns == stamp]
            if stamp <= self._given_out_ns:
                for robot in together:
                    self._drop(robot.waiting.popleft(), LATE_FRAME)
            else:
                self._given_out_ns = stamp
                if frames := self._frames(stamp, together):
                    yield frames

    def _frames(self, stamp_ns: int, robots: list[RobotInputs]) -> list[RobotFrame]:
        """The keyframes among the oldest frames of `robots`, and a frame of each robot they see."""
        clouds = {robot.index: robot.waiting.popleft() for robot in robots}
        sightings = {r.index: own for r in robots if (own := r.sightings_at(stamp_ns))}
        for robot in self.robots:
            robot.drop_sightings(stamp_ns)
        chosen = self._choose(stamp_ns, clouds, sightings)
        self._with_cloud = {index for index, seen in chosen.items() if seen is not None}
        for index in clouds:
            self.robots[index].count(seen=1)
        for index in sorted(self._with_cloud & sightings.keys()):
            self._tell_of_unplaced(sightings[index])
        return [
            robot.frame(
                stamp_ns, chosen[robot.index], only(sightings.get(robot.index), chosen.keys())
            )
            for robot in self.robots
            if robot.index in chosen
        ]

    def _choose(
        self, stamp_ns: int, clouds: dict[int, Frame], sightings: dict[int, Sightings]
    ) -> dict[int, ObservationSet | None]:
        """What each robot observes that has a frame in the step; None where it has no cloud.

        Clouds that are looked at are taken out of `clouds`; those of frames that are passed over
        stay. Sightings whose cloud cannot be used are dropped from `sightings`.
        """
        places = {index: self._places(own.others, stamp_ns) for index, own in sightings.items()}
        chosen: dict[int, ObservationSet | None] = {}
        todo = deque(
            (index, False)
            for index in clouds
            if self._keyframes.is_due(
                index, self.robots[index].odometry.at(stamp_ns), places.get(index, {})
            )
        )
        while todo:
            index, is_seen = todo.popleft()
            if index in chosen:
                continue
            observations = self._open(clouds.pop(index)) if index in clouds else None
            if observations is not None:
                todo.extend((other, True) for other in places.get(index, {}))
            elif index in sightings:
                self._drop(sightings.pop(index), NO_FRAME)
            if is_seen or observations is not None:
                chosen[index] = observations
        return chosen

    def _places(self, robots: Iterable[int], stamp_ns: int) -> dict[int, np.ndarray]:
        """The pose (3,) by odometry of each of the `robots` whose odometry has come so far."""
        return {
            int(index): self.robots[index].odometry.at(stamp_ns)
            for index in robots
            if self.robots[index].odometry.newest_ns >= stamp_ns
        }

    def _tell_of_losses(self, robot: RobotInputs, lost: Iterable[tuple[str, Missing]]) -> None:
        for kind, (after_ns, until_ns, count) in lost:
            between = f"between {after_ns / 1e9:.3f} s and {until_ns / 1e9:.3f} s"
            self._lose(kind, f"{kind} of {robot.name}: {count} {between}; {LOST_REMEDY}", count)

    def _tell_of_unplaced(self, sightings: Sightings) -> None:
        """Count and tell of sightings of robots whose place is unknown."""
        placed = self._places(sightings.others, sightings.stamp_ns)
        lost = sorted(set(sightings.others.tolist()) - placed.keys())
        if lost:
            names = ", ".join(self.robots[n].name for n in lost)
            remedy = f"it sees {names}; send odometry of every robot"
            self._drop(sightings, Refusal(UNPLACED, remedy))
