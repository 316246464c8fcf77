"""Recorded stereo cameras as SLAM: EuRoC as one robot, as two at once, and as each half alone."""

from dataclasses import dataclass, replace
from pathlib import Path

from msg_defs.types import Event
from multi_robot_slam import runs
from multi_robot_slam.config import Config
from multi_robot_slam.datasets import euroc, kitti, stereo_bag
from multi_robot_slam.datasets.levelling import Cloud
from multi_robot_slam.datasets.stereo_bag import Part
from multi_robot_slam.datasets.stereo_recording import StereoRecording
from multi_robot_slam.studies import camera_runs, clouds
from multi_robot_slam.studies.camera_runs import Session
from multi_robot_slam.studies.cameras_table import Row
from multi_robot_slam.studies.front_end import EUROC_TRUTH, KITTI_TRUTH

READERS = {"euroc": euroc.read, "kitti": kitti.read}
SETUPS = {
    "euroc": ("one robot", "two robots", "first half alone", "second half alone"),
    "kitti": ("one robot",),
}
TRUTHS = {"euroc": EUROC_TRUTH, "kitti": KITTI_TRUTH}
RANGES_M = {"euroc": stereo_bag.INDOORS_M, "kitti": stereo_bag.ON_ROADS_M}

MOST_HZ = 4.0
"""Of EuRoC's images those that come faster are left out; KITTI has all."""


@dataclass(frozen=True)
class Job:
    """One run of the filter."""

    source: str
    folder: Path
    out: Path
    setup: str
    seed: int
    particles: int


def recording(source: str, folder: Path) -> StereoRecording:
    """The pairs that are used of the recording in `folder`."""
    found = READERS[source](folder)
    return stereo_bag.spaced(found, MOST_HZ) if source == "euroc" else found


def compute(job: Job) -> list[Row]:
    """Run the filter and judge it."""
    pairs = recording(job.source, job.folder)
    camera = stereo_bag.camera_settings(pairs, 1.0, RANGES_M[job.source])
    seen = _clouds(job, pairs)
    team = stereo_bag.parts(pairs, 1 if job.setup == "one robot" else 2)
    config = stereo_bag.configuration(team, camera)
    session = session_of(team, seen, camera_runs.seeded(config, job.seed, job.particles))
    if job.setup.endswith("alone"):
        session = alone(session, ("first half alone", "second half alone").index(job.setup))
    run = camera_runs.estimate(session, with_batch=True)
    return camera_runs.rows_of(run, job.setup, TRUTHS[job.source])


def make_clouds(job: Job) -> None:
    """Look at the images, where nobody has yet."""
    _clouds(job, recording(job.source, job.folder))


def _clouds(job: Job, pairs: StereoRecording) -> list[Cloud]:
    """What the front end finds in each pair."""
    camera = stereo_bag.camera_settings(pairs, 1.0, RANGES_M[job.source])
    team = stereo_bag.parts(pairs, 1)
    return clouds.kept(job.out / "clouds.npz", lambda: stereo_bag.look(team, camera)[team[0].robot])


def session_of(team: list[Part], seen: list[Cloud], config: Config) -> Session:
    """The team's reports, with odometry of the configuration's seed; `seen` of all pairs."""
    left, of_robot = iter(seen), {}
    for part in team:
        of_robot[part.robot] = [next(left) for _ in range(len(part.recording))]
    saw = stereo_bag.observed(team, of_robot)
    moved = stereo_bag.odometry(team, config, config.seed)
    frames = [*stereo_bag.frames(team, saw)]
    events: list[Event] = [sample for samples in moved.values() for sample in samples]
    events += [observed for observed, _ in frames]
    recorded = runs.Recorded(
        odometry={robot: runs.trajectory(samples) for robot, samples in moved.items()},
        truth={part.robot: part.planar() for part in team},
        true_landmarks=stereo_bag.true_map(saw.identities),
        observation_truth={(t.robot, t.stamp_ns): t.landmarks for _, t in frames},
    )
    return Session(config, sorted(events, key=lambda event: event.stamp_ns), recorded)


def alone(session: Session, robot: int) -> Session:
    """The same reports of one robot only."""
    config, recorded = session.config, session.recorded
    name = config.robots[robot]
    return Session(
        replace(
            config,
            robots=(name,),
            start_poses=(config.start_poses[robot],),
            start_sigmas=config.start_sigmas[robot : robot + 1],
        ),
        [event for event in session.events if event.robot == name],
        replace(
            recorded,
            odometry={name: recorded.odometry[name]},
            truth={name: recorded.truth[name]},
            observation_truth={
                key: rows for key, rows in recorded.observation_truth.items() if key[0] == name
            },
        ),
    )
