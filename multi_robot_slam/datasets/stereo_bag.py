"""A stereo recording -> a bag that `multi_robot_slam run` needs nothing else for.

Such recordings have no wheels: odometry is the true motion with the errors of (7). Either the bag
holds the images as they were recorded, or the landmarks that the front end finds in them, levelled
with the true roll, pitch and height, which stand for an IMU: robots of the filter drive in a plane.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.box import SIMPLE
from rich.table import Table

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from msg_defs.topics import Topic
from msg_defs.types import (
    CameraMount,
    LandmarkMap,
    ObservationSet,
    ObservationTruth,
    PoseSample,
    Trajectory,
)
from multi_robot_slam.bags import BagWriter
from multi_robot_slam.config import FOR_PICTURES, SECTION, Config, shipped
from multi_robot_slam.datasets.identities import Identities
from multi_robot_slam.datasets.levelling import Cloud, in_map, levelled
from multi_robot_slam.datasets.stereo_recording import SpacePath, StereoPairs, StereoRecording
from multi_robot_slam.datasets.wheels import noisy_odometry
from multi_robot_slam.front_end.front_end import FrontEnd
from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.front_end.settings import CameraSettings, FeatureSettings

FORMATS = {".png": "png", ".jpg": "jpeg"}
"""Of the sources' files, as sensor_msgs/CompressedImage names them."""

Message = tuple[int, Topic, bytes]
"""Stamp [ns], topic, CDR."""


@dataclass(frozen=True, eq=False)
class Part:
    """What one robot of the team recorded."""

    robot: str
    recording: StereoRecording
    """Its pairs, with the stamps of the source."""
    shift_ns: int
    """To be added to these stamps, so that all robots start together."""

    def truth(self) -> SpacePath:
        """The camera's true pose at each pair, with the stamps of the source."""
        return self.recording.truth.at(self.recording.stamps_ns)

    def planar(self) -> Trajectory:
        """The same in the plane, with the stamps of the bag."""
        path = self.truth().planar()
        return Trajectory(path.stamps_ns + self.shift_ns, path.poses)


def parts(recording: StereoRecording, robots: int) -> list[Part]:
    """The recording cut into as many times of equal length; a robot each, all start together."""
    stamps = recording.stamps_ns
    since = stamps - stamps[0]
    edges = np.searchsorted(since, np.linspace(0, since[-1] + 1, robots + 1))
    found = []
    for number, (first, last) in enumerate(pairwise(edges.tolist())):
        if last - first < 2:
            raise InputError(
                f"{len(recording)} pairs are too few for {robots} robots; give fewer --robots"
            )
        shift = int(stamps[0] - stamps[first])
        found.append(Part(topics.robot_name(number), recording.of(range(first, last)), shift))
    return found


def spaced(recording: StereoRecording, rate_hz: float) -> StereoRecording:
    """Those pairs that come at least a period of `rate_hz` after the one kept before."""
    kept: list[int] = []
    last = -np.inf
    for row, stamp in enumerate(recording.stamps_ns.tolist()):
        if stamp - last >= 0.999e9 / rate_hz:
            kept.append(row)
            last = stamp
    return recording.of(kept)


def front_end(pairs: StereoPairs, settings: CameraSettings) -> FrontEnd:
    """What finds points in these pairs."""
    left, right = pairs.calibration
    return FrontEnd(StereoRig.of(left, right, not pairs.is_rectified), settings)


class Team(NamedTuple):
    """What the robots saw, and what it truly is."""

    clouds: dict[str, list[Cloud]]
    """Of each robot's pairs, level, in its camera frame."""
    landmarks: dict[str, list[np.ndarray]]
    """(B,) uint32 of each."""
    identities: Identities


def observed(team: list[Part], seen: dict[str, list[Cloud]]) -> Team:
    """Level what each robot has `seen` in its pairs, and find from true poses what is one."""
    identities, height = Identities(), mount(team).up_m
    clouds: dict[str, list[Cloud]] = {part.robot: [] for part in team}
    landmarks: dict[str, list[np.ndarray]] = {part.robot: [] for part in team}
    for part in team:
        truth = part.truth()
        frames = zip(
            seen[part.robot], truth.places, truth.rotations, part.planar().poses, strict=True
        )
        for own, place, rotation, pose in frames:
            points = in_map(own, place, rotation)
            cloud, is_ahead = levelled(points, pose, height)
            clouds[part.robot].append(cloud)
            landmarks[part.robot].append(identities.of(points, place)[is_ahead])
    return Team(clouds, landmarks, identities)


def mount(team: list[Part]) -> CameraMount:
    """Of a level camera above `base_link`, at the mean of all true heights."""
    heights = np.concatenate([part.truth().places[:, 2] for part in team])
    return CameraMount(forward_m=0.0, left_m=0.0, up_m=float(heights.mean().round(3)))


INDOORS_M, ON_ROADS_M = (0.4, 40.0), (3.0, 100.0)
"""How near and how far points are looked for; a car's bonnet is not in its camera's view."""


def camera_settings(
    recording: StereoRecording, scale: float, range_m: tuple[float, float] = INDOORS_M
) -> CameraSettings:
    """How the camera's images are named and searched."""
    return CameraSettings(
        image="image_rect" if recording.is_rectified else "image_raw",
        image_transport="compressed",
        features=FeatureSettings(scale=scale, nearest_m=range_m[0], farthest_m=range_m[1]),
    )


def look(
    team: list[Part], settings: CameraSettings, on_pair: Callable[[], None] = lambda: None
) -> dict[str, list[Cloud]]:
    """What the front end finds in each robot's pairs, in the frame of its rectified left camera.

    `on_pair` is called after each.
    """
    seen: dict[str, list[Cloud]] = {}
    for part in team:
        finder = front_end(part.recording, settings)
        seen[part.robot] = []
        for row in range(len(part.recording)):
            found = finder.observe(*part.recording.images(row))
            cloud = Cloud(found.positions, found.covariances, found.descriptors)
            seen[part.robot].append(cloud)
            on_pair()
    return seen


def configuration(team: list[Part], camera: CameraSettings) -> Config:
    """What the filter is told: where the robots truly start, and the noise of their odometry."""
    return Config(
        robots=tuple(part.robot for part in team),
        start_poses=tuple(tuple(part.planar().poses[0].tolist()) for part in team),
        start_sigma=(0.0, 0.0),
        mount=mount(team),
        camera=camera,
        filter=shipped(FOR_PICTURES).filter,
    )


def odometry(team: list[Part], config: Config, seed: int) -> dict[str, list[PoseSample]]:
    """Of each robot the true motion with errors of the `seed`; one sample a pair."""
    noise, seeds = config.filter.motion, np.random.SeedSequence(seed).spawn(len(team))
    return {
        part.robot: [*noisy_odometry(part.robot, part.planar(), noise, np.random.default_rng(own))]
        for part, own in zip(team, seeds, strict=True)
    }


def frames(team: list[Part], saw: Team) -> Iterator[tuple[ObservationSet, ObservationTruth]]:
    """What each robot saw at each pair, and of what."""
    for part in team:
        stamps = part.planar().stamps_ns.tolist()
        clouds, landmarks = saw.clouds[part.robot], saw.landmarks[part.robot]
        for stamp, cloud, rows in zip(stamps, clouds, landmarks, strict=True):
            yield (
                ObservationSet(part.robot, stamp, *cloud),
                ObservationTruth(part.robot, stamp, rows),
            )


def true_map(identities: Identities) -> LandmarkMap:
    """The landmarks that true poses tell."""
    count = len(identities)
    return LandmarkMap(
        ids=np.arange(count, dtype=np.uint32),
        positions=identities.positions.astype(np.float32),
        covariances=np.zeros((count, 6), np.float32),
        observations=np.zeros(count, np.uint32),
        robots=np.zeros(count, np.uint32),
        descriptors=identities.descriptors,
    )


def write_clouds(folder: Path, team: list[Part], saw: Team, config: Config, seed: int) -> None:
    """Write a bag of landmarks; odometry has errors of the `seed`."""
    messages = [*_common(team, config, seed)]
    for seen, truth in frames(team, saw):
        robot, stamp = seen.robot, seen.stamp_ns
        messages += [
            (stamp, topics.observations(robot), wire.encode_observations(seen)),
            (stamp, topics.observation_truth(robot), wire.encode_observation_truth(truth)),
        ]
    first_ns = int(team[0].recording.stamps_ns[0])
    landmarks = wire.encode_map(true_map(saw.identities), first_ns)
    messages.append((first_ns, topics.GROUND_TRUTH_LANDMARKS, landmarks))
    with BagWriter(folder) as bag:
        for stamp, topic, data in sorted(messages, key=lambda message: message[0]):
            bag.write(topic, stamp, data)


def write_images(
    folder: Path,
    team: list[Part],
    config: Config,
    seed: int,
    on_pair: Callable[[], None] = lambda: None,
) -> None:
    """Write a bag of the images as they are in the source; odometry has errors of the `seed`."""
    messages = sorted(_common(team, config, seed), key=lambda message: message[0])
    pairs = sorted(
        (stamp + part.shift_ns, number, row)
        for number, part in enumerate(team)
        for row, stamp in enumerate(part.recording.stamps_ns.tolist())
    )
    with BagWriter(folder) as bag:
        sent = 0
        for stamp, number, row in pairs:
            while sent < len(messages) and messages[sent][0] <= stamp:
                at, topic, data = messages[sent]
                bag.write(topic, at, data)
                sent += 1
            for topic, data in _image_messages(team[number], row, stamp, config.camera):
                bag.write(topic, stamp, data)
            on_pair()


def _common(team: list[Part], config: Config, seed: int) -> Iterator[Message]:
    """The configuration, odometry and truth."""
    first_ns = int(team[0].recording.stamps_ns[0])
    text = scenario_file.to_yaml(**{SECTION: config})
    yield first_ns, topics.FUSION_CONFIG, wire.encode_text(text)
    for robot, samples in odometry(team, config, seed).items():
        odom, base = topics.odom_frame(robot), topics.base_frame(robot)
        for sample in samples:
            data = wire.encode_pose(sample, odom, base)
            yield sample.stamp_ns, topics.odometry(robot), data
    for part in team:
        base, truth = topics.base_frame(part.robot), part.planar()
        for stamp, pose in zip(truth.stamps_ns.tolist(), truth.poses, strict=True):
            true = PoseSample(part.robot, stamp, pose)
            data = wire.encode_pose(true, topics.MAP_FRAME, base)
            yield stamp, topics.ground_truth(part.robot), data


def _image_messages(
    part: Part, row: int, stamp_ns: int, camera: CameraSettings
) -> Iterator[tuple[Topic, bytes]]:
    """Both images of a pair as they are in their files, and their calibration."""
    recording = part.recording
    frame = topics.camera_frame(part.robot)
    for side, path, info in zip(
        ("left", "right"),
        (recording.left[row], recording.right[row]),
        recording.calibration,
        strict=True,
    ):
        packed = wire.encode_packed(path.read_bytes(), FORMATS[path.suffix], stamp_ns, frame)
        yield topics.compressed_image(part.robot, side, camera.image), packed
        told = wire.encode_camera_info(replace(info, stamp_ns=stamp_ns, frame=frame))
        yield topics.camera_info(part.robot, side), told


def table(team: list[Part], saw: Team | None) -> Table:
    """What became of each robot's pairs; `saw` where the bag holds landmarks."""
    shown = Table(title="pairs", box=SIMPLE, padding=(0, 1, 0, 0))
    shown.title_justify = "left"
    heads = ["robot", "pairs", "seconds", "path [m]"]
    heads += ["observations", "of landmarks seen before"] if saw else []
    for number, head in enumerate(heads):
        shown.add_column(head, justify="right" if number else "left", no_wrap=True)
    known: set[int] = set()
    for part in team:
        path = part.planar()
        steps = np.diff(path.poses[:, :2], axis=0)
        row = [
            part.robot,
            str(len(path.stamps_ns)),
            f"{(path.stamps_ns[-1] - path.stamps_ns[0]) / 1e9:.0f}",
            f"{np.hypot(*steps.T).sum():.1f}",
        ]
        if saw:
            found = saw.landmarks[part.robot]
            again = 0
            for rows in found:
                again += sum(int(landmark) in known for landmark in rows)
                known.update(rows.tolist())
            row += [str(sum(map(len, found))), str(again)]
        shown.add_row(*row)
    return shown
