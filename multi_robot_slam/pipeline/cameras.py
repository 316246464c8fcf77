"""One robot's stereo camera: messages in, pairs to look at out.

The node `camera`, `landmarks` and `run` all go this way: the same pictures become the same bytes.
"""

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from msg_defs import topics, wire
from msg_defs.errors import InputError
from msg_defs.topics import Topic
from msg_defs.types import CameraInfo, PoseSample
from multi_robot_slam.config import Config
from multi_robot_slam.front_end.front_end import FrontEnd
from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.front_end.settings import CameraSettings
from multi_robot_slam.front_end.sync import SIDES, Pair, Side, StereoSync
from multi_robot_slam.pipeline.due_pairs import DuePairs

MOST_UNCALIBRATED = 30
"""Pairs that wait for the first calibration; the camera's comes with each picture."""

_STAMP_END = 12
"""Where in a message begins what follows the stamp."""


class Look(NamedTuple):
    """A pair that is to be looked at."""

    robot: str
    pair: Pair
    front_end: FrontEnd
    """Made for the calibration that was known last when the pair was due."""


class Camera:
    """Pairs the pictures of one robot's two cameras, chooses among them, and calibrates them.

    Parameters
    ----------
    refuse : called for each message that is damaged, or picture without its other side.

    """

    def __init__(self, config: Config, robot: str, refuse: Callable[[InputError], None]) -> None:
        self.robot = robot
        self._config, self._refuse = config, refuse
        settings = config.camera
        slack_s = settings.approx_sync_max_interval_s if settings.approx_sync else 0.0
        self.sync = StereoSync(round(slack_s * 1e9))
        self.due = DuePairs(config)
        self._unmatched_told = 0
        self.calibration = Calibration(settings)
        self._uncalibrated: deque[Pair] = deque(maxlen=MOST_UNCALIBRATED)
        self.inputs: dict[Topic, Callable[[bytes], list[Look]]] = {}
        """What takes the messages of each topic, and gives the pairs that are due with it."""
        for side in SIDES:
            self.inputs[image_topic(settings, robot, side)] = partial(self._picture, side)
            self.inputs[topics.camera_info(robot, side)] = partial(self._info, side)

    def take(self, topic: Topic, data: bytes) -> list[Look]:
        """Take a message of one of `inputs`; the pairs that are due now, oldest first."""
        try:
            return self.inputs[topic](data)
        except InputError as error:
            self._refuse(error)
            return []

    def move(self, sample: PoseSample) -> list[Look]:
        """Take the robot's odometry; the pairs that are due now, oldest first."""
        return self._looks(self.due.move(sample))

    def rest(self) -> list[Look]:
        """Nothing more comes; the pairs that were not decided upon."""
        self.sync.give_up()
        self._tell_of_unmatched()
        looks = self._looks(self.due.rest())
        if self._uncalibrated:
            self._refuse(
                InputError(
                    f"calibration of {self.robot}: {len(self._uncalibrated)} pairs and no "
                    f"{self.calibration.missing(self.robot)}; record or publish it"
                )
            )
        return looks

    def _picture(self, side: Side, data: bytes) -> list[Look]:
        stamp_ns = wire.peek_stamp(data, f"{side} image of {self.robot}")
        pair = self.sync.take(side, stamp_ns, data)
        self._tell_of_unmatched()
        return self._looks(self.due.take(pair)) if pair else []

    def _info(self, side: Side, data: bytes) -> list[Look]:
        self.calibration.take(side, data, f"camera_info of {self.robot}: {side}")
        if not self.calibration.is_complete or not self._uncalibrated:
            return []
        pairs = [*self._uncalibrated]
        self._uncalibrated.clear()
        return self._looks(pairs)

    def _looks(self, pairs: list[Pair]) -> list[Look]:
        if not self.calibration.is_complete:
            self._uncalibrated.extend(pairs)
            return []
        looks = []
        for pair in pairs:
            try:
                looks.append(Look(self.robot, pair, self.calibration.front_end()))
            except InputError as error:
                self._refuse(InputError(f"calibration of {self.robot}: {error}"))
        return looks

    def _tell_of_unmatched(self) -> None:
        for _ in range(self.sync.unmatched - self._unmatched_told):
            self._refuse(InputError(f"unmatched image of {self.robot}: {self.mismatch()}"))
        self._unmatched_told = self.sync.unmatched

    def mismatch(self) -> str:
        """Why pictures stay without their other side, as far as the stamps tell."""
        nearest_ns, camera = self.sync.smallest_ns, self._config.camera
        if nearest_ns is None:
            return "nothing comes from the other camera; check both topics"
        told = f"the nearest of the other camera is {nearest_ns / 1e6:.3f} ms off"
        if camera.approx_sync:
            limit = f"camera.approx_sync_max_interval_s = {camera.approx_sync_max_interval_s:g}"
            return f"{told}; trigger both at once, or raise {limit}"
        return f"{told}; trigger both at once, or set camera.approx_sync: true"


class Calibration:
    """The two calibrations that were heard last, and the front end for them."""

    def __init__(self, settings: CameraSettings) -> None:
        self._settings = settings
        self._known: dict[Side, bytes] = {}
        self._infos: dict[Side, CameraInfo] = {}
        self._front_end: FrontEnd | None = None
        self.changes = 0
        """How often a calibration was replaced by another one."""

    @property
    def is_complete(self) -> bool:
        """Both sides have one."""
        return len(self._infos) == len(SIDES)

    def missing(self, robot: str) -> str:
        """The topics on which none has come."""
        names = (topics.camera_info(robot, side).name for side in SIDES if side not in self._infos)
        return " and no ".join(names)

    def take(self, side: Side, data: bytes, what: str) -> None:
        """Take a camera_info; most say what the last one said, and are not even decoded."""
        content = data[_STAMP_END:]
        if self._known.get(side) == content:
            return
        info = wire.decode_camera_info(data, what)
        self.changes += side in self._known
        self._known[side], self._infos[side] = content, info
        self._front_end = None

    def front_end(self) -> FrontEnd:
        """The one for what is known now; `InputError` where no rig follows from that."""
        if self._front_end is None:
            rig = StereoRig.of(
                self._infos["left"],
                self._infos["right"],
                rectify=is_to_rectify(self._settings),
                baseline_m=self._settings.baseline_m,
            )
            self._front_end = FrontEnd(rig, self._settings)
        return self._front_end


def is_to_rectify(settings: CameraSettings) -> bool:
    """Pictures come as the cameras take them."""
    if settings.rectify == "auto":
        return "rect" not in settings.image
    return settings.rectify == "yes"


def image_topic(settings: CameraSettings, robot: str, side: Side) -> Topic:
    """Where the pictures of one side come."""
    is_raw = settings.image_transport == "raw"
    kind = topics.image if is_raw else topics.compressed_image
    return kind(robot, side, settings.image)
