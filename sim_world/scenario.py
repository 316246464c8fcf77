"""The scenario: everything that decides what the simulated world does, except the seed."""

from dataclasses import field
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Interval

from msg_defs import topics
from msg_defs.types import StereoCamera, settings
from sim_world.rendering.settings import ImageSettings

SECTION = "sim_world"
Tour = Literal["figure_eight", "hall_first", "ring"]


@settings
class OdometryNoise:
    """Random errors of wheel odometry, per movement and in the robot's own frame.

    Variances grow with the distance driven and the angle turned (Chong and Kleeman, *Accurate
    odometry and error modelling for a mobile robot*, ICRA 1997), so that the error of a path does
    not depend on how many movements it is cut into. The paper gives no numbers. These describe a
    calibrated differential-drive base on a hard floor: 2 cm and 0.6 degrees after one metre, 1.4
    degrees more after a quarter turn.
    """

    forward_per_sqrt_m: Annotated[
        float, Ge(0), "standard deviation along the robot after 1 m [m/sqrt(m)]"
    ] = 0.02
    left_per_sqrt_m: Annotated[
        float, Ge(0), "standard deviation across the robot after 1 m [m/sqrt(m)]"
    ] = 0.005
    yaw_per_sqrt_m: Annotated[
        float, Ge(0), "standard deviation of the heading after 1 m [rad/sqrt(m)]"
    ] = 0.01
    yaw_per_sqrt_rad: Annotated[
        float, Ge(0), "standard deviation of the heading after turning 1 rad [rad/sqrt(rad)]"
    ] = 0.02


@settings
class Scenario:
    """A team of robots in the building, and what its sensors are like (paper sec. 6, Table 2)."""

    robots: Annotated[int, Interval(ge=1, le=32), "number of robots K"] = 3
    trajectory: Annotated[Tour, "tour through the building"] = "figure_eight"
    start_offset: Annotated[
        float, Interval(ge=0, lt=1), "where along the tour the first robot starts [share of it]"
    ] = 0.0
    movements: Annotated[
        int,
        Interval(ge=1, le=100_000),
        "movements T of one round of the tour; a robot makes T/K of them",
    ] = 450
    laps: Annotated[
        int,
        Interval(ge=1, le=1_000_000),
        "rounds of the tour that the team makes, T movements each",
    ] = 1
    period_s: Annotated[float, Ge(0.001), "time between two frames of a robot [s]"] = 0.5
    odometry_per_frame: Annotated[
        int,
        Interval(ge=1, le=1000),
        "odometry samples for each frame, evenly spread; wheels report more often than cameras",
    ] = 1
    camera: StereoCamera = field(default_factory=StereoCamera)
    d_max_m: Annotated[float, Gt(0), "greatest distance of an observed landmark [m]"] = 10.0
    observations: Annotated[
        int, Interval(ge=0, le=1000), "most observations B of a robot in one frame"
    ] = 15
    descriptor_noise: Annotated[
        float, Ge(0), "standard deviation of each element of an observed descriptor"
    ] = 0.01
    landmarks: Annotated[int, Interval(ge=1, le=1_000_000), "number of landmarks"] = 900
    world_seed: Annotated[int, Ge(0), "seed of the landmarks' places and descriptors"] = 0
    odometry: OdometryNoise = field(default_factory=OdometryNoise)
    descriptor_database: Annotated[
        str, "file made by `sim_world descriptors`; empty is the one shipped"
    ] = ""
    images: ImageSettings = field(default_factory=ImageSettings)

    @property
    def odometry_period_s(self) -> float:
        """Time between two odometry samples of a robot."""
        return self.period_s / self.odometry_per_frame

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the robots, in the team's order."""
        return tuple(topics.robot_name(i) for i in range(self.robots))
