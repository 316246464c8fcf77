"""The monitor of a team: what each frame says of what the filter assumes.

It reads the state before a step and what the step made of the frames; it changes nothing and draws
nothing, and all it says follows from these. So a run that is repeated is judged alike.
"""

from bisect import bisect_right
from collections.abc import Sequence
from typing import Final

import numpy as np

from msg_defs.types import WRONG, CameraMount, Verdict
from multi_robot_slam.filter.losing import Lost, Misled
from multi_robot_slam.filter.rbpf import StepInfo
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.filter.state import State
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.monitor import learnt_noise
from multi_robot_slam.monitor.continuity import Continuity
from multi_robot_slam.monitor.evidence import LOG_ALARM
from multi_robot_slam.monitor.in_view import InView
from multi_robot_slam.monitor.innovations import Innovations
from multi_robot_slam.monitor.predictions import Predictions, predict
from multi_robot_slam.monitor.recognition import Recognition
from multi_robot_slam.monitor.verdicts import Findings, blamed, verdict, with_place_unknown
from multi_robot_slam.smoothing.noise_factors import NoiseFactors

BEYOND_DOUBT: Final = LOG_ALARM / 4
"""What a frame must say against where its robot seems to be, to be the first that was elsewhere:
fluctuations say less, and a robot that is elsewhere much more."""


class Monitor:
    """Watches the frames of K robots.

    Parameters
    ----------
    names : of the robots.
    start_poses : of each (3,) as configured: x, y [m], yaw [rad] in `map`; None: unknown.
    cameras : where the camera of each sits.
    loaded : landmarks with smaller ids are of a map that was there before: each robot's own.

    """

    def __init__(
        self,
        names: Sequence[str],
        start_poses: Sequence[np.ndarray | None],
        cameras: Sequence[CameraMount],
        settings: FilterSettings,
        loaded: int = 0,
    ) -> None:
        self._settings = settings
        self._loaded = loaded
        self._findings = [
            Findings(
                name,
                start,
                Innovations(settings.gate),
                InView(camera, settings.descriptor_gate),
                [Recognition(settings.gate) for _ in names],
                Continuity(),
            )
            for name, start, camera in zip(names, start_poses, cameras, strict=True)
        ]
        self._first_ids: list[int] = []
        """Of the landmarks that each frame may have created; those of later frames are larger."""
        self._creators: list[int] = []
        """The robot of each of these frames."""
        self._noise: NoiseFactors | None = None
        self._found: list[learnt_noise.Found] = []
        """By these factors."""
        self._old_before = [0] * len(self._findings)
        """For each robot the id below which landmarks are older than what is held against it."""
        self._misled_ns: list[int | None] = [None] * len(self._findings)
        """For each robot the first frame that is held against where it seems to be."""
        self._wrong: dict[int, Verdict] = {}
        """Robots that are not where they seem to be, until they go on as others."""
        self.misled: dict[int, Misled | None] = {}
        """Those whose way hangs together again, to go on so; as of `filter.losing.lose`."""

    def expect(self, state: State, frames: Sequence[RobotFrame]) -> list[Predictions]:
        """What `state` expects of the frames of a step that is not done yet.

        Nothing where particles are not rejuvenated: they are few draws then, descend from fewer,
        and how they spread says too little of how uncertain they are.
        """
        if self._settings.rejuvenation.ancestors_below == 0:
            return [Predictions.none()] * len(frames)
        return [predict(state, frame, self._settings) for frame in frames]

    def judge(
        self,
        state: State,
        frames: Sequence[RobotFrame],
        info: StepInfo,
        predicted: Sequence[Predictions],
    ) -> tuple[Verdict, ...]:
        """The verdict on the robot of each frame, now that the step was done and led to `state`."""
        for frame, seen, own in zip(frames, predicted, info.frames, strict=True):
            self._note(frame, seen)
            self._note_created(frame.robot, own.new_ids)
            continuity = self._findings[frame.robot].continuity
            continuity.note(frame.stamp_ns, own.matches[:, 0], own.new_ids)
        wrong = blamed(self._findings)
        return tuple(self._verdict(state, frame, wrong) for frame in frames)

    def _verdict(
        self, state: State, frame: RobotFrame, wrong: dict[int, tuple[int, bool]]
    ) -> Verdict:
        robot = frame.robot
        told = self._wrong.get(robot)
        if told is None:
            told = verdict(self._findings, robot, wrong, self._learnt(state, robot))
        if told.level in WRONG:
            self._wrong[robot] = told
            self._note_misled(frame, told)
            return told
        if state.pieces.robots_in_map[robot]:
            self._findings[robot] = self._findings[robot]._replace(before=None)
            return told
        return with_place_unknown(told, self._findings[robot].before, state.pieces, robot)

    def _note_misled(self, frame: RobotFrame, told: Verdict) -> None:
        continuity = self._findings[frame.robot].continuity
        if told.level == "start wrong":
            self.misled[frame.robot] = None
        elif not continuity.is_broken_at(frame.stamp_ns):
            seen_ns = self._misled_ns[frame.robot] or frame.stamp_ns
            self.misled[frame.robot] = continuity.misled(seen_ns)

    def go_on(self, lost: Lost) -> None:
        """Know nothing more of where a robot is, which goes on as another one (`filter.losing`)."""
        told = self._wrong.pop(lost.robot)
        self.misled.pop(lost.robot)
        if lost.another == len(self._findings):
            self._add_another(lost)
        for robot in {lost.robot, lost.another}:
            found = self._findings[robot]
            self._findings[robot] = found._replace(
                recognised=[Recognition(self._settings.gate) for _ in self._findings],
                continuity=Continuity(),
                before=told if robot == lost.another and lost.tie is None else None,
            )
            for other in self._findings:
                other.recognised[robot] = Recognition(self._settings.gate)
            self._misled_ns[robot] = None
        self._findings[lost.another].in_view.evidence.end()

    def _add_another(self, lost: Lost) -> None:
        for found in self._findings:
            found.recognised.append(Recognition(self._settings.gate))
        self._findings.append(self._findings[lost.robot])
        self._old_before.append(0)
        self._misled_ns.append(None)
        self._found += self._found[lost.robot : lost.robot + 1]
        self._creators = [
            lost.another if robot == lost.robot and first >= lost.first_id else robot
            for robot, first in zip(self._creators, self._first_ids, strict=True)
        ]

    def _learnt(self, state: State, robot: int) -> learnt_noise.Found:
        """What smoothing found, which changes with a rejuvenation alone."""
        if state.noise is not self._noise:
            self._noise = state.noise
            self._found = [
                learnt_noise.found(state, index, found.name, self._settings)
                for index, found in enumerate(self._findings)
            ]
        return self._found[robot]

    def _note(self, frame: RobotFrame, seen: Predictions) -> None:
        found = self._findings[frame.robot]
        evidence = [found.in_view.evidence, *(each.evidence for each in found.recognised)]
        before = [each.log for each in evidence]
        found.innovations.note(seen)
        is_lost_now = found.in_view.note(frame)
        own = found.recognised[frame.robot]
        if is_lost_now or not (own.evidence.log or found.in_view.evidence.log):
            self._old_before[frame.robot] = seen.next_id
        seen = seen.with_noise(self._found[frame.robot].factor if self._found else 1.0)
        creators = np.array([self._creator(number, frame.robot) for number in seen.ids], int)
        old_before = max(self._old_before[frame.robot], self._loaded)
        is_old = (creators != frame.robot) | (seen.ids < old_before)
        for robot, recognition in enumerate(found.recognised):
            recognition.note(seen, is_old & (creators == robot))
        if found.in_view.evidence.is_alarming:
            found.in_view.confirm(seen.only(is_old).oldest())
        if not any(each.log for each in evidence):
            self._misled_ns[frame.robot] = None
        elif self._misled_ns[frame.robot] is None:
            said = max(each.log - log for each, log in zip(evidence, before, strict=True))
            self._misled_ns[frame.robot] = frame.stamp_ns if said >= BEYOND_DOUBT else None

    def _note_created(self, robot: int, new_ids: np.ndarray) -> None:
        if not len(new_ids):
            return
        while self._first_ids and self._first_ids[-1] >= new_ids[0]:
            self._first_ids.pop()
            self._creators.pop()
        self._first_ids.append(int(new_ids[0]))
        self._creators.append(robot)

    def _creator(self, landmark: int, robot: int) -> int:
        """The robot whose observation created a landmark; `robot` where that was loaded."""
        if landmark < self._loaded:
            return robot
        return self._creators[bisect_right(self._first_ids, landmark) - 1]
