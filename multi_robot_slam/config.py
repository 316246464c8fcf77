"""The estimate's configuration: one record of all modules' settings."""

from dataclasses import field
from typing import Annotated

from annotated_types import Ge

from msg_defs.errors import InputError
from msg_defs.types import CameraMount, settings
from multi_robot_slam.filter.settings import FilterSettings

SECTION = "multi_robot_slam"
MOST_ROBOTS = 32
"""A landmark keeps which robots observed it in as many bits."""


@settings
class Config:
    """Everything the fusion needs to know before the first message."""

    robots: Annotated[tuple[str, ...], "names of the team's robots"] = ("robot_1",)
    start_poses: Annotated[
        tuple[tuple[float, float, float], ...], "x, y, yaw of each robot at the start [m, m, rad]"
    ] = ((0.0, 0.0, 0.0),)
    seed: Annotated[int, Ge(0), "seed of the filter's random numbers"] = 0
    reorder_window_s: Annotated[
        float, Ge(0), "how long a silent robot holds the others back, in message time [s]"
    ] = 5.0
    sightings: Annotated[
        bool, "each robot sends the robots it sees, even if none, with every frame"
    ] = False
    mount: CameraMount = field(default_factory=CameraMount)
    mounts: Annotated[
        tuple[tuple[float, float, float, float, float, float], ...],
        "instead of `mount`, for each robot: forward, left, up, roll, pitch, yaw [m, rad]",
    ] = ()
    filter: FilterSettings = field(default_factory=FilterSettings)

    def __post_init__(self) -> None:
        names, count = self.robots, len(self.robots)
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

    def mount_of(self, robot: int) -> CameraMount:
        """Where the camera sits on the robot with this index in the team."""
        return CameraMount(*self.mounts[robot]) if self.mounts else self.mount
