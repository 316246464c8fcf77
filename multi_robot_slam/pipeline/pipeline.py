"""The one door to the filter: events in, steps out.

The simulator in process, live topics and recorded bags all end in `Pipeline.handle`. Whatever comes
in, the run goes on: what cannot be true is dropped and counted (`plausibility`, `time_guard`,
`odometry`), what comes in any order is put in that of time (`reorder`), and a step that the filter
cannot do leaves everything as it was.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from msg_defs.errors import InputError
from msg_defs.types import (
    Estimate,
    Event,
    Frame,
    FrameCount,
    LandmarkMap,
    ObservationSet,
    PoseSample,
    StepRecord,
    Trajectory,
    Verdict,
)
from multi_robot_slam.config import Config
from multi_robot_slam.filter import rbpf, running
from multi_robot_slam.filter.kept import KeptMap
from multi_robot_slam.filter.rbpf import StepInfo
from multi_robot_slam.filter.rejuvenation import FAILURES
from multi_robot_slam.filter.running import ParticleFilter
from multi_robot_slam.models import motion
from multi_robot_slam.models.frames import Record, RobotFrame
from multi_robot_slam.monitor.monitor import Monitor
from multi_robot_slam.monitor.predictions import Predictions
from multi_robot_slam.pipeline import estimates, plausibility, ties
from multi_robot_slam.pipeline.levels import Levels
from multi_robot_slam.pipeline.plausibility import Refusal
from multi_robot_slam.pipeline.records import step_record
from multi_robot_slam.pipeline.reorder import Reorder
from multi_robot_slam.pipeline.time_guard import TimeGuard
from multi_robot_slam.smoothing.noise_factors import NoiseFactors
from multi_robot_slam.smoothing.odometry_scale import scaled

FAILED_STEP = "failed step"
FAR_AHEAD = Refusal("stamp far ahead", "synchronise the robots' clocks, or raise reorder_window_s")


class Pipeline:
    """Orders and pairs what the robots send, steps the filter, and tells what it knows.

    Parameters
    ----------
    config : the whole configuration.
    warn : called with one line for each event and message that is dropped.
    keeps_frames : whether all frames are kept, to smooth the whole run at its end: 3 kB a frame.
    kept : the map to begin with, with the bits of this team's robots. It fixes where `map` is, and
        not the first robot, which starts as certain as the others.

    `InputError` where robots are only to be localised (`filter.mapping`) and there is no map; and
    where nothing says where `map` is: no start pose, and no landmark of a map.

    """

    def __init__(
        self,
        config: Config,
        warn: Callable[[str], None] = lambda text: None,
        keeps_frames: bool = True,
        kept: KeptMap | None = None,
    ):
        if kept is not None and not config.start_sigmas:
            config = replace(config, start_sigmas=(config.start_sigma,) * len(config.robots))
        elif kept is None and not config.filter.mapping:
            raise InputError("filter.mapping = false: there is no map to localise in; load one")
        if not config.are_known.any() and (kept is None or not len(kept.ids)):
            raise InputError(
                "start_poses: unknown for all robots; give x, y, yaw of one, for example "
                "[0, 0, 0]: it says where `map` is; or load a map with landmarks"
            )
        self.config = config
        self.dropped: Counter[str] = Counter()
        """How much was lost, by reason."""
        self.warn = warn
        self._particles = ParticleFilter(
            config.starts,
            config.filter,
            np.random.default_rng(config.seed),
            keeps_frames,
            config.are_known,
            kept,
        )
        self._loaded = kept
        self._monitor = Monitor(
            config.robots,
            [
                start if is_known else None
                for start, is_known in zip(config.starts, config.are_known, strict=True)
            ],
            [config.mount_of(robot) for robot in range(len(config.robots))],
            config.filter,
            0 if kept is None else int(kept.next_id),
        )
        self._levels = Levels(warn)
        self._indices = list(range(len(config.robots)))
        """What the filter calls each robot now (`filter.pieces`)."""
        self._guard = TimeGuard(config.apart_ns, self._drop_far_ahead)
        self._reorder = Reorder(config, self._drop, self._opened, self.lose)
        self._estimates: dict[str, Estimate] = {}
        """Each robot's estimate of the last step it had a frame in."""

    @property
    def noise(self) -> NoiseFactors:
        """How noisy each robot's odometry and observations are, beside what was told."""
        return self._particles.state.noise

    def warm_up(self) -> None:
        """Compile the kernels of filter and monitor, or load them from the cache."""
        state = running.warm_up(self.config.filter)
        self._monitor.expect(state, rbpf.two_robots())

    @property
    def pending(self) -> int:
        """Frames held back."""
        return self._guard.pending + self._reorder.pending

    @property
    def settled(self) -> int:
        """Frames that no rejuvenation draws anew any more."""
        return len(self._particles.state.history.settled)

    def handle(self, event: Event) -> list[StepRecord]:
        """Take one event; the steps that became possible are done and returned, oldest first."""
        if event.robot not in self.config.robots:
            self._drop(
                event, Refusal("unknown robot", f"the team is {', '.join(self.config.robots)}")
            )
            return []
        return self._handle_all(self._guard.admit(event))

    def finish(self) -> list[StepRecord]:
        """Filter what is still held back; frames whose odometry never came are dropped."""
        steps = self._handle_all(self._guard.rest())
        return steps + self._filter(self._reorder.rest())

    def predict(self, event: Event) -> Estimate | None:
        """Where the odometry that was handled last has taken its robot since its last step.

        The estimate of that step, moved along, its covariance grown by (7) and by what gaps hide.
        None for other events, for a sample that was not taken or is not newer than the step, and
        where every frame is a step (`Keyframe`).
        """
        before = self._estimates.get(event.robot)
        if before is None or not isinstance(event, PoseSample) or not self.config.keyframe.is_on:
            return None
        index = self.config.robots.index(event.robot)
        odometry, robot = self._reorder.robots[index].odometry, self._indices[index]
        if event is not odometry.newest or event.stamp_ns <= before.stamp_ns:
            return None
        moved, seconds, extra = odometry.motion_to_newest()
        moved = scaled(moved, self._particles.state.scales.factors[robot])
        noise, factor = self.config.filter.motion, self._particles.state.noise.used[robot, 0]
        where = motion.predicted(
            before.pose, before.covariance, moved, seconds, noise, extra, factor
        )
        return Estimate(event.robot, event.stamp_ns, *where)

    def frames(self) -> dict[str, FrameCount]:
        """How many frames of each robot could be used, and how many became steps."""
        return {robot.name: robot.frames for robot in self._reorder.robots}

    def lost(self) -> dict[str, dict[str, int]]:
        """How many messages of each robot never arrived, by kind."""
        return {
            robot.name: {kind: losses.total for kind, losses in robot.losses.items()}
            for robot in self._reorder.robots
        }

    def pause(self) -> None:
        """Nobody listened for a while: what came meanwhile is a gap, but not lost on its way."""
        for robot in self._reorder.robots:
            for losses in robot.losses.values():
                losses.pause()

    def close(self) -> None:
        """Let go of the thread beside the filter; nothing can be handled after."""
        self._particles.close()

    def lose(self, reason: str, text: str, count: int = 1) -> None:
        """Count and tell of what was lost before it became an event."""
        self.dropped[reason] += count
        self.warn(text)

    def refuse(self, error: InputError) -> None:
        """Count and tell of a message that could not be decoded."""
        self.lose(f"bad {str(error).partition(':')[0]}", f"dropped {error}")

    def landmark_map(self) -> LandmarkMap:
        """The best particle's map (17); where it draws, what all make of its landmarks.

        Without mapping, the one that was loaded.
        """
        if self._loaded is not None and not self.config.filter.mapping:
            return self._loaded.landmark_map()
        return estimates.landmark_map(self._particles.state, self.config)

    def unplaced(self) -> tuple[LandmarkMap, np.ndarray]:
        """Landmarks whose place in `map` is not known, in the frames of their pieces (N,)."""
        return estimates.unplaced(self._particles.state, self.config)

    def closing(self) -> Callable[[], KeptMap]:
        """What makes the map to keep of all steps so far, elsewhere; it changes nothing here.

        Without mapping, the one that was loaded. It raises `SmoothingError` where there is none.
        """
        loaded = self._loaded
        if loaded is not None and not self.config.filter.mapping:
            return lambda: loaded
        return self._particles.closing()

    @property
    def team(self) -> list[int]:
        """Which robot of the team each one in `lineage` is: one that was lost goes on as others."""
        return self._particles.state.pieces.team.tolist()

    def lineage(self) -> list[tuple[Record, int]]:
        """The best particle's past, oldest first: its row in the record of each frame.

        Without those that have settled, unless frames are kept.
        """
        return estimates.lineage(self._particles.state)

    def distinct_ancestors(self) -> np.ndarray:
        """For each frame that has not settled, how many of its particles have descendants."""
        return self._particles.state.history.distinct_ancestors()

    def trajectories(self) -> dict[str, Trajectory]:
        """The path of every robot that has moved or seen something.

        The best particle's; of settled frames the one they settled with.
        """
        return estimates.trajectories(self._particles.state, self.config)

    def mean_trajectories(self) -> dict[str, Trajectory]:
        """The weighted mean of all particles' paths, likewise."""
        return estimates.mean_trajectories(self._particles.state, self.config)

    def particles(self, robot: str) -> np.ndarray:
        """(M, 3): the pose x, y [m], yaw [rad] of `robot` in every particle."""
        index = self._indices[self.config.robots.index(robot)]
        return estimates.wrapped(self._particles.state.poses[index].T)

    def odometry_pose(self, robot: str) -> np.ndarray:
        """(3,): the odometry of `robot` at its last filtered frame, in its `odom` frame."""
        return self._reorder.robots[self.config.robots.index(robot)].odometry.used_pose

    def _handle_all(self, events: Iterable[Event]) -> list[StepRecord]:
        steps = []
        for event in events:
            limits = self.config.plausible  # frames are held to them when they are used
            refusal = None if isinstance(event, Frame) else plausibility.refusal(event, limits)
            if refusal:
                self._reorder.hear(event)
                self._drop(event, refusal)
            else:
                self._reorder.take(event)
            steps += self._filter(self._reorder.ready())
        return steps

    def _filter(self, instants: Iterable[list[RobotFrame]]) -> list[StepRecord]:
        """Step through the frames of each instant."""
        steps = []
        for frames in instants:
            start = time.perf_counter()
            own = [frame.called(self._indices) for frame in frames]
            try:
                expected = self._monitor.expect(self._particles.state, own)
                info = self._particles.step(own)
            except FAILURES as error:
                self._tell_of_failure(frames, error)
                continue
            self._reorder.use(frames)
            verdicts = self._judged(own, info, expected)
            took_ms = (time.perf_counter() - start) * 1e3
            state = self._particles.state
            steps.append(step_record(self.config, state, own, info, verdicts, took_ms))
            if (tied := steps[-1].tied) is not None:
                self.warn(f"at {_time(frames[0].stamp_ns)}: {ties.line(tied)}")
            for frame in frames:
                self._estimates.pop(self.config.robots[frame.robot], None)
            self._estimates |= {estimate.robot: estimate for estimate in steps[-1].estimates}
        return steps

    def _judged(
        self, frames: list[RobotFrame], info: StepInfo, expected: list[Predictions]
    ) -> tuple[Verdict, ...]:
        """The verdicts on the robots of a step, after which lost ones leave the map."""
        stamp_ns = frames[0].stamp_ns
        for reason in info.rejuvenated.failures if info.rejuvenated else ():
            self._tell_of_no_smoothing(stamp_ns, reason)
        verdicts = self._monitor.judge(self._particles.state, frames, info, expected)
        for lost in info.lost:
            self._monitor.go_on(lost)
            self._indices[self._particles.state.pieces.team[lost.robot]] = lost.another
        for robot, misled in self._monitor.misled.items():
            self._particles.lose(robot, misled)
        self._levels.tell(stamp_ns, verdicts)
        return verdicts

    def _opened(self, frame: Frame) -> ObservationSet | None:
        """What a frame holds; None, counted and told, where it means nothing or cannot be true."""
        try:
            seen = frame if isinstance(frame, ObservationSet) else frame.decode()
        except InputError as error:
            self.refuse(error)
            return None
        seen = self._thinned(seen)
        refusal = plausibility.refusal(seen, self.config.plausible)
        if refusal:
            self._drop(seen, refusal)
        return None if refusal else seen

    def _thinned(self, seen: ObservationSet) -> ObservationSet:
        result = plausibility.thinned(seen, self.config.plausible)
        if result is not seen:
            count, most = len(seen.positions), len(result.positions)
            self.lose(
                "observations beyond the most of a frame",
                f"{seen.robot} at {_time(seen.stamp_ns)}: {count} observations, of which {most} "
                "are used; detect fewer, or raise plausible.most_observations",
                count - most,
            )
        return result

    def _drop_far_ahead(self, event: Event) -> None:
        self._reorder.excuse(event)
        self._drop(event, FAR_AHEAD)

    def _drop(self, event: Event, refusal: Refusal) -> None:
        where = f"{event.robot} at {_time(event.stamp_ns)}"
        self.lose(refusal.reason, f"dropped {where}: {refusal.reason}; {refusal.remedy}")

    def _tell_of_no_smoothing(self, stamp_ns: int, reason: str) -> None:
        self.lose(
            "failed smoothing",
            f"no rejuvenation at {_time(stamp_ns)}: {reason}. The filter goes on without; if it "
            "happens again, look for false matches, or for noise stated too small",
        )

    def _tell_of_failure(self, frames: list[RobotFrame], error: Exception) -> None:
        names = ", ".join(self.config.robots[frame.robot] for frame in frames)
        self.lose(
            FAILED_STEP,
            f"dropped the frames of {names} at {_time(frames[0].stamp_ns)}: the filter could not "
            f"use them ({error}); look at what they hold. The estimate is as before",
        )


def _time(stamp_ns: int) -> str:
    return f"{stamp_ns / 1e9:.3f} s"
