"""One robot: it drives its true path, and reports noisy odometry and noisy observations."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np

from msg_defs.types import ObservationSet, ObservationTruth, PoseSample
from sim_world import stereo
from sim_world.planar import between, compose
from sim_world.scenario import OdometryNoise, Scenario
from sim_world.world import World

START_NS = 1_000_000_000
"""Stamp of the first step."""
MIN_DEPTH_M = 0.1
"""An observation measured nearer than this is discarded."""


@dataclass(frozen=True, eq=False)
class RobotStep:
    """All that one robot reports at one instant, and the truth about it."""

    odometry: PoseSample
    observations: ObservationSet | None
    """None between two frames."""
    truth: PoseSample
    observation_truth: ObservationTruth | None

    @property
    def events(self) -> list[PoseSample | ObservationSet]:
        """What of it is reported, in this order."""
        return [self.odometry] if self.observations is None else [self.odometry, self.observations]


class Path(Protocol):
    """Poses (3,) in their order; an array (T, 3) is one."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[np.ndarray]: ...


def stamps_ns(count: int, period_s: float) -> range:
    """The stamps of so many steps."""
    period_ns = round(period_s * 1e9)
    return range(START_NS, START_NS + count * period_ns, period_ns)


def steps(
    name: str, path: Path, world: World, scenario: Scenario, seed: np.random.SeedSequence
) -> Iterator[RobotStep]:
    """Drive along `path`; the first step is the start, before any movement.

    Odometry and camera have random streams of their own: observing more or less leaves the
    odometry as it is.

    Odometry is reported at each pose, a frame at every `scenario.odometry_per_frame`-th.
    """
    wheels, camera = (np.random.default_rng(s) for s in seed.spawn(2))
    stamps = stamps_ns(len(path), scenario.odometry_period_s)
    odometry = odometry_samples(name, path, stamps, scenario, wheels)
    truth = true_samples(name, path, stamps, scenario.odometry_period_s)
    for i, (moved, true) in enumerate(zip(odometry, truth, strict=True)):
        is_frame = i % scenario.odometry_per_frame == 0
        seen, landmarks = observe(true, world, scenario, camera) if is_frame else (None, None)
        yield RobotStep(moved, seen, true, landmarks)


def movement_variances(movement: np.ndarray, noise: OdometryNoise) -> np.ndarray:
    """(3,) variances of dx, dy [m^2] and dyaw [rad^2] that odometry adds to a movement."""
    distance_m, turn_rad = np.hypot(movement[0], movement[1]), abs(movement[2])
    return np.array(
        [
            noise.forward_per_sqrt_m**2 * distance_m,
            noise.left_per_sqrt_m**2 * distance_m,
            noise.yaw_per_sqrt_m**2 * distance_m + noise.yaw_per_sqrt_rad**2 * turn_rad,
        ]
    )


def propagate(
    covariance: np.ndarray, pose: np.ndarray, movement: np.ndarray, variances: np.ndarray
) -> np.ndarray:
    """(3, 3) covariance, to first order, of `pose` composed with a movement with `variances`."""
    dx, dy, _ = movement
    c, s = np.cos(pose[2]), np.sin(pose[2])
    by_pose = np.array([[1, 0, -s * dx - c * dy], [0, 1, c * dx - s * dy], [0, 0, 1]])
    by_movement = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return by_pose @ covariance @ by_pose.T + by_movement * variances @ by_movement.T


def odometry_samples(
    name: str, path: Path, stamps: Sequence[int], scenario: Scenario, rng: np.random.Generator
) -> Iterator[PoseSample]:
    """Integrate noisy movements in the robot's `odom` frame, from the origin on.

    The covariance is the robot's own: it knows the noise model, but only measured movements.
    """
    pose, covariance = np.zeros(3), np.zeros((3, 3))
    yield PoseSample(name, stamps[0], pose)
    for (before, after), stamp in zip(pairwise(path), stamps[1:], strict=True):
        true = between(before, after)
        sigma = np.sqrt(movement_variances(true, scenario.odometry))
        measured = true + sigma * rng.standard_normal(3)
        variances = movement_variances(measured, scenario.odometry)
        covariance = propagate(covariance, pose, measured, variances)
        pose = compose(pose, measured)
        twist = measured[[0, 2]] / scenario.odometry_period_s
        yield PoseSample(name, stamp, pose, twist, covariance)


def true_samples(
    name: str, path: Path, stamps: Sequence[int], period_s: float
) -> Iterator[PoseSample]:
    """The true poses in `map`, with the velocity of the movement that led to each."""
    yield PoseSample(name, stamps[0], next(iter(path)))
    for (before, after), stamp in zip(pairwise(path), stamps[1:], strict=True):
        yield PoseSample(name, stamp, after, between(before, after)[[0, 2]] / period_s)


def observe(
    true: PoseSample, world: World, scenario: Scenario, rng: np.random.Generator
) -> tuple[ObservationSet, ObservationTruth]:
    """What the stereo camera measures at the true pose.

    Of more than B visible landmarks the B of strongest contrast are measured, as a detector would
    keep them; landmarks are numbered by falling contrast, which is random in space. The noise
    is N(0, R) with R (15) at the true pixels; the published R is (15) at the measured point, as
    the robot knows no other. A descriptor gets noise in each element and is not normalised again.
    """
    camera, landmarks = scenario.camera, world.landmarks
    rows = world.visible(true.pose, camera, scenario.d_max_m)[: scenario.observations]
    points = stereo.camera_from_map(
        landmarks.positions[rows].astype(float), true.pose, camera.mount
    )
    sigma = np.sqrt(stereo.variances(stereo.project(points, camera), camera))
    measured = (points + sigma * rng.standard_normal(points.shape)).astype(np.float32)
    looks = landmarks.descriptors[rows]
    looks = looks + scenario.descriptor_noise * rng.standard_normal(looks.shape, np.float32)
    valid = measured[:, 2] > MIN_DEPTH_M
    observations = ObservationSet(
        true.robot,
        true.stamp_ns,
        measured[valid],
        _published_covariances(measured[valid], scenario),
        looks[valid].astype(np.float32),
    )
    return observations, ObservationTruth(true.robot, true.stamp_ns, rows[valid].astype(np.uint32))


def _published_covariances(measured: np.ndarray, scenario: Scenario) -> np.ndarray:
    camera = scenario.camera
    covariances = np.zeros((len(measured), 6), np.float32)
    covariances[:, [0, 3, 5]] = stereo.variances(
        stereo.project(measured.astype(float), camera), camera
    )
    return covariances
