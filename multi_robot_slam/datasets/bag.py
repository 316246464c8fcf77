"""A recording -> a bag that `multi_robot_slam run` needs nothing else for."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.table import Table

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from msg_defs.topics import Topic
from msg_defs.types import (
    DESCRIPTOR_SIZE,
    LandmarkMap,
    ObservationSet,
    ObservationTruth,
    PoseSample,
    Sightings,
    Trajectory,
)
from multi_robot_slam.bags import BagWriter
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.datasets.dead_reckoning import poses_at, twists_at
from multi_robot_slam.datasets.recording import Noise, Recording, RobotLog
from multi_robot_slam.datasets.views import Views, views
from multi_robot_slam.filter.settings import FilterSettings, RejuvenationSettings
from multi_robot_slam.models.motion import MotionSettings

GATE = 100.0
"""D_0, also for robots seen: 10 sigma.

Identities are read, so the gate need not tell landmarks apart, as the default must. It only has to
stop what was read wrong; and whatever it stops of the rest is a ghost beside the true landmark.
"""

DESCRIPTOR_GATE = 0.5
"""E_0: 0 between equal identities, 2 between different ones."""

ROBUST_ABOVE = 1.0
"""1 sigma, the usual scale of a Cauchy loss: the sensors' noise figures cover the heavy tails of
range errors, so most readings lie well inside it. docs/results.md has the residuals.
"""

REJUVENATION = RejuvenationSettings(ancestors_below=0.25, rest=3, window=300)
"""With few landmarks a posterior is far from Gaussian and weights are uneven; the window, a minute
of five robots at 1 Hz, keeps such a smoothing at some 40 ms.
"""

FINE_HZ = 10.0
"""Rate of odometry and ground truth in the bag; the robots move a few centimetres in between."""

Message = tuple[int, Topic, bytes]
"""Stamp [ns], topic, CDR."""


class Count(NamedTuple):
    """What became of one robot's readings."""

    readings: int
    observations: int
    """Of landmarks, in the bag."""
    sightings: int
    unknown: int
    """Of something that is neither landmark nor another robot: left out."""
    spare: int
    """Further ones of one target in one frame, before the first frame, or not ahead: left out."""


def write(
    recording: Recording,
    folder: Path,
    rate_hz: float,
    on_robot: Callable[[str], None] = lambda robot: None,
) -> dict[str, Count]:
    """Write the bag `folder` with frames at `rate_hz`; what became of each robot's readings.

    `on_robot` is called with each robot's name before its turn.
    """
    if len(recording.landmarks) > DESCRIPTOR_SIZE:
        raise InputError(
            f"{len(recording.landmarks)} landmarks: {DESCRIPTOR_SIZE} identities at most fit"
        )
    stamps = frame_stamps(recording, rate_hz)
    config = configuration(recording, stamps[0])
    text = scenario_file.to_yaml(**{SECTION: config})
    counts = {}
    messages = [
        (int(stamps[0]), topics.GROUND_TRUTH_LANDMARKS, _true_map(recording, stamps[0])),
        (int(stamps[0]), topics.FUSION_CONFIG, wire.encode_text(text)),
    ]
    for name, log in recording.robots.items():
        on_robot(name)
        seen, others = (
            views(readings, stamps, log.commands, recording.noise, recording.mount)
            for readings in (log.landmarks, log.robots)
        )
        messages += _motion(name, log, stamps)
        messages += _frames(name, seen, others, stamps, config.sightings)
        counts[name] = _count(log, seen, others)
    messages.sort(key=lambda message: message[0])
    with BagWriter(folder) as bag:
        for stamp, topic, data in messages:
            bag.write(topic, stamp, data)
    return counts


def frame_stamps(recording: Recording, rate_hz: float) -> np.ndarray:
    """(F,) int64: multiples of the period at which all robots' odometry and truth are known."""
    period = round(1e9 / rate_hz)
    paths = [log.truth.stamps_ns for log in recording.robots.values()]
    driven = [log.commands.stamps_ns for log in recording.robots.values()]
    first = max(stamps[0] for stamps in paths + driven)
    last = min(stamps[-1] for stamps in paths + driven)
    stamps = np.arange(-(-first // period), last // period + 1) * period
    if len(stamps) < 2:
        raise InputError(
            f"{max(last - first, 0) / 1e9:g} s are common to all robots' odometry and ground "
            f"truth: no two frames at {rate_hz:g} Hz; raise --rate, or check the files"
        )
    return stamps


def configuration(recording: Recording, first_ns: int) -> Config:
    """What the filter is told: true poses at the start, the rest from the data sheet."""
    starts = [interpolated(log.truth, np.array([first_ns]))[0] for log in recording.robots.values()]
    return Config(
        robots=tuple(recording.robots),
        start_poses=tuple(tuple(pose.tolist()) for pose in starts),
        mount=recording.mount,
        sightings=any(len(log.robots) for log in recording.robots.values()),
        filter=FilterSettings(
            gate=GATE,
            descriptor_gate=DESCRIPTOR_GATE,
            sighting_gate=GATE,
            robust_above=ROBUST_ABOVE,
            rejuvenation=REJUVENATION,
            motion=motion_settings(recording.noise),
        ),
    )


def motion_settings(noise: Noise) -> MotionSettings:
    """Noise that grows with time alone: commands take effect late, so a robot that is told to stop
    errs no less than one that drives.
    """
    return MotionSettings(
        forward_per_sqrt_m=0.0,
        left_per_sqrt_m=0.0,
        yaw_per_sqrt_m=0.0,
        yaw_per_sqrt_rad=0.0,
        forward_per_sqrt_s=noise.forward_per_sqrt_s,
        left_per_sqrt_s=noise.left_per_sqrt_s,
        yaw_per_sqrt_s=noise.yaw_per_sqrt_s,
        scale_sigma=noise.scale_sigma,
    )


def interpolated(path: Trajectory, stamps_ns: np.ndarray) -> np.ndarray:
    """Poses (T, 3) of `path` at `stamps_ns` (T,), held at its ends."""
    since = path.stamps_ns[0]
    times, known = stamps_ns - since, path.stamps_ns - since
    x, y, yaw = path.poses.T
    return np.column_stack([np.interp(times, known, f) for f in (x, y, np.unwrap(yaw))])


def table(counts: dict[str, Count]) -> Table:
    """What became of each robot's readings."""
    shown = Table(title="readings", title_justify="left")
    for name in ("", *Count._fields):
        shown.add_column(name, justify="right" if name else "left")
    for name, count in counts.items():
        shown.add_row(name, *map(str, count))
    return shown


def _true_map(recording: Recording, stamp_ns: int) -> bytes:
    count = len(recording.landmarks)
    places = np.column_stack([recording.landmarks, np.zeros(count)]).astype(np.float32)
    landmarks = LandmarkMap(
        ids=recording.landmark_ids,
        positions=places,
        covariances=np.zeros((count, 6), np.float32),
        observations=np.zeros(count, np.uint32),
        robots=np.zeros(count, np.uint32),
        descriptors=_descriptors(np.arange(count)),
    )
    return wire.encode_map(landmarks, int(stamp_ns))


def _descriptors(rows: np.ndarray) -> np.ndarray:
    """(n, 128) the unit vector of each landmark row: equal, or at a squared distance of 2."""
    return np.eye(DESCRIPTOR_SIZE, dtype=np.float32)[rows]


def _motion(robot: str, log: RobotLog, frames_ns: np.ndarray) -> Iterator[Message]:
    """Odometry from the first frame to the last, each of them included, and ground truth."""
    odom, base = topics.odom_frame(robot), topics.base_frame(robot)
    fine = np.arange(frames_ns[0], frames_ns[-1], round(1e9 / FINE_HZ))
    stamps = np.union1d(frames_ns, fine)
    poses, twists = poses_at(log.commands, stamps), twists_at(log.commands, stamps)
    for stamp, pose, twist in zip(stamps, poses, twists, strict=True):
        sample = PoseSample(robot, int(stamp), pose, twist)
        yield sample.stamp_ns, topics.odometry(robot), wire.encode_pose(sample, odom, base)
    for stamp, pose in zip(stamps, interpolated(log.truth, stamps), strict=True):
        sample = PoseSample(robot, int(stamp), pose)
        data = wire.encode_pose(sample, topics.MAP_FRAME, base)
        yield sample.stamp_ns, topics.ground_truth(robot), data


def _frames(
    robot: str, seen: Views, others: Views, stamps_ns: np.ndarray, with_sightings: bool
) -> Iterator[Message]:
    """Of each frame the sightings, then the observations and what they truly are."""
    for frame, stamp in enumerate(stamps_ns.tolist()):
        own = slice(*np.searchsorted(seen.frames, (frame, frame + 1)))
        if with_sightings:
            rows = slice(*np.searchsorted(others.frames, (frame, frame + 1)))
            sightings = Sightings(
                robot,
                stamp,
                others.targets[rows].astype(np.uint32),
                others.positions[rows],
                others.covariances[rows],
            )
            yield stamp, topics.sightings(robot), wire.encode_sightings(sightings)
        landmarks = seen.targets[own]
        observations = ObservationSet(
            robot, stamp, seen.positions[own], seen.covariances[own], _descriptors(landmarks)
        )
        yield stamp, topics.observations(robot), wire.encode_observations(observations)
        truth = ObservationTruth(robot, stamp, landmarks.astype(np.uint32))
        yield stamp, topics.observation_truth(robot), wire.encode_observation_truth(truth)


def _count(log: RobotLog, seen: Views, others: Views) -> Count:
    readings = len(log.landmarks) + len(log.robots) + log.unknown
    used = len(seen.frames), len(others.frames)
    return Count(readings, *used, log.unknown, readings - sum(used) - log.unknown)
