"""The one door to the filter: events in, steps out.

The simulator in process, live topics and recorded bags all end in `Pipeline.handle`. Frames are
filtered in the order of (stamp, robot), not of arrival: a frame waits until every active robot has
sent one at least as new, or until the newest is `reorder_window_s` ahead. Time is message time
throughout, so a recorded run gives the live run's estimates. Frames of one stamp make one step.
A robot that is seen without a frame of its own at that instant gets one without observations.
"""

import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace

import numpy as np

from msg_defs.errors import InputError
from msg_defs.types import (
    DESCRIPTOR_SIZE,
    Estimate,
    Event,
    FrameRecord,
    LandmarkMap,
    ObservationSet,
    PoseSample,
    Sightings,
    StepRecord,
    Trajectory,
)
from multi_robot_slam.config import Config
from multi_robot_slam.filter import rbpf, resampling
from multi_robot_slam.filter.matching import FrameInfo
from multi_robot_slam.models.frames import Record, RobotFrame
from multi_robot_slam.models.motion import increment, wrap

LATE_REMEDY = "raise reorder_window_s, or synchronise the robots' clocks"
NO_ODOMETRY = "frame without odometry"
UNPLACED = "sighting of a robot without odometry"
MOST_ODOMETRY = 20_000
"""Odometry samples kept for frames to come: minutes at any usual rate."""


class Pipeline:
    """Orders and pairs what the robots send, steps the filter, and tells what it knows.

    Parameters
    ----------
    config : the whole configuration.
    warn : called with one line for each event and message that is dropped.

    """

    def __init__(self, config: Config, warn: Callable[[str], None] = lambda text: None):
        self.config = config
        self.dropped: Counter[str] = Counter()
        self._warn = warn
        self._rng = np.random.default_rng(config.seed)
        self._state = rbpf.init(np.array(config.start_poses), config.filter)
        self._robots = [_Robot(index, name, config) for index, name in enumerate(config.robots)]
        self._by_name = {robot.name: robot for robot in self._robots}
        self._first_ns: int | None = None
        self._filtered_ns = -1

    @property
    def _draws(self) -> bool:
        """The particles are rejuvenated: draws from the posterior, of which none is the best."""
        return self.config.filter.rejuvenation.ancestors_below > 0

    def warm_up(self) -> None:
        """Compile the filter's kernels, or load them from the cache."""
        rbpf.warm_up(self.config.filter)

    @property
    def pending(self) -> int:
        """Frames held back."""
        return sum(len(robot.waiting) for robot in self._robots)

    def handle(self, event: Event) -> list[StepRecord]:
        """Take one event; the steps that became possible are done and returned, oldest first."""
        robot = self._by_name.get(event.robot)
        if robot is None:
            return self._drop("unknown robot", event, f"the team is {', '.join(self._by_name)}")
        if self._first_ns is None:
            self._first_ns = event.stamp_ns
        against = self._reason_against(robot, event)
        if isinstance(event, ObservationSet):
            robot.newest_ns = max(robot.newest_ns, event.stamp_ns)
        if against:
            return self._drop(against[0], event, against[1])
        robot.take(event)
        return self._release(self._complete_until())

    def _reason_against(self, robot: "_Robot", event: Event) -> tuple[str, str] | None:
        """Why an event cannot be used, and the remedy."""
        if isinstance(event, PoseSample):
            if event.stamp_ns <= robot.odometry_ns:
                return "odometry out of order", "stamps must ascend"
        elif isinstance(event, Sightings):
            if event.stamp_ns <= max(robot.sightings_ns, self._filtered_ns):
                return "late sightings", LATE_REMEDY
            strangers = [n for n in event.others if n >= len(self._robots) or n == robot.index]
            if strangers:
                return "sighting of nobody", f"robot {strangers[0]} is no other one of the team"
        elif event.stamp_ns == robot.newest_ns:
            return "duplicate frame", "send each stamp once"
        elif event.stamp_ns <= max(robot.newest_ns, self._filtered_ns):
            return "late frame", LATE_REMEDY
        return None

    def refuse(self, error: InputError) -> None:
        """Count and tell of a message that could not be decoded."""
        self.dropped[f"bad {str(error).partition(':')[0]}"] += 1
        self._warn(f"dropped {error}")

    def finish(self) -> list[StepRecord]:
        """Filter what is still held back; frames whose odometry never came are dropped."""
        steps = self._release(self._newest_ns())
        for robot in self._robots:
            while robot.waiting:
                self._drop(NO_ODOMETRY, robot.waiting.popleft(), "send odometry with every frame")
        return steps

    def landmark_map(self) -> LandmarkMap:
        """The best particle's map (17); where it draws, what all make of its landmarks."""
        state, landmarks = self._state, self._state.landmarks
        best = rbpf.best_particle(state)
        columns, values = landmarks.of_particle(best)
        if self._draws:
            values = landmarks.mixture(columns, resampling.normalise(state.log_weights))
        ids = landmarks.ids[columns]
        observations = np.zeros(ids.max(initial=-1) + 1, np.uint32)
        robots = np.zeros_like(observations)
        for record, row in state.history.lineage(best):
            np.add.at(observations, record.matches[:, row], 1)
            np.bitwise_or.at(robots, record.matches[:, row], np.uint32(1 << record.robot))
        return LandmarkMap(
            ids=ids.astype(np.uint32),
            positions=values[:, :3].astype(np.float32),
            covariances=values[:, 3:].astype(np.float32),
            observations=observations[ids],
            robots=robots[ids],
            descriptors=landmarks.descriptors[columns],
        )

    def lineage(self) -> list[tuple[Record, int]]:
        """The best particle's past, oldest first: its row in the record of each frame."""
        best = rbpf.best_particle(self._state)
        return list(self._state.history.lineage(best))[::-1]

    def distinct_ancestors(self) -> np.ndarray:
        """For each frame so far, from how many of its particles today's particles descend."""
        return self._state.history.distinct_ancestors()

    def trajectories(self) -> dict[str, Trajectory]:
        """The best particle's path of every robot that has moved or seen something."""
        return self._by_robot((record, record.poses[:, row]) for record, row in self.lineage())

    def mean_trajectories(self) -> dict[str, Trajectory]:
        """The weighted mean of all particles' whole paths, likewise."""
        weights = resampling.normalise(self._state.log_weights)
        means = [
            (record, record.poses @ np.bincount(rows, weights, len(record.parents)))
            for record, rows in self._state.history.lineage(slice(None))
        ]
        return self._by_robot(reversed(means))

    def _by_robot(self, path: Iterable[tuple[Record, np.ndarray]]) -> dict[str, Trajectory]:
        """Trajectories from the pose (3,) in each record, oldest first."""
        stamps = [[] for _ in self._robots]
        poses = [[] for _ in self._robots]
        for record, pose in path:
            stamps[record.robot].append(record.stamp_ns)
            poses[record.robot].append(pose)
        return {
            robot.name: Trajectory(np.array(t, np.int64), _wrapped(np.array(p)))
            for robot, t, p in zip(self._robots, stamps, poses, strict=True)
            if t
        }

    def particles(self, robot: str) -> np.ndarray:
        """(M, 3): the pose x, y [m], yaw [rad] of `robot` in every particle."""
        return _wrapped(self._state.poses[self._by_name[robot].index].T)

    def odometry_pose(self, robot: str) -> np.ndarray:
        """(3,): the odometry of `robot` at its last filtered frame, in its `odom` frame."""
        return self._by_name[robot].used_pose

    def _newest_ns(self) -> int:
        return max(robot.newest_ns for robot in self._robots)

    def _complete_until(self) -> int:
        """Newest stamp up to which no active robot can still send a frame [ns]."""
        horizon = self._newest_ns() - int(self.config.reorder_window_s * 1e9)
        for robot in self._robots:
            while robot.is_stuck(horizon):
                self._drop(NO_ODOMETRY, robot.waiting.popleft(), "send odometry with every frame")
        last_signs = (max(r.ready_ns(horizon), self._first_ns - 1) for r in self._robots)
        return min((stamp for stamp in last_signs if stamp >= horizon), default=horizon)

    def _release(self, until_ns: int) -> list[StepRecord]:
        """Step through the waiting frames up to `until_ns`, frames of one stamp together."""
        steps = []
        while True:
            ready = [r for r in self._robots if r.has_frame(until_ns)]
            stamp = min((r.waiting[0].stamp_ns for r in ready), default=until_ns + 1)
            if stamp > until_ns:
                return steps
            together = [r for r in ready if r.waiting[0].stamp_ns == stamp]
            if stamp <= self._filtered_ns:
                for robot in together:
                    self._drop("late frame", robot.waiting.popleft(), LATE_REMEDY)
            else:
                steps.append(self._step(stamp, self._frames(stamp, together)))

    def _frames(self, stamp_ns: int, robots: list["_Robot"]) -> list[RobotFrame]:
        """The frames of `robots`, and one without observations of each other robot they see."""
        seen_by = {r.index: r.sightings_at(stamp_ns) for r in robots}
        seen = {int(n) for own in seen_by.values() if own for n in own.others} - seen_by.keys()
        placed = {n for n in seen if self._robots[n].odometry_ns >= stamp_ns}
        if seen > placed:
            self.dropped[UNPLACED] += 1
            names = ", ".join(self._robots[n].name for n in sorted(seen - placed))
            self._warn(f"dropped sightings of {names} at {stamp_ns / 1e9:.3f} s: {UNPLACED}")
        known = seen_by.keys() | placed
        return [
            robot.frame(stamp_ns, _only(seen_by.get(robot.index), known))
            for robot in self._robots
            if robot.index in known
        ]

    def _step(self, stamp_ns: int, frames: list[RobotFrame]) -> StepRecord:
        start = time.perf_counter()
        config = self.config
        info = rbpf.step(self._state, frames, config.filter, self._rng)
        self._filtered_ns = stamp_ns
        best = rbpf.best_particle(self._state)
        before = best if info.ancestors is None else info.ancestors[best]
        return StepRecord(
            stamp_ns=stamp_ns,
            step=self._state.steps,
            frames=tuple(
                _frame_record(config.robots[frame.robot], seen, before, config.filter.sighting_gate)
                for frame, seen in zip(frames, info.frames, strict=True)
            ),
            estimates=tuple(
                self._estimate(frame, best, *moments)
                for frame, moments in zip(frames, info.moments, strict=True)
            ),
            effective_particles=info.effective_particles,
            resampled=info.ancestors is not None,
            rejuvenated=info.rejuvenated and info.rejuvenated.effective_particles,
            duration_ms=(time.perf_counter() - start) * 1e3,
        )

    def _estimate(
        self, frame: RobotFrame, best: int, mean: np.ndarray, covariance: np.ndarray
    ) -> Estimate:
        return Estimate(
            robot=self.config.robots[frame.robot],
            stamp_ns=frame.stamp_ns,
            pose=_wrapped(mean if self._draws else self._state.poses[frame.robot, :, best]),
            covariance=covariance,
            mean=_wrapped(mean),
        )

    def _drop(self, reason: str, event: Event, remedy: str) -> list[StepRecord]:
        self.dropped[reason] += 1
        self._warn(f"dropped {event.robot} at {event.stamp_ns / 1e9:.3f} s: {reason}; {remedy}")
        return []


class _Robot:
    """What one robot has sent and the filter has not used yet."""

    def __init__(self, index: int, name: str, config: Config):
        self.index = index
        self.name = name
        self.waiting: deque[ObservationSet] = deque()
        self.newest_ns = -1
        self.used_pose = np.zeros(3)
        self._odometry: deque[PoseSample] = deque(maxlen=MOST_ODOMETRY)
        self._used_ns: int | None = None
        self._sends_sightings = config.sightings
        self._mount = config.mount_of(index)
        self._sightings: deque[Sightings] = deque()
        self.sightings_ns = -1

    @property
    def odometry_ns(self) -> int:
        """Stamp of the newest odometry, -1 when there is none [ns]."""
        return self._odometry[-1].stamp_ns if self._odometry else -1

    def ready_ns(self, horizon_ns: int) -> int:
        """Stamp of the newest frame all of which has arrived, -1 when there is none [ns].

        Sightings are not waited for at `horizon_ns` and before.
        """
        complete = min(self.newest_ns, self.odometry_ns)
        if self._sends_sightings:
            complete = min(complete, max(self.sightings_ns, horizon_ns))
        return complete

    def has_frame(self, until_ns: int) -> bool:
        """The oldest waiting frame is complete; one up to `until_ns` need not have sightings."""
        return bool(self.waiting) and self.waiting[0].stamp_ns <= self.ready_ns(until_ns)

    def is_stuck(self, horizon_ns: int) -> bool:
        """The oldest waiting frame is older than `horizon_ns` and its odometry has not come."""
        return bool(self.waiting) and self.odometry_ns < self.waiting[0].stamp_ns < horizon_ns

    def take(self, event: Event) -> None:
        """Keep an event that is newer than the last of its kind."""
        if isinstance(event, PoseSample):
            self._odometry.append(event)
        elif isinstance(event, Sightings):
            self._sightings.append(event)
            self.sightings_ns = event.stamp_ns
        else:
            self.waiting.append(event)

    def sightings_at(self, stamp_ns: int) -> Sightings | None:
        """The sightings at `stamp_ns`; older ones are forgotten."""
        while self._sightings and self._sightings[0].stamp_ns < stamp_ns:
            self._sightings.popleft()
        if self._sightings and self._sightings[0].stamp_ns == stamp_ns:
            return self._sightings.popleft()
        return None

    def frame(self, stamp_ns: int, sightings: Sightings | None) -> RobotFrame:
        """The frame at `stamp_ns`, empty if none is waiting, with the motion since the one before.

        Odometry must have reached `stamp_ns`.
        """
        if self.waiting and self.waiting[0].stamp_ns == stamp_ns:
            observations = self.waiting.popleft()
        else:
            observations = _nothing(self.name, stamp_ns)
        pose = self._odometry_at(stamp_ns)
        motion, seconds = np.zeros(3), 0.0
        if self._used_ns is not None:
            motion = increment(self.used_pose, pose)
            seconds = (stamp_ns - self._used_ns) / 1e9
        self.used_pose, self._used_ns = pose, stamp_ns
        return RobotFrame.from_camera(
            self.index, motion, seconds, observations, self._mount, sightings
        )

    def _odometry_at(self, stamp_ns: int) -> np.ndarray:
        """Odometry interpolated at `stamp_ns`; before the first sample, the first."""
        samples = self._odometry
        while len(samples) > 1 and samples[1].stamp_ns <= stamp_ns:
            samples.popleft()
        first = samples[0]
        if len(samples) == 1 or first.stamp_ns >= stamp_ns:
            return first.pose
        share = (stamp_ns - first.stamp_ns) / (samples[1].stamp_ns - first.stamp_ns)
        difference = samples[1].pose - first.pose
        difference[2] = wrap(difference[2])
        return first.pose + share * difference


def _nothing(robot: str, stamp_ns: int) -> ObservationSet:
    empty = (np.empty((0, size), np.float32) for size in (3, 6, DESCRIPTOR_SIZE))
    return ObservationSet(robot, stamp_ns, *empty)


def _only(sightings: Sightings | None, robots: Collection[int]) -> Sightings | None:
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


def _frame_record(robot: str, info: FrameInfo, particle: int, sighting_gate: float) -> FrameRecord:
    matches = info.matches[:, particle]
    sighted = info.sighted.mahalanobis_sq[:, particle]
    is_new = matches == info.new_ids
    return FrameRecord(
        robot=robot,
        landmarks=matches.astype(np.int64),
        is_new=is_new,
        is_rejected=is_new & (np.diff(info.candidates.starts) > 0),
        mahalanobis=np.where(is_new, np.nan, info.mahalanobis_sq[:, particle]).astype(np.float32),
        descriptor_distance=np.where(is_new, np.nan, info.descriptor_distances(matches)),
        others=info.sighted.seen.others,
        other_mahalanobis=sighted.astype(np.float32),
        is_other_rejected=sighted > sighting_gate,
    )


def _wrapped(poses: np.ndarray) -> np.ndarray:
    """Poses (..., 3) with the yaw in [-pi, pi)."""
    result = np.array(poses, float)
    result[..., 2] = wrap(result[..., 2])
    return result
