"""What one run left behind, wherever it came from: a recorded bag or a pipeline in this process.

A live run is a bag with everything in it. An offline run is a folder: its bag `estimates` holds
what the fusion would have published, `result.json` names the bag of the recording.
"""

import csv
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from msg_defs.topics import Topic
from msg_defs.types import (
    COVARIANCE_ORDER,
    Estimate,
    LandmarkMap,
    PoseSample,
    StepRecord,
    Trajectory,
    Walls,
)
from multi_robot_slam.bags import BagReader, BagWriter, absolute
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.runs.trajectory_errors import sampled

ESTIMATES = "estimates"
"""Name of the bag in the folder of an offline run."""
RESULT = "result.json"
TEAM = "team"
"""Whose figures those of all robots together are."""

DROPPED = "dropped: "
"""Prefix of the keys under which the fusion's diagnostics count what was dropped, by reason."""


LATER_PATHS = {
    "mean": topics.mean_path,
    "refined": topics.refined_path,
    "batch": topics.yardstick_path,
}
"""Paths that are known at the end of a run alone: field of `RobotRun` -> topic."""

EMPTY = Trajectory(np.empty(0, np.int64), np.empty((0, 3)))
"""The trajectory a run does not have."""


@dataclass(frozen=True, eq=False)
class RobotRun:
    """One robot's trajectories in `map`; one the run does not have is empty, unknown truth None."""

    start_pose: np.ndarray
    """(3,) float64: configured x [m], y [m], yaw [rad] at the first filtered frame, in `map`."""
    odometry: Trajectory
    """As recorded, in the robot's own `odom` frame."""
    online: Trajectory
    """Poses of the best particle as published at each step."""
    path: Trajectory
    """The best particle's whole path at the end."""
    truth: Trajectory | None = None
    """True poses."""
    online_mean: Trajectory = EMPTY
    """Means of the particles as published at each step."""
    mean: Trajectory = EMPTY
    """The mean of all particles' whole paths at the end."""
    refined: Trajectory = EMPTY
    """The best particle's path, smoothed over its associations."""
    batch: Trajectory = EMPTY
    """The yardstick: the path smoothed over the true associations."""


@dataclass(frozen=True, eq=False)
class Run:
    """Everything the evaluation and the figures of one run need."""

    config: Config
    robots: dict[str, RobotRun]
    """In the team's order."""
    landmarks: LandmarkMap
    """The best particle's map at the end."""
    steps: list[StepRecord]
    dropped: dict[str, int] = field(default_factory=dict)
    """How many messages the pipeline refused, by reason."""
    true_landmarks: LandmarkMap | None = None
    walls: Walls | None = None
    observation_truth: dict[tuple[str, int], np.ndarray] = field(default_factory=dict)
    """(robot, stamp_ns) -> (B,) uint32: row in `true_landmarks` of each observation."""
    warnings: tuple[str, ...] = ()
    """What was missing or broken in the bag without making the rest useless."""
    refined_landmarks: LandmarkMap | None = None
    """The best particle's map, smoothed over its associations; ids are the same."""
    bag: Path | None = None
    """Where the recording is; None if the run was never recorded."""

    def with_paths(self, **kinds: Mapping[str, Trajectory]) -> "Run":
        """Also these paths of the robots: `mean`, `refined`, `batch`."""
        robots = {
            name: replace(robot, **{kind: paths.get(name, EMPTY) for kind, paths in kinds.items()})
            for name, robot in self.robots.items()
        }
        return replace(self, robots=robots)


@dataclass(frozen=True, eq=False)
class Recorded:
    """What a recording holds apart from estimates: odometry, and the truth where there is any."""

    odometry: dict[str, Trajectory]
    """Of each robot, in its own `odom` frame."""
    truth: dict[str, Trajectory] = field(default_factory=dict)
    true_landmarks: LandmarkMap | None = None
    walls: Walls | None = None
    observation_truth: dict[tuple[str, int], np.ndarray] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    bag: Path | None = None


def load(folder: Path) -> Run:
    """The run in `folder`: a live one with its bag in `folder/bag`, or an offline one.

    A bag itself is a live run, too.
    """
    folder = Path(folder)
    if is_offline(folder):
        return from_folder(folder)
    bag = folder / "bag"
    return from_bag(bag if bag.exists() else folder)


def is_offline(folder: Path) -> bool:
    """`folder` holds what `multi_robot_slam run` left."""
    return (Path(folder) / ESTIMATES).is_dir()


def from_bag(path: Path) -> Run:
    """The live run in the bag at `path`, with its estimates as they were published."""
    config = _config(path)
    wanted = [*_outputs(config.robots), *_inputs(config.robots)]
    messages, warnings = _read(path, wanted)
    recording = _recorded(path, messages, config.robots, warnings)
    return _estimated(path, messages, config, recording)


def from_folder(folder: Path) -> Run:
    """The offline run in `folder`, as `write_estimates` and `write` left it."""
    estimates = folder / ESTIMATES
    config = _config(estimates)
    messages, _ = _read(estimates, _outputs(config.robots))
    recording = recorded(_bag_of(folder), config.robots)
    return _estimated(estimates, messages, config, recording)


def _bag_of(folder: Path) -> Path:
    bag = figures_in(folder).get("bag")
    if bag is None or not Path(bag).exists():
        raise InputError(
            f"{folder / RESULT}: the bag of this run is not at {bag}; correct `bag` in this file, "
            "or estimate again with `multi_robot_slam run`"
        )
    return Path(bag)


def figures_in(folder: Path) -> dict:
    """What `result.json` in `folder` holds; `InputError` if there is none."""
    path = Path(folder) / RESULT
    try:
        figures = json.loads(path.read_text())
    except OSError as error:
        raise InputError(
            f"cannot read {path}: {error.strerror}; name the folder of a run, "
            f"judged by `multi_robot_slam evaluate {folder}`"
        ) from None
    except ValueError as error:
        raise InputError(f"{path} is not JSON ({error}); write it again: `evaluate`") from None
    if not isinstance(figures, dict):
        raise InputError(f"{path} holds no figures of a run; write it again: `evaluate`")
    return figures


def _estimated(
    path: Path, messages: dict[Topic, list[bytes]], config: Config, recording: Recorded
) -> Run:
    def last(kind: Callable[[str], Topic]) -> dict[str, Trajectory]:
        found = {robot: messages[kind(robot)] for robot in config.robots}
        return {robot: wire.decode_path(m[-1], robot) for robot, m in found.items() if m}

    missing = [topic for topic in (topics.STEPS, topics.MAP_LANDMARKS) if not messages[topic]]
    if not any(messages[topics.path(robot)] for robot in config.robots):
        missing += map(topics.path, config.robots)
    if missing:
        raise _no_estimates(path, missing)
    run = assemble(
        config,
        recording,
        steps=_steps(messages, config.robots),
        paths=last(topics.path),
        landmarks=wire.decode_map(messages[topics.MAP_LANDMARKS][-1]),
        dropped=_dropped(messages[topics.DIAGNOSTICS]),
    )
    refined = messages[topics.REFINED_LANDMARKS]
    return replace(
        run.with_paths(**{later: last(kind) for later, kind in LATER_PATHS.items()}),
        refined_landmarks=wire.decode_map(refined[-1]) if refined else None,
    )


def write_estimates(run: Run, folder: Path) -> None:
    """Write what the fusion would have published into the bag `estimates` in `folder`."""
    end_ns = run.steps[-1].stamp_ns if run.steps else 0
    with BagWriter(Path(folder) / ESTIMATES) as bag:
        text = scenario_file.to_yaml(**{SECTION: run.config})
        bag.write(topics.FUSION_CONFIG, end_ns, wire.encode_text(text))
        for step in run.steps:
            bag.write(topics.STEPS, step.stamp_ns, wire.encode_step(step))
            for estimate in step.estimates:
                for topic, data in _of_estimate(estimate):
                    bag.write(topic, step.stamp_ns, data)
        for topic, data in _at_the_end(run, end_ns):
            bag.write(topic, end_ns, data)


def _of_estimate(estimate: Estimate) -> Iterator[tuple[Topic, bytes]]:
    yield topics.pose(estimate.robot), wire.encode_estimate(estimate)
    if estimate.mean is not None:
        yield topics.mean_pose(estimate.robot), wire.encode_mean(estimate)


def _at_the_end(run: Run, end_ns: int) -> Iterator[tuple[Topic, bytes]]:
    counts = {f"{DROPPED}{reason}": str(count) for reason, count in run.dropped.items()}
    yield topics.DIAGNOSTICS, wire.encode_diagnostics(end_ns, [wire.Status("fusion", counts)])
    yield topics.MAP_LANDMARKS, wire.encode_map(run.landmarks, end_ns)
    if run.refined_landmarks is not None:
        yield topics.REFINED_LANDMARKS, wire.encode_map(run.refined_landmarks, end_ns)
    for name, robot in run.robots.items():
        for attribute, kind in {"path": topics.path, **LATER_PATHS}.items():
            path = getattr(robot, attribute)
            if len(path.stamps_ns):
                yield kind(name), wire.encode_path(path, end_ns)


def recorded(path: Path, robots: Iterable[str]) -> Recorded:
    """Odometry and truth of `robots` in the bag at `path`, which need not hold estimates."""
    robots = tuple(robots)
    messages, warnings = _read(path, _inputs(robots))
    return _recorded(path, messages, robots, warnings)


def assemble(
    config: Config,
    recording: Recorded,
    steps: list[StepRecord],
    paths: dict[str, Trajectory],
    landmarks: LandmarkMap,
    dropped: Mapping[str, int],
) -> Run:
    """Join a recording with what the filter made of it: `paths` and `landmarks` at the end."""
    estimates = {name: _estimates(steps, name) for name in config.robots}
    robots = {
        name: RobotRun(
            start_pose=np.array(start),
            odometry=recording.odometry.get(name, EMPTY),
            online=trajectory(estimates[name]),
            path=paths.get(name, EMPTY),
            truth=recording.truth.get(name),
            online_mean=trajectory(
                replace(e, pose=e.mean) for e in estimates[name] if e.mean is not None
            ),
        )
        for name, start in zip(config.robots, config.start_poses, strict=True)
    }
    return Run(
        config,
        robots,
        landmarks,
        steps,
        dict(dropped),
        recording.true_landmarks,
        recording.walls,
        recording.observation_truth,
        recording.warnings,
        bag=recording.bag,
    )


def _estimates(steps: Iterable[StepRecord], robot: str) -> list[Estimate]:
    return [e for step in steps for e in step.estimates if e.robot == robot]


def trajectory(samples: Iterable[PoseSample | Estimate]) -> Trajectory:
    """One robot's samples by stamp; of several with the same stamp the first counts."""
    samples = list(samples)
    stamps, first = np.unique([s.stamp_ns for s in samples], return_index=True)
    poses = np.array([samples[row].pose for row in first], float).reshape(-1, 3)
    return Trajectory(stamps.astype(np.int64), poses)


def write(run: Run, figures: dict, folder: Path) -> None:
    """Write a run and its figures of merit (`evaluation.evaluate`) into `folder`.

    `result.json`, and the same as `figures.csv`, a row a figure; `config.yaml`, the full
    configuration; `trajectory_<robot>.tum`, the best particle's path in `map`; `map.csv`;
    `refined_<robot>.tum` and `refined_map.csv` where the run was refined; `truth_<robot>.tum`,
    interpolated at the stamps of the path, where the truth is known.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / RESULT).write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n")
    _write_figures(figures, folder / "figures.csv")
    (folder / "config.yaml").write_text(scenario_file.to_yaml(**{SECTION: run.config}))
    _write_map(run.landmarks, folder / "map.csv")
    for name, robot in run.robots.items():
        (folder / f"trajectory_{name}.tum").write_text(to_tum(robot.path))
        if len(robot.refined.stamps_ns):
            (folder / f"refined_{name}.tum").write_text(to_tum(robot.refined))
        if robot.truth is not None:
            truth = sampled(robot.truth, robot.path.stamps_ns)
            (folder / f"truth_{name}.tum").write_text(to_tum(truth))
    if run.refined_landmarks is not None:
        _write_map(run.refined_landmarks, folder / "refined_map.csv")


def flat(figures: dict) -> dict[tuple[str, str], object]:
    """(robot, or TEAM; figure) -> value of everything `result.json` holds.

    What was dropped becomes figures of its own.
    """
    team = {name: value for name, value in figures.items() if name not in ("robots", "dropped")}
    team |= {f"{DROPPED}{why}": count for why, count in figures.get("dropped", {}).items()}
    whose = {TEAM: team, **figures.get("robots", {})}
    return {(who, name): value for who, own in whose.items() for name, value in own.items()}


def _write_figures(figures: dict, path: Path) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["robot", "figure", "value"])
        writer.writerows([*key, value] for key, value in flat(figures).items())


def to_tum(path: Trajectory) -> str:
    """One line a pose: `stamp x y z qx qy qz qw`, stamp in seconds with 9 decimals, z = 0 [m]."""
    lines = (_tum_line(*row) for row in zip(path.stamps_ns.tolist(), path.poses, strict=True))
    return "".join(lines)


def _tum_line(stamp_ns: int, pose: np.ndarray) -> str:
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    x, y, yaw = pose
    qz, qw = np.sin(yaw / 2), np.cos(yaw / 2)
    return f"{seconds}.{nanoseconds:09d} {x:.9f} {y:.9f} 0 0 0 {qz:.9f} {qw:.9f}\n"


def _write_map(landmarks: LandmarkMap, path: Path) -> None:
    header = [
        "id",
        "x",
        "y",
        "z",
        *(f"cov_{e}" for e in COVARIANCE_ORDER),
        "observations",
        "robots",
    ]
    rows = zip(
        landmarks.ids,
        landmarks.positions,
        landmarks.covariances,
        landmarks.observations,
        landmarks.robots,
        strict=True,
    )
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for landmark, place, elements, observations, robots in rows:
            writer.writerow([landmark, *place, *elements, observations, robots])


def _inputs(robots: Iterable[str]) -> list[Topic]:
    kinds = (topics.odometry, topics.ground_truth, topics.observation_truth)
    own = [kind(robot) for robot in robots for kind in kinds]
    return [topics.GROUND_TRUTH_LANDMARKS, topics.GROUND_TRUTH_WALLS, *own]


def _outputs(robots: Iterable[str]) -> list[Topic]:
    kinds = (topics.pose, topics.mean_pose, topics.path, *LATER_PATHS.values())
    own = [kind(robot) for robot in robots for kind in kinds]
    team = [topics.STEPS, topics.MAP_LANDMARKS, topics.REFINED_LANDMARKS, topics.DIAGNOSTICS]
    return [*team, *own]


def _read(path: Path, wanted: Iterable[Topic]) -> tuple[dict[Topic, list[bytes]], tuple[str, ...]]:
    """The messages of each wanted topic, by time, and the reader's warnings."""
    reader = BagReader(path)
    messages: dict[Topic, list[bytes]] = {topic: [] for topic in wanted}
    for topic, data in reader.only(messages):
        messages[topic].append(data)
    return messages, tuple(reader.warnings)


def _config(path: Path) -> Config:
    name = absolute(topics.FUSION_CONFIG.name)
    _, data = next(BagReader(path).only([topics.FUSION_CONFIG]), (None, None))
    if data is None:
        raise _no_estimates(path, [topics.FUSION_CONFIG])
    return scenario_file.from_yaml(Config, wire.decode_text(data), SECTION, f"{path}: {name}")


def _no_estimates(path: Path, missing: list[Topic]) -> InputError:
    names = ", ".join(absolute(topic.name) for topic in missing)
    return InputError(
        f"{path} holds no estimates: {names} not in it, its topics are {BagReader(path).found()}; "
        "record the fusion's topics too, or estimate from the recording with "
        f"`multi_robot_slam run {path}`"
    )


def _recorded(
    path: Path,
    messages: dict[Topic, list[bytes]],
    robots: Iterable[str],
    warnings: tuple[str, ...],
) -> Recorded:
    def poses(kind: Callable[[str], Topic]) -> dict[str, Trajectory]:
        found = {robot: messages[kind(robot)] for robot in robots}
        return {
            robot: trajectory(wire.decode_pose(data, robot) for data in stream)
            for robot, stream in found.items()
            if stream
        }

    true_maps = messages[topics.GROUND_TRUTH_LANDMARKS]
    walls = messages[topics.GROUND_TRUTH_WALLS]
    seen = [
        wire.decode_observation_truth(data, robot)
        for robot in robots
        for data in messages[topics.observation_truth(robot)]
    ]
    return Recorded(
        odometry=poses(topics.odometry),
        truth=poses(topics.ground_truth),
        true_landmarks=wire.decode_map(true_maps[-1]) if true_maps else None,
        walls=wire.decode_walls(walls[-1]) if walls else None,
        observation_truth={(truth.robot, truth.stamp_ns): truth.landmarks for truth in seen},
        warnings=warnings,
        bag=Path(path).resolve(),
    )


def _steps(messages: dict[Topic, list[bytes]], robots: Iterable[str]) -> list[StepRecord]:
    """The steps, with the estimates that were published on each robot's `pose`, `mean_pose`."""
    robots = tuple(robots)
    published = _published(messages, robots, topics.pose)
    for key, mean in _published(messages, robots, topics.mean_pose).items():
        if key in published:
            published[key] = replace(published[key], mean=mean.pose)
    steps = []
    for step in map(wire.decode_step, messages[topics.STEPS]):
        keys = [(frame.robot, step.stamp_ns) for frame in step.frames]
        estimates = tuple(published[key] for key in keys if key in published)
        steps.append(replace(step, estimates=estimates))
    return steps


def _published(
    messages: dict[Topic, list[bytes]], robots: tuple[str, ...], kind: Callable[[str], Topic]
) -> dict[tuple[str, int], Estimate]:
    """Robot and stamp -> what was published."""
    return {
        (robot, estimate.stamp_ns): estimate
        for robot in robots
        for estimate in (wire.decode_estimate(d, robot) for d in messages[kind(robot)])
    }


def _dropped(messages: list[bytes]) -> dict[str, int]:
    """Counts in the fusion's last diagnostics: `dropped: <reason>` of the status `fusion`."""
    for data in reversed(messages):
        for status in wire.decode_diagnostics(data)[1]:
            if status.name == "fusion":
                return {
                    key.removeprefix(DROPPED): int(count)
                    for key, count in status.values.items()
                    if key.startswith(DROPPED)
                }
    return {}
