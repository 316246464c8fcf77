"""A recording -> a bag that `multi_robot_slam run` needs nothing else for."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.box import SIMPLE
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
from multi_robot_slam.config import EVERY_FRAME, SECTION, Config
from multi_robot_slam.datasets.dead_reckoning import poses_at, twists_at
from multi_robot_slam.datasets.recording import Noise, Recording, RobotLog
from multi_robot_slam.datasets.views import Views, views
from multi_robot_slam.filter.settings import FilterSettings, RejuvenationSettings
from multi_robot_slam.models.motion import MotionSettings
from multi_robot_slam.runs.trajectory_errors import at, covers, sampled
from multi_robot_slam.smoothing import joining

REJUVENATION = RejuvenationSettings(unknowns=900)
"""Cheaper than the default: with few landmarks weights are uneven, so the ancestors often run out.

The window is some 300 poses then, a minute of five robots at 1 Hz.
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
    """Further ones of one target in one frame, outside the frames, or not ahead: left out."""
    frames: int
    without_truth: int
    """Frames at which nobody knows where the robot truly is: they are estimated, and not judged."""


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
    with_sightings = any(len(log.robots) for log in recording.robots.values())
    messages: list[Message] = []
    counts = {}
    for name in recording.robots:
        on_robot(name)
        own, counts[name] = _converted(name, recording, stamps[name], with_sightings)
        messages += own
    first_ns = int(min(own[0] for own in stamps.values()))
    observations = sum(count.observations for count in counts.values())
    config = configuration(recording, first_ns, observations, with_sightings)
    text = scenario_file.to_yaml(**{SECTION: config})
    told = [
        (first_ns, topics.GROUND_TRUTH_LANDMARKS, _true_map(recording, first_ns)),
        (first_ns, topics.FUSION_CONFIG, wire.encode_text(text)),
    ]
    with BagWriter(folder) as bag:
        for stamp, topic, data in sorted([*told, *messages], key=lambda message: message[0]):
            bag.write(topic, stamp, data)
    return counts


def _converted(
    name: str, recording: Recording, frames_ns: np.ndarray, with_sightings: bool
) -> tuple[list[Message], Count]:
    """All messages of one robot, and what became of its readings."""
    log = recording.robots[name]
    seen, others = (
        views(readings, frames_ns, log.commands, recording.noise, recording.mount)
        for readings in (log.landmarks, log.robots)
    )
    fine = _fine_stamps(frames_ns)
    truth = sampled(log.truth, fine)
    messages = [
        *_odometry(name, log, fine),
        *_truth(name, truth),
        *_frames(name, seen, others, frames_ns, with_sightings),
    ]
    judged = int(covers(truth, frames_ns).sum())
    return messages, _count(log, seen, others, len(frames_ns), judged)


def frame_stamps(recording: Recording, rate_hz: float) -> dict[str, np.ndarray]:
    """(F,) int64 for each robot: multiples of the period.

    From when all robots' odometry has begun and it is known where all of them are, as the filter
    must start somewhere, to the end of the robot's own odometry. Truth that pauses or ends earlier
    ends nothing.
    """
    period = round(1e9 / rate_hz)
    logs = recording.robots.values()
    ends = [log.commands.stamps_ns[-1] // period for log in logs]
    begun = max(log.commands.stamps_ns[0] for log in logs)
    instants = np.arange(-(-begun // period), max(ends) + 1) * period
    known = [covers(log.truth, instants) for log in logs]
    starts = instants[np.logical_and.reduce(known)]
    if not len(starts) or starts[0] >= min(ends) * period:
        raise InputError(
            f"no two frames at {rate_hz:g} Hz are common to all robots: from an instant at which "
            "all odometry has begun and all ground truth is known, to the end of the shortest "
            "odometry; raise --rate, or check the files"
        )
    first = starts[0] // period
    return {
        name: np.arange(first, end + 1) * period
        for name, end in zip(recording.robots, ends, strict=True)
    }


def configuration(
    recording: Recording, first_ns: int, observations: int, with_sightings: bool
) -> Config:
    """What the filter is told: true poses at the start, noise and mount from the data sheet.

    The origin of the odometry is where the first command was given: before the start.

    Every frame is a step: commands stand in for odometry, and do not tell whether a robot moved.
    But for `REJUVENATION` and the gate the other settings are the defaults. No truth goes into
    the gate; that it is taken instead of the default was decided after both had been compared with
    the truth of two recordings (docs/results.md). It is the default widened
    (`joining.widened_gate`): with 99 % probability not one of all `observations` is refused, where
    the default refuses one right match in a hundred. The default must tell landmarks apart that
    look alike; here the identities are read, so a wide gate admits nothing but the right landmark,
    while each right match refused makes a duplicate beside it.
    """
    starts = [at(log.truth, np.array([first_ns]))[0] for log in recording.robots.values()]
    return Config(
        robots=tuple(recording.robots),
        start_poses=tuple((float(x), float(y), float(yaw)) for x, y, yaw in starts),
        start_sigma=(0.0, 0.0),
        start_at="first message",
        mount=recording.mount,
        sightings=with_sightings,
        keyframe=EVERY_FRAME,
        filter=FilterSettings(
            gate=joining.widened_gate(FilterSettings().gate, observations),
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


def table(counts: dict[str, Count]) -> Table:
    """What became of each robot's readings, and how many of its frames have no truth."""
    untold = sum(count.without_truth for count in counts.values())
    note = "Frames without truth are estimated like all others, and not judged." if untold else None
    shown = Table(title="readings", caption=note, box=SIMPLE, padding=(0, 1, 0, 0))
    shown.title_justify = shown.caption_justify = "left"
    for name in ("", *Count._fields):
        head = "no truth" if name == "without_truth" else name
        shown.add_column(head, justify="right" if name else "left", no_wrap=True)
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
    return wire.encode_map(landmarks, stamp_ns)


def _descriptors(rows: np.ndarray) -> np.ndarray:
    """(n, 128) the unit vector of each landmark row: equal, or at a squared distance of 2."""
    return np.eye(DESCRIPTOR_SIZE, dtype=np.float32)[rows]


def _fine_stamps(frames_ns: np.ndarray) -> np.ndarray:
    """From the first frame to the last, each of them included."""
    return np.union1d(frames_ns, np.arange(frames_ns[0], frames_ns[-1], round(1e9 / FINE_HZ)))


def _odometry(robot: str, log: RobotLog, stamps_ns: np.ndarray) -> Iterator[Message]:
    odom, base = topics.odom_frame(robot), topics.base_frame(robot)
    poses, twists = poses_at(log.commands, stamps_ns), twists_at(log.commands, stamps_ns)
    for stamp, pose, twist in zip(stamps_ns, poses, twists, strict=True):
        sample = PoseSample(robot, int(stamp), pose, twist)
        yield sample.stamp_ns, topics.odometry(robot), wire.encode_pose(sample, odom, base)


def _truth(robot: str, truth: Trajectory) -> Iterator[Message]:
    base = topics.base_frame(robot)
    for stamp, pose in zip(truth.stamps_ns, truth.poses, strict=True):
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


def _count(log: RobotLog, seen: Views, others: Views, frames: int, judged: int) -> Count:
    readings = len(log.landmarks) + len(log.robots) + log.unknown
    used = len(seen.frames) + len(others.frames)
    return Count(
        readings=readings,
        observations=len(seen.frames),
        sightings=len(others.frames),
        unknown=log.unknown,
        spare=readings - used - log.unknown,
        frames=frames,
        without_truth=frames - judged,
    )
