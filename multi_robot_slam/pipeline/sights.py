"""What a pair of pictures shows, as the messages that are published or recorded of it."""

from typing import NamedTuple

import cv2
import numpy as np

from msg_defs import topics, wire
from msg_defs.errors import InputError
from msg_defs.topics import CAMERA_FRAME, Topic
from msg_defs.types import CameraInfo, Image, ObservationSet, Sightings
from multi_robot_slam.config import Config
from multi_robot_slam.front_end.front_end import Seen
from multi_robot_slam.front_end.grey import grey
from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.front_end.settings import CameraSettings
from multi_robot_slam.front_end.sync import SIDES
from multi_robot_slam.front_end.tags import RobotsSeen
from multi_robot_slam.pipeline.cameras import Look

PREVIEW_QUALITY = 75
"""Of JPEG: some 10 kB for a picture 320 pixels wide."""

Message = tuple[Topic, bytes]


class Sight(NamedTuple):
    """What one pair shows."""

    seen: Seen
    observations: bytes
    """The cloud, as on `<robot>/stereo/landmarks`."""
    sightings: bytes
    """The robots whose tags are in view, as on `<robot>/sightings`; empty where none carry any."""
    messages: tuple[Message, ...]
    """All that is told of it: cloud, sightings, the preview, and the preview's calibration."""


def see(look: Look, config: Config) -> Sight:
    """Look at a pair; `InputError` where a picture is damaged or means nothing.

    A pure function of the two pictures, the calibration and the settings.
    """
    left, right = (
        grey(_picture(config.camera, data, f"{side} image of {look.robot}"))
        for side, data in zip(SIDES, (look.pair.left, look.pair.right), strict=True)
    )
    try:
        seen = look.front_end.observe(left, right)
    except InputError as error:
        raise InputError(f"pair of {look.robot}: {error}") from None
    except cv2.error as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"pair of {look.robot}, {left.shape[1]} x {left.shape[0]}: OpenCV cannot look at it "
            f"({reason}); check camera_info and camera.features"
        ) from None
    stamp_ns, frame = look.pair.stamp_ns, config.camera_frame or CAMERA_FRAME
    observed = ObservationSet(
        look.robot, stamp_ns, seen.positions, seen.covariances, seen.descriptors
    )
    cloud = wire.encode_observations(observed, frame)
    told: tuple[Message, ...] = ((topics.observations(look.robot), cloud),)
    others = b""
    if config.camera.tags.on_robots:
        others = wire.encode_sightings(_others(look, seen.tags.robots, config), frame)
        told += ((topics.sightings(look.robot), others),)
    if config.camera.preview_px:
        frame_id = topics.camera_frame(look.robot, frame)
        rig = look.front_end.rig
        picture = Image(stamp_ns, frame_id, "mono8", rig.rectified(left, right)[0])
        told += _preview(look.robot, picture, rig, config.camera.preview_px)
    return Sight(seen, cloud, others, told)


def _others(look: Look, seen: RobotsSeen, config: Config) -> Sightings:
    """The robots in view, but for the one that looks."""
    rows = seen.others != config.robots.index(look.robot)
    return Sightings(look.robot, look.pair.stamp_ns, *(values[rows] for values in seen))


def _picture(settings: CameraSettings, data: bytes, what: str) -> Image:
    is_raw = settings.image_transport == "raw"
    return wire.decode_image(data, what) if is_raw else wire.decode_compressed(data, what)


def _preview(robot: str, picture: Image, rig: StereoRig, width_px: int) -> tuple[Message, ...]:
    """The rectified left picture made small, and its calibration."""
    scale = min(1.0, width_px / rig.width_px)
    size = max(1, round(rig.width_px * scale)), max(1, round(rig.height_px * scale))
    small = cv2.resize(picture.pixels, size, interpolation=cv2.INTER_AREA)
    shrunk = Image(picture.stamp_ns, picture.frame, picture.encoding, small)
    return (
        (topics.preview(robot), wire.encode_compressed(shrunk, "jpeg", PREVIEW_QUALITY)),
        (topics.preview_info(robot), wire.encode_camera_info(_calibration(shrunk, rig))),
    )


def _calibration(picture: Image, rig: StereoRig) -> CameraInfo:
    """Of the rig's left picture made as small as this one."""
    height_px, width_px = picture.pixels.shape
    across, down = width_px / rig.width_px, height_px / rig.height_px
    # A pixel's place is its middle: the left edge of the first is at -0.5.
    centre_x, centre_y = (rig.centre_px[0] + 0.5) * across, (rig.centre_px[1] + 0.5) * down
    intrinsics = np.array(
        [
            [rig.focal_px * across, 0, centre_x - 0.5],
            [0, rig.focal_px * down, centre_y - 0.5],
            [0, 0, 1],
        ]
    )
    return CameraInfo(
        picture.stamp_ns,
        picture.frame,
        width_px,
        height_px,
        "plumb_bob",
        np.zeros(5),
        intrinsics,
        np.eye(3),
        np.column_stack([intrinsics, np.zeros(3)]),
    )
