"""What flows between the packages: plain frozen records of NumPy arrays.

Frames
------
map         the world frame all estimates live in
odom        a robot's own odometry frame, drifting against `map`
base_link   on the robot: x forward, y left, z up
camera      the left camera as in the paper's (14): X right, Y up, Z forward.
            Messages use the optical frame of REP-103 (x right, y down, z forward);
            `msg_defs.wire` flips the sign, nobody else does.

Symmetric 3x3 covariances are stored as six numbers in the order `xx xy xz yy yz zz`.
Stamps are integer nanoseconds.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeVar, dataclass_transform

import numpy as np
from annotated_types import Gt

from msg_defs import limits

DESCRIPTOR_SIZE = 128
"""Elements of a SIFT descriptor; descriptors have unit norm before noise."""

COVARIANCE_ORDER = ("xx", "xy", "xz", "yy", "yz", "zz")
"""The order in which the six distinct elements of a covariance are stored."""


Cls = TypeVar("Cls")


@dataclass_transform(frozen_default=True)
def settings(cls: type[Cls]) -> type[Cls]:
    """Declare a settings record: frozen, and checked whoever makes it (`msg_defs.limits.check`).

    `InputError` names the first field that has the wrong type or lies out of its range. The class's
    own `__post_init__` then checks what several fields must have in common.
    """
    namespace: Any = cls
    own = getattr(cls, "__post_init__", lambda record: None)

    def check(record: Any) -> None:
        limits.check(record)
        own(record)

    namespace.__post_init__ = check
    namespace.__pydantic_config__ = {"extra": "forbid", "allow_inf_nan": False}
    return dataclass(frozen=True)(cls)


@settings
class CameraMount:
    """Where the left camera sits on the robot, and where it looks.

    The camera is turned from straight ahead by roll, then pitch, then yaw, about the axes of
    `base_link` (REP-103): Rz(yaw) Ry(pitch) Rx(roll).
    """

    forward_m: Annotated[float, "left camera ahead of base_link [m]"] = 0.0
    left_m: Annotated[float, "left camera to the left of base_link [m]"] = 0.06
    up_m: Annotated[float, "left camera above base_link [m]"] = 1.0
    roll_rad: Annotated[float, "camera rolled clockwise, seen from behind [rad]"] = 0.0
    pitch_rad: Annotated[float, "camera pitched down [rad]"] = 0.0
    yaw_rad: Annotated[float, "camera turned to the left [rad]"] = 0.0


@settings
class StereoCamera:
    """Two pin-hole cameras with parallel axes, and where they sit on the robot (paper sec. 3.2)."""

    focal_px: Annotated[float, Gt(0), "focal length f [px]"] = 500.0
    baseline_m: Annotated[float, Gt(0), "distance I between the two cameras [m]"] = 0.12
    width_px: Annotated[int, Gt(0), "image width [px]"] = 640
    height_px: Annotated[int, Gt(0), "image height [px]"] = 480
    sigma_rc_px: Annotated[float, Gt(0), "standard deviation of row and column [px]"] = 10.0
    sigma_disparity_px: Annotated[float, Gt(0), "standard deviation of the disparity [px]"] = 0.1
    mount: CameraMount = field(default_factory=CameraMount)

    @property
    def centre_px(self) -> tuple[float, float]:
        """Column and row (C_x, C_y) where the optical axis meets the image [px]."""
        return self.width_px / 2, self.height_px / 2


@dataclass(frozen=True, eq=False)
class PoseSample:
    """A planar pose of one robot: odometry (in its `odom` frame) or ground truth (in `map`)."""

    robot: str
    stamp_ns: int
    pose: np.ndarray
    """(3,) float64: x [m], y [m], yaw [rad]."""
    twist: np.ndarray = field(default_factory=lambda: np.zeros(2))
    """(2,) float64: forward velocity [m/s], yaw rate [rad/s], in `base_link`."""
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) float64: covariance of `pose` [m^2, m rad, rad^2]."""


@dataclass(frozen=True, eq=False)
class ObservationSet:
    """Everything one stereo camera sees at one instant: B observations z = (v, d)."""

    robot: str
    stamp_ns: int
    positions: np.ndarray
    """(B, 3) float32: v = (X, Y, Z) in the camera frame [m]."""
    covariances: np.ndarray
    """(B, 6) float32: R_t of each v, camera frame [m^2]."""
    descriptors: np.ndarray
    """(B, 128) float32: d."""


@dataclass(frozen=True, eq=False)
class EncodedObservations:
    """An `ObservationSet` that is decoded when it is needed, and otherwise never."""

    robot: str
    stamp_ns: int
    decode: Callable[[], ObservationSet]
    """`InputError` where the message is damaged or means nothing."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """The S robots that one robot's stereo camera sees at one instant."""

    robot: str
    """The robot that sees."""
    stamp_ns: int
    others: np.ndarray
    """(S,) uint32: index in the team of each robot seen."""
    positions: np.ndarray
    """(S, 3) float32: a point on the vertical through its `base_link`, in the camera frame [m]."""
    covariances: np.ndarray
    """(S, 6) float32: R of each position, camera frame [m^2]."""


@dataclass(frozen=True, eq=False)
class ObservationTruth:
    """Which true landmark each observation of an `ObservationSet` came from (evaluation only)."""

    robot: str
    stamp_ns: int
    landmarks: np.ndarray
    """(B,) uint32: row in the true `LandmarkMap`."""


@dataclass(frozen=True, eq=False)
class Image:
    """One picture of one camera, as it was sent."""

    stamp_ns: int
    frame: str
    """The message's frame_id."""
    encoding: str
    """As in sensor_msgs/image_encodings: mono8, bgr8, ...; of a compressed one what it became."""
    pixels: np.ndarray
    """(H, W) or (H, W, C), uint8 or uint16."""


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """One camera's calibration, as sensor_msgs/CameraInfo has it."""

    stamp_ns: int
    frame: str
    width_px: int
    height_px: int
    distortion_model: str
    distortion: np.ndarray
    """(n,) float64: D."""
    intrinsics: np.ndarray
    """(3, 3) float64: K, of the unrectified image [px]."""
    rotation: np.ndarray
    """(3, 3) float64: R, from the camera to the rectified one."""
    projection: np.ndarray
    """(3, 4) float64: P, of the rectified image [px]; on the right P[0, 3] = -f baseline."""


Frame = ObservationSet | EncodedObservations
"""What a robot sees of the world at one instant."""

Event = PoseSample | Frame | Sightings
"""What a pipeline consumes: odometry, observations, and robots seen."""


class FrameCount(NamedTuple):
    """What became of one robot's frames."""

    seen: int
    """Frames that could be used."""
    used: int
    """Those that became steps of the filter: keyframes."""


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """N landmarks, estimated (the best particle's map) or true (zero covariance)."""

    ids: np.ndarray
    """(N,) uint32: stable identity of each landmark."""
    positions: np.ndarray
    """(N, 3) float32 in `map` [m]."""
    covariances: np.ndarray
    """(N, 6) float32 in `map` [m^2]."""
    observations: np.ndarray
    """(N,) uint32: how often each was observed, its creation included."""
    robots: np.ndarray
    """(N,) uint32: bit i is set when the i-th robot of the team observed it."""
    descriptors: np.ndarray
    """(N, 128) float32."""


@dataclass(frozen=True, eq=False)
class Walls:
    """Vertical walls that stand on the ground and block sight."""

    segments: np.ndarray
    """(W, 4) float64: x0, y0, x1, y1 of each wall in `map` [m]."""
    height_m: float


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """What the best particle made of one robot's frame."""

    robot: str
    landmarks: np.ndarray
    """(B,) int64: id of the landmark each observation updated or created."""
    is_new: np.ndarray
    """(B,) bool: the observation created its landmark."""
    is_rejected: np.ndarray
    """(B,) bool: a descriptor matched, but every match lay outside the gate D_0."""
    mahalanobis: np.ndarray
    """(B,) float32: D (18) of the accepted match, NaN for a new landmark."""
    descriptor_distance: np.ndarray
    """(B,) float32: E (19) of the accepted match, NaN for a new landmark."""
    others: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))
    """(S,) int64: index in the team of each robot seen."""
    other_mahalanobis: np.ndarray = field(default_factory=lambda: np.empty(0, np.float32))
    """(S,) float32: squared Mahalanobis distance of each sighting."""
    is_other_rejected: np.ndarray = field(default_factory=lambda: np.empty(0, bool))
    """(S,) bool: the sighting lay outside its gate."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """One robot's pose after a step."""

    robot: str
    stamp_ns: int
    pose: np.ndarray
    """(3,) float64: x [m], y [m], yaw [rad] in `map`, of the best particle (17).

    Of the particles' mean where they are rejuvenated: then each is a draw from the posterior.
    """
    covariance: np.ndarray
    """(3, 3) float64: covariance of the particle set around its mean [m^2, m rad, rad^2]."""
    mean: np.ndarray | None = None
    """(3,) float64: x [m], y [m], yaw [rad], weighted mean of the particle set, in `map`.

    Taken with the covariance right after weighing. None where it was not recorded.
    """


Level = Literal["consistent", "place unknown", "noisier than told", "start wrong", "lost"]
"""How what a robot sends agrees with what the filter assumes, the best first."""

PLACE_UNKNOWN: Final = "place unknown"
"""Level of a robot whose place in `map` is not known yet."""

WRONG: Final = ("start wrong", "lost")
"""Levels of a robot that is not where it seems to be."""


@dataclass(frozen=True)
class Verdict:
    """Whether what one robot sends agrees with what the filter assumes of it, and what to do."""

    robot: str
    level: Level
    cause: str = ""
    """What it is judged by, in one sentence; empty where there is nothing to say."""
    remedy: str = ""
    """What to change; empty where nothing is wrong."""
    numbers: dict[str, float] = field(default_factory=dict)
    """What the level was found from, by name and unit."""


@dataclass(frozen=True, eq=False)
class Tied:
    """Two pieces of the map that have become one."""

    robots: tuple[str, ...]
    """Of the piece that was turned."""
    is_in_map: bool
    """Their place in `map` is known from now on."""
    pose: np.ndarray
    """(3,): where its frame lies in that of the other piece: x, y [m], yaw [rad]."""
    landmarks: int
    """That agree on it."""
    places: int
    """Of these landmarks, far enough apart to be things of their own."""
    runner_up: int
    """Places that agree on the best other pose."""
    seconds: float
    """Since both pieces had eight landmarks, or all, of those that agree [s]."""


@dataclass(frozen=True, eq=False)
class StepRecord:
    """One step of the filter, for whoever watches it."""

    stamp_ns: int
    step: int
    frames: tuple[FrameRecord, ...]
    estimates: tuple[Estimate, ...]
    """Of each robot that had a frame in this step and whose place in `map` is known, in order."""
    effective_particles: float
    """Effective sample size of the weights before resampling, 1 .. M."""
    resampled: bool
    duration_ms: float
    rejuvenated: float | None = None
    """Effective sample size of the importance weights where the paths were drawn anew, 1 .. M."""
    verdicts: tuple[Verdict, ...] = ()
    """One for each robot that had a frame in this step, in the same order; or none was recorded."""
    tied: Tied | None = None
    """What became one after this step."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A robot's path: T poses in `map`."""

    stamps_ns: np.ndarray
    """(T,) int64, ascending."""
    poses: np.ndarray
    """(T, 3) float64: x [m], y [m], yaw [rad]."""
