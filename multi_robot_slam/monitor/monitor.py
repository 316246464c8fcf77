"""The monitor of a team: what each frame says of what the filter assumes.

It reads the state before a step and what the step made of the frames; it changes nothing and draws
nothing, and all it says follows from these. So a run that is repeated is judged alike.
"""

from bisect import bisect_right
from collections.abc import Sequence

import numpy as np

from msg_defs.types import CameraMount, Verdict
from multi_robot_slam.filter.rbpf import StepInfo
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.filter.state import State
from multi_robot_slam.models.frames import RobotFrame
from multi_robot_slam.monitor import learnt_noise
from multi_robot_slam.monitor.in_view import InView
from multi_robot_slam.monitor.innovations import Innovations
from multi_robot_slam.monitor.predictions import Predictions, predict
from multi_robot_slam.monitor.recognition import Recognition
from multi_robot_slam.monitor.verdicts import Findings, blamed, verdict, with_place_unknown
from multi_robot_slam.smoothing.noise_factors import NoiseFactors


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
        wrong = blamed(self._findings)
        told = []
        for robot in (frame.robot for frame in frames):
            judged = verdict(self._findings, robot, wrong, self._learnt(state, robot))
            is_placed = state.pieces.robots_in_map[robot]
            told.append(judged if is_placed else with_place_unknown(judged, state.pieces, robot))
        return tuple(told)

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
