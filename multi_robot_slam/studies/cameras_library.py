"""The walk round the library: how far its end is from its beginning, before and with the filter.

There is no truth but the closure, and no odometry: the front end's motions from pair to pair are
the odometry, put into the plane. How exact they are, they tell themselves: two motions in a row
must be the motion over both. A hand carries the camera, so its tilt and height are not known, and
clouds say so.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from msg_defs.topics import robot_name
from msg_defs.types import CameraMount, Event, ObservationSet, PoseSample, Trajectory
from multi_robot_slam import runs
from multi_robot_slam.config import FOR_PICTURES, Config, shipped
from multi_robot_slam.datasets import stereo_bag
from multi_robot_slam.datasets.levelling import levelling_noise
from multi_robot_slam.datasets.stereo_recording import StereoPairs
from multi_robot_slam.front_end.front_end import Seen
from multi_robot_slam.front_end.settings import CameraSettings
from multi_robot_slam.models.motion import MotionSettings, increment, move, wrap
from multi_robot_slam.models.symmetric import pack, unpack
from multi_robot_slam.runs.trajectory_errors import at
from multi_robot_slam.studies import camera_runs, library
from multi_robot_slam.studies.camera_runs import Session
from multi_robot_slam.studies.front_end import (
    Motion,
    View,
    estimated_motion,
    rig_of,
)

TILT_SIGMA_RAD = 0.05
"""Of a camera that is carried by hand: three degrees."""
HEIGHT_SIGMA_M = 0.15
"""Its height changes by less than 0.4 m."""

MANY = 500
"""Points of a pair that a motion is found from."""

ROBOT = robot_name(0)


class Closure(NamedTuple):
    """Where the frame that closes the loop is seen, less where it is."""

    place_m: float
    heading_rad: float


@dataclass(frozen=True, eq=False)
class Walk:
    """What the front end found in all pairs."""

    stamps_ns: np.ndarray
    """(T,) int64."""
    views: Sequence[View]
    motions: np.ndarray
    """(T - 1, 3) from pair to pair in the plane; where too little agrees, the one before."""
    lost: int
    """Motions that were not found."""
    noise: MotionSettings
    truth: np.ndarray
    """(3,) motion from the first frame of the loop to the one that closes it, from both images."""


def walk(pairs: StereoPairs, settings: CameraSettings) -> Walk:
    """Look at all pairs: for the map with the `settings`, for motions at `MANY` points."""
    views = looked(pairs, settings)
    features = replace(settings.features, observations=MANY)
    many = looked(pairs, replace(settings, features=features))
    rig = rig_of(pairs)
    found = [planar(estimated_motion(a, b, rig)) for a, b in pairwise(many)]
    over_two = [planar(estimated_motion(a, b, rig)) for a, b in zip(many, many[2:], strict=False)]
    motions = np.zeros((len(found), 3))
    for row, motion in enumerate(found):
        motions[row] = motions[row - 1] if motion is None else motion
    first, last = (library.row_of(pairs, number) for number in (library.FIRST, library.CLOSING))
    truth = planar(estimated_motion(many[first], many[last], rig))
    if truth is None:
        raise ValueError("the frames that close the loop do not match")
    lost = sum(motion is None for motion in found)
    return Walk(pairs.stamps_ns, views, motions, lost, noise_of(found, over_two), truth)


def looked(pairs: StereoPairs, settings: CameraSettings) -> list[View]:
    """Each pair through the front end; nobody knows where it was taken."""
    front_end = stereo_bag.front_end(pairs, settings)
    return [
        View(stamp * 1e-9, front_end.observe(*pairs.images(row)), np.zeros(3), np.eye(3))
        for row, stamp in enumerate(pairs.stamps_ns.tolist())
    ]


def planar(motion: Motion | None) -> np.ndarray | None:
    """(3,): the second camera's x, y [m] and yaw [rad] as a level robot at the first one has it."""
    if motion is None:
        return None
    place = -motion.rotation.T @ motion.shift
    ahead = motion.rotation.T[:, 2]
    return np.array([place[2], -place[0], np.arctan2(-ahead[0], ahead[2])])


def noise_of(
    found: Sequence[np.ndarray | None], over_two: Sequence[np.ndarray | None]
) -> MotionSettings:
    """Standard deviations per root of a second, by how motions in a row miss those over two.

    Of three motions with equal errors the difference has three times the variance of each. What is
    lost is guessed to be as before, and guesses are as wrong as motions in a row differ; the filter
    knows one noise for all, which is the mean of both variances by their shares.
    """
    known = [(a, b) for a, b in pairwise(found) if a is not None and b is not None]
    misses = [
        increment(both, _composed(a, b))
        for (a, b), both in zip(pairwise(found), over_two, strict=True)
        if a is not None and b is not None and both is not None
    ]
    lost = 1 - sum(motion is not None for motion in found) / len(found)
    of_found = np.mean(np.square(misses), axis=0) / 3
    of_guessed = np.mean(np.square([increment(a, b) for a, b in known]), axis=0)
    variances = (1 - lost) * of_found + lost * of_guessed
    forward, left, yaw = np.sqrt(variances / (library.PERIOD_NS / 1e9)).tolist()
    return MotionSettings(0.0, 0.0, 0.0, 0.0, forward, left, yaw)


def _composed(pose: np.ndarray, motion: np.ndarray) -> np.ndarray:
    moved = pose[:, None].copy()
    move(moved, motion[:, None])
    return moved[:, 0]


def odometry(walked: Walk) -> Trajectory:
    """The motions, one after the other."""
    poses = [np.zeros(3)]
    for motion in walked.motions:
        poses.append(_composed(poses[-1], motion))
    return Trajectory(walked.stamps_ns, np.array(poses))


def session(walked: Walk, seed: int, particles: int) -> Session:
    """What the filter is told."""
    path = odometry(walked)
    config = Config(
        robots=(ROBOT,),
        start_poses=((0.0, 0.0, 0.0),),
        mount=CameraMount(forward_m=0.0, left_m=0.0, up_m=0.0),
        filter=replace(shipped(FOR_PICTURES).filter, motion=walked.noise),
    )
    events: list[Event] = []
    for stamp, pose, view in zip(path.stamps_ns.tolist(), path.poses, walked.views, strict=True):
        events.append(PoseSample(ROBOT, stamp, pose))
        events.append(_cloud(stamp, view.seen))
    recorded = runs.Recorded(odometry={ROBOT: path})
    return Session(camera_runs.seeded(config, seed, particles), events, recorded)


def _cloud(stamp_ns: int, seen: Seen) -> ObservationSet:
    tilted = levelling_noise(seen.positions.astype(float), TILT_SIGMA_RAD, HEIGHT_SIGMA_M)
    covariances = pack(unpack(seen.covariances) + tilted).astype(np.float32)
    return ObservationSet(ROBOT, stamp_ns, seen.positions, covariances, seen.descriptors)


def closure(path: Trajectory, walked: Walk, pairs: StereoPairs) -> Closure:
    """How far the path misses the closure."""
    rows = [library.row_of(pairs, number) for number in (library.FIRST, library.CLOSING)]
    first, last = at(path, walked.stamps_ns[rows])
    error = increment(first, last) - walked.truth
    heading = np.abs(wrap(error[2:]))
    return Closure(float(np.hypot(*error[:2])), float(heading[0]))


@dataclass(frozen=True)
class Row:
    """How far one run misses the closure."""

    seed: int
    particles: int
    steps: int
    live: Closure
    after: Closure


def run(walked: Walk, pairs: StereoPairs, seed: int, particles: int) -> Row:
    """One run of the filter."""
    found = camera_runs.estimate(session(walked, seed, particles), with_batch=False)
    robot = found.robots[ROBOT]
    live, after = (closure(path, walked, pairs) for path in (robot.online, robot.mean))
    return Row(seed, particles, len(found.steps), live, after)


def markdown(walked: Walk, pairs: StereoPairs, rows: Sequence[Row]) -> str:
    """The closure by odometry, and by each run."""
    before = closure(odometry(walked), walked, pairs)
    way = float(np.hypot(*walked.motions[:, :2].T).sum())
    lines = [
        f"{len(pairs)} pairs, {way:.1f} m, {walked.lost} motions not found. The closing frame "
        f"is {np.hypot(*walked.truth[:2]):.3f} m from the first.",
        "",
        "| | seed | steps | place [m] | heading [degrees] |",
        "|---|---:|---:|---:|---:|",
        _line("odometry, frame to frame", "", "", before),
    ]
    for row in rows:
        lines.append(_line("as published", row.seed, row.steps, row.live))
        lines.append(_line("after the run", row.seed, row.steps, row.after))
    return "\n".join(lines) + "\n"


def _line(name: str, seed: object, steps: object, missed: Closure) -> str:
    heading = np.degrees(missed.heading_rad)
    return f"| {name} | {seed} | {steps} | {missed.place_m:.3f} | {heading:.2f} |"
