"""What a simulation says, as (topic, CDR): the world once, and each robot's share of an instant."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import numpy as np

from msg_defs import scenario_file, topics, wire
from msg_defs.topics import Topic
from msg_defs.types import CameraInfo, Image, StereoCamera
from sim_world.rendering.settings import ImageSettings
from sim_world.robot import START_NS, RobotStep
from sim_world.scenario import SECTION
from sim_world.simulator import Simulation
from sim_world.stereo import optical_in_base

if TYPE_CHECKING:
    from sim_world.rendering.renderer import Renderer

Message = tuple[Topic, bytes]

Transport = Literal["raw", "png", "jpeg"]
"""How messages hold pictures."""

SIDES = ("left", "right")


def of_world(simulation: Simulation) -> list[Message]:
    """Walls and configuration, and the true landmarks where robots report landmarks."""
    config = scenario_file.to_yaml(**{SECTION: simulation.scenario})
    landmarks = (topics.GROUND_TRUTH_LANDMARKS, wire.encode_map(simulation.landmarks, START_NS))
    return [
        *([] if simulation.scenario.images.enabled else [landmarks]),
        (topics.GROUND_TRUTH_WALLS, wire.encode_walls(simulation.walls, START_NS)),
        (topics.WORLD_CONFIG, wire.encode_text(f"# seed: {simulation.seed}\n{config}")),
    ]


def odometry_transform(step: RobotStep) -> Message:
    """Where the robot's `base_link` is in its `odom` frame, by its odometry."""
    name, sample = step.odometry.robot, step.odometry
    frames = topics.odom_frame(name), topics.base_frame(name)
    return topics.TF, wire.encode_transform(sample.stamp_ns, *frames, sample.pose)


def camera_transforms(simulation: Simulation) -> Message:
    """Where the cameras sit on all robots."""
    place = optical_in_base(simulation.scenario.camera.mount)
    transforms = [
        wire.Transform(topics.base_frame(name), topics.camera_frame(name), place)
        for name in simulation.start_poses
    ]
    return topics.TF_STATIC, wire.encode_transforms(START_NS, transforms)


def teller(simulation: Simulation, automatic: Transport) -> Callable[[RobotStep], list[Message]]:
    """What makes the messages of a step: landmarks or, where they are enabled, pictures.

    `automatic` is how messages hold pictures where the scenario does not say.
    """
    renderer = simulation.renderer
    if renderer is None:
        return of_step
    chosen = transport(simulation.scenario.images, automatic)
    return lambda step: with_pictures(step, renderer, chosen)


def transport(images: ImageSettings, automatic: Transport) -> Transport:
    """How messages hold pictures: as the settings say or, where they do not, `automatic`."""
    return automatic if images.transport == "auto" else images.transport


def picture_topics(robot: str, transport: Transport) -> list[Topic]:
    """The topics of a robot's calibrations and pictures."""
    kind = topics.image if transport == "raw" else topics.compressed_image
    return [of(robot, side) for of in (topics.camera_info, kind) for side in SIDES]


def of_step(step: RobotStep) -> list[Message]:
    """What the robot reports, then the truth about it."""
    said, truth = reported(step), [_ground_truth(step)]
    if step.observation_truth is not None:
        topic = topics.observation_truth(step.odometry.robot)
        truth.append((topic, wire.encode_observation_truth(step.observation_truth)))
    return said + truth


def reported(step: RobotStep) -> list[Message]:
    """What the robot reports: odometry and, with a frame, landmarks."""
    said = [_odometry(step)]
    if step.observations is not None:
        topic = topics.observations(step.odometry.robot)
        said.append((topic, wire.encode_observations(step.observations)))
    return said


def with_pictures(step: RobotStep, renderer: "Renderer", transport: Transport) -> list[Message]:
    """The same with pictures and their calibration instead of landmarks."""
    if step.observations is None:
        return of_step(step)
    name, stamp_ns = step.odometry.robot, step.odometry.stamp_ns
    scenario, frame = renderer.scenario, topics.camera_frame(name)
    infos = camera_infos(name, stamp_ns, scenario.camera)
    pictures = [Image(stamp_ns, frame, "mono8", eye) for eye in renderer.pair(step.truth)]
    encoded = [
        *(wire.encode_camera_info(info) for info in infos),
        *(_encoded(picture, transport, scenario.images.jpeg_quality) for picture in pictures),
    ]
    return [
        _odometry(step),
        *zip(picture_topics(name, transport), encoded, strict=True),
        _ground_truth(step),
    ]


def camera_infos(robot: str, stamp_ns: int, camera: StereoCamera) -> tuple[CameraInfo, CameraInfo]:
    """Calibration of the left and the right camera, both in the left one's frame."""
    (cx, cy), f = camera.centre_px, camera.focal_px
    intrinsics = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]], float)

    def info(offset: float) -> CameraInfo:
        return CameraInfo(
            stamp_ns,
            topics.camera_frame(robot),
            camera.width_px,
            camera.height_px,
            distortion_model="plumb_bob",
            distortion=np.zeros(5),
            intrinsics=intrinsics,
            rotation=np.eye(3),
            projection=np.column_stack([intrinsics, [offset, 0, 0]]),
        )

    return info(0.0), info(-f * camera.baseline_m)


def _odometry(step: RobotStep) -> Message:
    name = step.odometry.robot
    odom, base = topics.odom_frame(name), topics.base_frame(name)
    return topics.odometry(name), wire.encode_pose(step.odometry, odom, base)


def _ground_truth(step: RobotStep) -> Message:
    name = step.odometry.robot
    base = topics.base_frame(name)
    return topics.ground_truth(name), wire.encode_pose(step.truth, topics.MAP_FRAME, base)


def _encoded(image: Image, transport: Transport, quality: int) -> bytes:
    if transport == "raw":
        return wire.encode_image(image)
    return wire.encode_compressed(image, transport, quality)
