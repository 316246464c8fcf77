"""The order of time: frames leave by (stamp, robot), however their messages arrived.

A frame waits until every active robot has sent one at least as new, or until the newest is
`reorder_window_s` ahead. Time is message time throughout, so a recorded run gives the live run's
estimates. Frames of one stamp make one step. A robot that is seen without a frame of its own at
that instant gets one without observations.
"""

from collections.abc import Callable, Iterator

from msg_defs.types import Event, ObservationSet, PoseSample, Sightings
from multi_robot_slam.config import Config
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.pipeline.pairing import RobotInputs, only
from multi_robot_slam.pipeline.plausibility import Refusal

LATE_REMEDY = "raise reorder_window_s, or synchronise the robots' clocks"
NO_ODOMETRY = Refusal("frame without odometry", "send odometry with every frame")
LATE_FRAME = Refusal("late frame", LATE_REMEDY)
UNPLACED = "sighting of a robot without odometry"


class Reorder:
    """Takes what a team sends and gives out the frames of one instant after the other.

    Parameters
    ----------
    drop : called with each event that cannot be used, and why.

    """

    def __init__(self, config: Config, drop: Callable[[Event, Refusal], None]) -> None:
        self._drop = drop
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
        if isinstance(event, ObservationSet):
            robot.newest_ns = max(robot.newest_ns, event.stamp_ns)

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
            while robot.waiting:
                self._drop(robot.waiting.popleft(), NO_ODOMETRY)

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
                yield self._frames(stamp, together)

    def _frames(self, stamp_ns: int, robots: list[RobotInputs]) -> list[RobotFrame]:
        """The frames of `robots`, and one without observations of each other robot they see."""
        seen_by = {r.index: r.sightings_at(stamp_ns) for r in robots}
        for robot in self.robots:
            robot.drop_sightings(stamp_ns)
        seen = {int(n) for own in seen_by.values() if own for n in own.others} - seen_by.keys()
        placed = {n for n in seen if self.robots[n].odometry.newest_ns >= stamp_ns}
        for own in filter(None, seen_by.values()):
            self._tell_of_unplaced(own, seen - placed)
        known = seen_by.keys() | placed
        return [
            robot.frame(stamp_ns, only(seen_by.get(robot.index), known))
            for robot in self.robots
            if robot.index in known
        ]

    def _tell_of_unplaced(self, sightings: Sightings, unplaced: set[int]) -> None:
        """Count and tell of sightings of robots (indices in the team) whose place is unknown."""
        lost = sorted(unplaced & set(sightings.others.tolist()))
        if lost:
            names = ", ".join(self.robots[n].name for n in lost)
            remedy = f"it sees {names}; send odometry of every robot"
            self._drop(sightings, Refusal(UNPLACED, remedy))
