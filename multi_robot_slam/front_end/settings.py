"""Settings of the cameras: where images come from, and what is looked for in them."""

from dataclasses import field
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Interval

from msg_defs.errors import InputError
from msg_defs.types import settings
from multi_robot_slam.front_end.tag_families import FAMILIES

DESCRIPTOR_GATE = 0.15
"""E_0 for descriptors of real pictures, where the filter's default is for simulated ones.

Up to here 99 of 100 matches are right where a pose is known to 3 cm and 0.3 degrees, and 62 % of
the keypoints that are seen again are matched (docs/design.md, section 5).
"""


@settings
class FeatureSettings:
    """Which points of a stereo pair become observations, and how exact they are."""

    features: Annotated[int, Ge(1), "most SIFT keypoints of the left image, strongest first"] = 1000
    contrast_threshold: Annotated[float, Gt(0), "SIFT's least contrast of a keypoint"] = 0.02
    scale: Annotated[
        float, Interval(gt=0, le=1), "size of the images that are searched; 0.5 takes a third"
    ] = 1.0
    observations: Annotated[
        int, Interval(ge=1, le=1000), "most observations of a pair, spread over the image"
    ] = 100
    nearest_m: Annotated[float, Gt(0), "nearest point [m]: the largest disparity searched"] = 0.4
    farthest_m: Annotated[float, Gt(0), "farthest point [m]"] = 40.0
    correlation: Annotated[
        float, Interval(ge=0, lt=1), "least normalised cross-correlation of left and right"
    ] = 0.8
    distinct: Annotated[
        float, Ge(0), "least squared distance of a point's descriptor from all others of its image"
    ] = 0.15
    sigma_px: Annotated[
        float,
        Gt(0),
        "standard deviation of row and column of a small keypoint, in the image searched [px]",
    ] = 0.4
    sigma_disparity_px: Annotated[
        float, Gt(0), "standard deviation of the disparity of a window full of texture [px]"
    ] = 0.08


@settings
class TagSettings:
    """AprilTag and ArUco markers in the same images; without a family none are looked for."""

    family: Annotated[str, "family of the tags: 36h11, 4x4_50, ...; empty: none"] = ""
    size_m: Annotated[float, Gt(0), "side of a tag's black square [m]"] = 0.16
    sigma_px: Annotated[
        float, Gt(0), "least standard deviation of a corner's column and row, in each image [px]"
    ] = 0.1
    on_robots: Annotated[
        tuple[tuple[int, int, float, float, float], ...],
        "tags that robots carry upright: number, robot (its place in `robots`, from 0), where the "
        "tag's centre is on its base_link: forward, left [m], and where it faces: yaw [rad], 0 "
        "ahead, pi / 2 to the left",
    ] = ()

    def __post_init__(self) -> None:
        if self.family and self.family not in FAMILIES:
            raise InputError(
                f"camera.tags.family = {self.family!r}: known are {', '.join(FAMILIES)}"
            )
        if self.on_robots and not self.family:
            raise InputError("camera.tags.on_robots: no tags are looked for; set tags.family")
        numbers = [number for number, *_ in self.on_robots]
        for number, robot, *_ in self.on_robots:
            if not 0 <= number < FAMILIES[self.family].numbers or numbers.count(number) > 1:
                raise InputError(
                    f"camera.tags.on_robots: tag {number}; give each once, "
                    f"{self.family} has 0 to {FAMILIES[self.family].numbers - 1}"
                )
            if robot < 0:
                raise InputError(
                    f"camera.tags.on_robots: robot {robot} of tag {number}; give its place in "
                    "robots, from 0"
                )


@settings
class CameraSettings:
    """A robot's stereo camera as the node `camera`, `landmarks` and `run` read it."""

    image: Annotated[str, "last part of the topics <robot>/left/..., <robot>/right/..."] = (
        "image_rect"
    )
    image_transport: Annotated[Literal["raw", "compressed"], "type of the image messages"] = "raw"
    rectify: Annotated[
        Literal["auto", "yes", "no"], "auto: unless the topic's name says that it is done (rect)"
    ] = "auto"
    baseline_m: Annotated[
        float, Ge(0), "distance of the two cameras [m], where camera_info does not tell; 0: it does"
    ] = 0.0
    approx_sync: Annotated[bool, "whether left and right may differ in their stamps"] = False
    approx_sync_max_interval_s: Annotated[float, Gt(0), "by so much at most [s]"] = 0.01
    rest_s: Annotated[
        float, Gt(0), "a robot that rests, by its odometry, has a pair looked at so often [s]"
    ] = 1.0
    preview_px: Annotated[
        int, Ge(0), "width of the picture kept of each pair that was looked at [px]; 0: none"
    ] = 320
    features: FeatureSettings = field(default_factory=FeatureSettings)
    tags: TagSettings = field(default_factory=TagSettings)
