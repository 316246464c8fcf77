"""Rendered cameras in the simulated building, beside landmarks simulated with the same noise."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from msg_defs import scenario_file
from msg_defs.types import CameraMount, Event, ObservationSet, StereoCamera
from multi_robot_slam import runs
from multi_robot_slam.config import FOR_PICTURES, Config, shipped
from multi_robot_slam.datasets.identities import Identities
from multi_robot_slam.datasets.levelling import PAPER_TO_OPTICAL, Cloud, in_map
from multi_robot_slam.datasets.stereo_bag import true_map
from multi_robot_slam.front_end.front_end import FrontEnd
from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.front_end.settings import FeatureSettings
from multi_robot_slam.models import stereo
from multi_robot_slam.models.motion import move
from multi_robot_slam.studies import camera_runs, clouds
from multi_robot_slam.studies.camera_runs import Session
from multi_robot_slam.studies.cameras_table import Row
from sim_world import descriptors
from sim_world.rendering.settings import ImageSettings
from sim_world.scenario import SECTION as WORLD_SECTION
from sim_world.scenario import Scenario
from sim_world.simulator import RobotStep, Simulation

LANDMARKS = "landmark level"
"""Set-up without images: points with the front end's own noise."""
RENDERED = "rendered"
"""Perfect images but for the lens's blur."""
EVERYTHING = "all together"
CALIBRATED = "all but decalibrated"

DECALIBRATED = "decalibrated"
"""The right picture is off its calibration: an error that is the same in all pairs."""

PICTURE_SEED = 0
"""One rendering of each set-up serves all seeds of odometry and filter."""

NUISANCES: dict[str, dict[str, object]] = {
    "repeated posters": {"walls": {"repeated": 0.2}},
    "plain walls": {"walls": {"plain": 0.3}},
    "exposure": {"exposure_drift": 0.2},
    "gain": {"gain_difference": 0.1},
    "vignetting": {"vignetting": 0.3},
    "noise": {"photon_noise": 2.5, "read_noise": 1.5},
    "motion blur": {"exposure_s": 0.01},
    "people": {"people": 8},
    DECALIBRATED: {"right_off_px": (0.1, 0.3)},
}
"""Settings of the images, at what their documentation calls realistic."""
SETUPS = (LANDMARKS, RENDERED, *NUISANCES, CALIBRATED, EVERYTHING)


@dataclass(frozen=True)
class Job:
    """One run of the filter."""

    out: Path
    setup: str
    seed: int
    particles: int


def scenario(setup: str) -> Scenario:
    """The calibrated scenario with its three robots, as the `setup` has it."""
    path = scenario_file.find_scenario("calibrated")
    base = scenario_file.from_file(Scenario, path, WORLD_SECTION)
    if setup == LANDMARKS:
        return _landmark_level(base, shipped(FOR_PICTURES).camera.features)
    return replace(base, images=_images(setup))


def _landmark_level(base: Scenario, features: FeatureSettings) -> Scenario:
    """As many observations of the same noise, of as many landmarks as have looks of their own."""
    camera = replace(
        base.camera,
        sigma_rc_px=features.sigma_px,
        sigma_disparity_px=features.sigma_disparity_px,
    )
    count = len(descriptors.load())
    return replace(base, camera=camera, observations=features.observations, landmarks=count)


def _images(setup: str) -> ImageSettings:
    values: dict[str, object] = {"enabled": True, "walls": {}}
    names = {EVERYTHING: [*NUISANCES], CALIBRATED: [n for n in NUISANCES if n != DECALIBRATED]}
    for own in (NUISANCES.get(name, {}) for name in names.get(setup, [setup])):
        walls = {**_mapping(values["walls"]), **_mapping(own.get("walls", {}))}
        values |= own | {"walls": walls}
    return scenario_file.from_mapping(ImageSettings, values, "study cameras")


def _mapping(value: object) -> dict[str, object]:
    return value if isinstance(value, dict) else {}


def configuration(simulation: Simulation, setup: str) -> Config:
    """What the filter is told."""
    base = shipped("calibrated" if setup == LANDMARKS else FOR_PICTURES)
    starts = simulation.start_poses
    return replace(
        base,
        robots=tuple(starts),
        start_poses=tuple((float(x), float(y), float(yaw)) for x, y, yaw in starts.values()),
        start_sigma=(0.0, 0.0),
        mount=simulation.scenario.camera.mount,
        filter=replace(base.filter, noise_at="landmark"),
    )


def clouds_of(out: Path, setup: str) -> list[Cloud]:
    """What the front end sees in the set-up's images: of each instant all robots, in order."""
    return clouds.kept(out / f"{setup.replace(' ', '_')}.npz", lambda: _looked(setup))


def simulation_of(setup: str) -> Simulation:
    """The one whose images the `setup` has."""
    return Simulation(scenario(setup), PICTURE_SEED)


def _looked(setup: str) -> Iterator[Cloud]:
    simulation = simulation_of(setup)
    renderer = simulation.renderer
    if renderer is None:
        raise ValueError(f"{setup} has no images")
    front_end = FrontEnd(rig_of(simulation.scenario.camera), shipped(FOR_PICTURES).camera)
    for instant in simulation.steps():
        for step in instant:
            seen = front_end.observe(*renderer.pair(step.truth))
            yield Cloud(seen.positions, seen.covariances, seen.descriptors)


def rig_of(camera: StereoCamera) -> StereoRig:
    """The simulated camera as the front end knows it."""
    return StereoRig(
        camera.focal_px, camera.centre_px, camera.baseline_m, camera.width_px, camera.height_px
    )


def make_clouds(job: Job) -> None:
    """Render and look, where nobody has yet."""
    if job.setup != LANDMARKS:
        clouds_of(job.out, job.setup)


def compute(job: Job) -> list[Row]:
    """Run the filter and judge it."""
    simulation = Simulation(scenario(job.setup), job.seed)
    config = configuration(simulation, job.setup)
    config = camera_runs.seeded(config, job.seed, job.particles)
    instants = [*simulation.steps()]
    if job.setup == LANDMARKS:
        session = _simulated(simulation, instants, config)
    else:
        session = rendered_session(simulation, instants, clouds_of(job.out, job.setup), config)
    return camera_runs.rows_of(camera_runs.estimate(session, with_batch=False), job.setup)


def _simulated(
    simulation: Simulation, instants: list[tuple[RobotStep, ...]], config: Config
) -> Session:
    steps = [step for instant in instants for step in instant]
    events: list[Event] = [event for step in steps for event in step.events]
    truths = [truth for step in steps if (truth := step.observation_truth)]
    known = {(truth.robot, truth.stamp_ns): truth.landmarks for truth in truths}
    recorded = replace(_recorded(simulation, steps), true_landmarks=simulation.landmarks)
    return Session(config, events, replace(recorded, observation_truth=known))


def rendered_session(
    simulation: Simulation,
    instants: list[tuple[RobotStep, ...]],
    seen: list[Cloud],
    config: Config,
) -> Session:
    """What the team reports that has `seen` this of the rendered images, of all robots in turn."""
    steps = [step for instant in instants for step in instant]
    identities, known = Identities(), {}
    events: list[Event] = []
    for step, cloud in zip(steps, seen, strict=True):
        robot, stamp = step.odometry.robot, step.odometry.stamp_ns
        place, rotation = camera_pose(step.truth.pose, config.mount)
        known[robot, stamp] = identities.of(in_map(cloud, place, rotation), place)
        events += [step.odometry, ObservationSet(robot, stamp, *cloud)]
    recorded = replace(_recorded(simulation, steps), true_landmarks=true_map(identities))
    return Session(config, events, replace(recorded, observation_truth=known))


def _recorded(simulation: Simulation, steps: list[RobotStep]) -> runs.Recorded:
    names = simulation.scenario.names
    return runs.Recorded(
        odometry={
            name: runs.trajectory(s.odometry for s in steps if s.odometry.robot == name)
            for name in names
        },
        truth={name: simulation.truth_path(name) for name in names},
    )


def camera_pose(pose: np.ndarray, mount: CameraMount) -> tuple[np.ndarray, np.ndarray]:
    """Where the left camera of a robot at `pose` (3,) is: place (3,), optical frame -> map."""
    moved = pose[:, None].copy()
    move(moved, np.array([[mount.forward_m], [mount.left_m], [0.0]]))
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    heading = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    axes = stereo.rotation(mount) @ stereo.CAMERA_TO_BODY @ PAPER_TO_OPTICAL
    return np.append(moved[:2, 0], mount.up_m), heading @ axes
