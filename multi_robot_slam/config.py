"""The estimate's configuration: one record of all modules' settings."""

from dataclasses import field
from typing import Annotated, Final, Literal

import numpy as np
from annotated_types import Ge, Gt

from msg_defs import scenario_file, topics
from msg_defs.errors import InputError
from msg_defs.types import CameraMount, settings
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.front_end.settings import CameraSettings

SECTION = "multi_robot_slam"
FOR_PICTURES = "cameras"
"""The shipped scenario whose filter is the default where observations are seen in pictures."""
UNKNOWN: Final = "unknown"
StartPose = tuple[float, float, float] | Literal["unknown"]
MOST_ROBOTS = 32
"""A landmark keeps which robots observed it in as many bits."""

SHORTEST_APART_S = 1.0
"""Clocks on one machine, and messages on their way, differ by less."""


@settings
class Plausible:
    """What can be true of what comes in; the rest is dropped, counted and told.

    Wide enough for whatever drives on the ground. What lies outside is an error of the sender, and
    would carry an error into every particle.
    """

    farthest_m: Annotated[
        float,
        Gt(0),
        "farthest observation from the camera [m]; at 1 km a stereo pair of 1 m and 1000 px sees a "
        "disparity of 1 px",
    ] = 1000.0
    smallest_sigma_m: Annotated[
        float,
        Gt(0),
        "smallest standard deviation of an observed point, in any direction [m]; a tenth of what "
        "the best cameras reach, and what single precision resolves 100 m from the origin",
    ] = 1e-5
    largest_sigma_m: Annotated[
        float,
        Gt(0),
        "largest standard deviation of an observed point, in any direction [m]; ten times the "
        "farthest observation, and its sixth power is still far inside single precision",
    ] = 1e4
    descriptor_norm_error: Annotated[
        float,
        Gt(0),
        "farthest norm of a descriptor from 1; the root of E_0, further off no unit vector matches",
    ] = 0.2
    most_observations: Annotated[
        int,
        Ge(1),
        "most observations of a frame that are used, evenly spread over it; memory and time grow "
        "with their square",
    ] = 1000
    farthest_odometry_m: Annotated[
        float,
        Gt(0),
        "farthest odometry from its origin [m]; half way round the Earth, so that UTM is allowed",
    ] = 2e7
    fastest_m_s: Annotated[
        float, Gt(0), "fastest robot between two odometry samples [m/s]; 108 km/h"
    ] = 30.0
    fastest_rad_s: Annotated[
        float, Gt(0), "fastest turn between two odometry samples [rad/s]; 1.6 turns a second"
    ] = 10.0

    def used(self, count: int) -> np.ndarray:
        """Rows of the observations that are used of a frame that has `count`."""
        most = min(count, self.most_observations)
        return np.arange(most) * count // max(most, 1)


@settings
class Keyframe:
    """Which frames become steps of the filter: those from which something new can be seen.

    Between two of them a pose is the last estimate moved by odometry (`Pipeline.predict`).
    """

    distance_m: Annotated[
        float,
        Ge(0),
        "a frame becomes a step when its robot has moved so far since its last one that did [m]; "
        "nearer by, the errors of a camera are hardly independent; 0: every frame is a step",
    ] = 0.25
    yaw_rad: Annotated[
        float,
        Ge(0),
        "or has turned so far [rad]; a seventh of a view of 65 degrees; 0: every frame is a step",
    ] = 0.15

    @property
    def is_on(self) -> bool:
        """Frames may be passed over, and poses are predicted in between."""
        return self.distance_m > 0 and self.yaw_rad > 0


EVERY_FRAME = Keyframe(distance_m=0.0, yaw_rad=0.0)
"""Every frame is a step, as in the paper, and poses are published at steps alone."""


@settings
class Config:
    """Everything the fusion needs to know before the first message."""

    robots: Annotated[tuple[str, ...], "names of the team's robots"] = ("robot_1",)
    start_poses: Annotated[
        tuple[StartPose, ...],
        "x, y, yaw of each robot at the start [m, m, rad], or unknown, for all but one, and for "
        "all where a map is loaded: such a robot maps by itself, and has a place in `map` once it "
        "has seen enough of what is there",
    ] = ((0.0, 0.0, 0.0),)
    start_sigma: Annotated[
        tuple[float, float],
        "standard deviations of the start poses [m, rad]; `map` is where the first robot with one "
        "is at its own, so that its error is the others'; as well as a robot is put down by hand "
        "and by eye, or measured with a tape: 5 cm and 2 degrees; 0, 0: known",
    ] = (0.05, 0.035)
    start_sigmas: Annotated[
        tuple[tuple[float, float], ...],
        "instead of `start_sigma`, for each robot, the first included [m, rad]",
    ] = ()
    start_at: Annotated[
        Literal["odom", "first message"],
        "what lies at a start pose: the origin of the robot's odometry, so that a fusion may begin "
        "late; or the robot at its first odometry message, whatever that says",
    ] = "odom"
    seed: Annotated[int, Ge(0), "seed of the filter's random numbers"] = 0
    reorder_window_s: Annotated[
        float, Ge(0), "how long a silent robot holds the others back, in message time [s]"
    ] = 5.0
    sightings: Annotated[
        bool, "each robot sends the robots it sees, even if none, with every frame"
    ] = False
    camera_frame: Annotated[
        str, "frame of the clouds; {robot} stands for the robot's name, empty accepts any"
    ] = topics.CAMERA_FRAME
    mount: CameraMount = field(default_factory=CameraMount)
    mounts: Annotated[
        tuple[tuple[float, float, float, float, float, float], ...],
        "instead of `mount`, for each robot: forward, left, up, roll, pitch, yaw [m, rad]",
    ] = ()
    camera: CameraSettings = field(default_factory=CameraSettings)
    plausible: Plausible = field(default_factory=Plausible)
    keyframe: Keyframe = field(default_factory=Keyframe)
    filter: FilterSettings = field(default_factory=FilterSettings)

    def __post_init__(self) -> None:
        names, count = self.robots, len(self.robots)
        for name in names:
            topics.require_robot_name(name)
        if not 0 < count <= MOST_ROBOTS or len(set(names)) < count:
            raise InputError(
                f"robots = {list(names)}: name each robot of the team once, {MOST_ROBOTS} at most"
            )
        if len(self.start_poses) != count:
            raise InputError(
                f"start_poses: {len(self.start_poses)} poses for {count} robots; "
                "give x, y, yaw of each"
            )
        if self.mounts and len(self.mounts) != count:
            raise InputError(
                f"mounts: {len(self.mounts)} for {count} robots; give forward, left, up, roll, "
                "pitch, yaw of each, or none and `mount` for all"
            )
        if self.start_sigmas and len(self.start_sigmas) != count:
            raise InputError(
                f"start_sigmas: {len(self.start_sigmas)} for {count} robots; give metres and "
                "radians of each, or none and `start_sigma` for all"
            )
        for sigmas in (self.start_sigma, *self.start_sigmas):
            if not (np.isfinite(sigmas).all() and min(sigmas) >= 0):
                raise InputError(
                    f"start_sigma = {list(sigmas)}: give standard deviations in m and rad, "
                    "0 or more"
                )
        self._require_tags_of_robots()

    def _require_tags_of_robots(self) -> None:
        for number, robot, *_ in self.camera.tags.on_robots:
            if robot >= len(self.robots):
                raise InputError(
                    f"camera.tags.on_robots: robot {robot} of tag {number}; give its place in "
                    f"robots: 0 to {len(self.robots) - 1}"
                )
        if self.camera.tags.on_robots and not self.sightings:
            raise InputError(
                "camera.tags.on_robots: robots carry tags, but sightings is false, so that nobody "
                "would hear of them; set sightings: true"
            )

    def start_sigma_of(self, robot: int) -> tuple[float, float]:
        """Standard deviations [m, rad] of the start pose of the robot with this index."""
        if self.start_sigmas:
            return self.start_sigmas[robot]
        return (0.0, 0.0) if robot == np.argmax(self.are_known) else self.start_sigma

    @property
    def are_known(self) -> np.ndarray:
        """(K,) bool: whose start poses are."""
        return np.array([start != UNKNOWN for start in self.start_poses])

    @property
    def starts(self) -> np.ndarray:
        """(K, 3): the start poses; where one is unknown, the origin."""
        nowhere = (0.0, 0.0, 0.0)
        return np.array([nowhere if s == UNKNOWN else s for s in self.start_poses], float)

    def mount_of(self, robot: int) -> CameraMount:
        """Where the camera sits on the robot with this index in the team."""
        return CameraMount(*self.mounts[robot]) if self.mounts else self.mount

    @property
    def publishes_mean(self) -> bool:
        """The particles are rejuvenated: draws from the posterior, of which none is the best."""
        return self.filter.rejuvenation.ancestors_below > 0

    @property
    def apart_ns(self) -> int:
        """How far apart the stamps of robots may be that are heard at one time [ns]."""
        return int(max(self.reorder_window_s, SHORTEST_APART_S) * 1e9)


def shipped(scenario: str) -> Config:
    """What a scenario that ships says of the estimate: `paper`, `calibrated`, `cameras`."""
    return scenario_file.from_file(Config, scenario_file.find_scenario(scenario), SECTION)
