"""Stereo pictures of a textured wall, made in a moment, and bags of robots that see them."""

import numpy as np
from scipy.ndimage import gaussian_filter

from msg_defs import scenario_file, topics, wire
from msg_defs.types import CameraInfo, Image, PoseSample
from multi_robot_slam.bags import BagWriter
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.front_end.settings import DESCRIPTOR_GATE, CameraSettings, FeatureSettings

WIDTH_PX, HEIGHT_PX, FOCAL_PX, BASELINE_M = 240, 160, 200.0, 0.12
WALL_M = 2.0
"""How far ahead of the camera the wall is; the robots drive along it."""
PX_PER_M = FOCAL_PX / WALL_M
DISPARITY_PX = FOCAL_PX * BASELINE_M / WALL_M
START_NS = 10**9
SETTINGS = CameraSettings(features=FeatureSettings(features=150, observations=40))


def wall(seed=0, width=1600):
    """(H, width) uint8 of random texture at several scales."""
    rng = np.random.default_rng(seed)
    layers = [s * gaussian_filter(rng.normal(size=(HEIGHT_PX, width)), s) for s in (1.5, 3, 6)]
    total = sum(layers)
    return np.clip(128 + 45 * (total - total.mean()) / total.std(), 0, 255).astype(np.uint8)


def pair(texture, along_m):
    """What the left and the right camera see of it `along_m` from its left end."""
    left = round(along_m * PX_PER_M)
    right = left + round(DISPARITY_PX)
    return texture[:, left : left + WIDTH_PX], texture[:, right : right + WIDTH_PX]


def info(side, stamp_ns=START_NS, robot="robot_1", baseline_m=BASELINE_M, focal_px=FOCAL_PX):
    projection = np.array(
        [
            [focal_px, 0, WIDTH_PX / 2, -focal_px * baseline_m * (side == "right")],
            [0, focal_px, HEIGHT_PX / 2, 0],
            [0, 0, 1, 0],
        ]
    )
    frame = topics.camera_frame(robot)
    size = WIDTH_PX, HEIGHT_PX
    lens = "plumb_bob", np.zeros(5), projection[:, :3], np.eye(3), projection
    return CameraInfo(stamp_ns, frame, *size, *lens)


def image(pixels, stamp_ns, robot="robot_1", encoding="mono8"):
    frame = topics.camera_frame(robot)
    return Image(stamp_ns, frame, encoding, np.ascontiguousarray(pixels))


def team(count=1, **changes):
    """The configuration of `count` robots that start side by side, facing the wall's direction."""
    names = tuple(f"robot_{n + 1}" for n in range(count))
    starts = tuple((0.0, 1.0 * n, 0.0) for n in range(count))
    few = FilterSettings(particles=20, descriptor_gate=DESCRIPTOR_GATE)
    return Config(robots=names, start_poses=starts, **{"camera": SETTINGS, "filter": few} | changes)


def drive(robot="robot_1", steps=12, step_m=0.1, seed=0, compressed=False, period_ns=10**8):
    """What a robot sends that drives to its right along the wall: (stamp, topic, bytes).

    The camera looks at the wall, so the robot's y falls; odometry comes right after the pictures.
    """
    texture = wall(seed)
    for step in range(steps):
        stamp_ns = START_NS + step * period_ns
        for side, pixels in zip(("left", "right"), pair(texture, step * step_m), strict=True):
            calibration = wire.encode_camera_info(info(side, stamp_ns, robot))
            yield stamp_ns, topics.camera_info(robot, side), calibration
            shown = image(pixels, stamp_ns, robot)
            if compressed:
                topic = topics.compressed_image(robot, side)
                yield stamp_ns, topic, wire.encode_compressed(shown, "png")
            else:
                yield stamp_ns, topics.image(robot, side), wire.encode_image(shown)
        yield stamp_ns, topics.odometry(robot), odometry(robot, stamp_ns, step * step_m)


def odometry(robot, stamp_ns, along_m):
    sample = PoseSample(robot, stamp_ns, np.array([0.0, -along_m, 0.0]))
    return wire.encode_pose(sample, topics.odom_frame(robot), topics.base_frame(robot))


def record(folder, config=None, messages=None, with_config=True, namespace=""):
    """Write a bag of `messages`, by default `drive` of all robots of `config`; `config`."""
    config = config or team()
    if messages is None:
        drives = (drive(robot, seed=n) for n, robot in enumerate(config.robots))
        messages = sorted((m for one in drives for m in one), key=lambda m: m[0])
    with BagWriter(folder) as bag:
        if with_config:
            text = scenario_file.to_yaml(**{SECTION: config})
            put(bag, namespace, START_NS, topics.FUSION_CONFIG, wire.encode_text(text))
        for stamp_ns, topic, data in messages:
            put(bag, namespace, stamp_ns, topic, data)
    return config


def put(bag, namespace, stamp_ns, topic, data):
    bag.write(topic._replace(name=f"{namespace}/{topic.name}"), stamp_ns, data)
