"""Map and paths of a run as files of other programs: TUM, g2o, PLY.

g2o and PLY hold the refined paths and map where the run was refined, else the best particle's.
"""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np

from msg_defs.errors import InputError
from msg_defs.types import LandmarkMap, Trajectory
from multi_robot_slam.models.motion import MotionSettings, increment, spread
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.runs.colours import ROBOT_COLOURS
from multi_robot_slam.runs.robot_errors import odometry_in_map
from multi_robot_slam.runs.run import EMPTY, Run
from multi_robot_slam.runs.text_files import to_tum
from multi_robot_slam.runs.trajectory_errors import at, sampled

STANDING_VARIANCE = 1e-10
"""Added to the odometry's variances [m^2, rad^2]: standing still has none, g2o wants inverses."""

LANDMARK_COLOUR = (150, 150, 150)

POINT = np.dtype(
    [
        *((axis, "<f4") for axis in ("x", "y", "z")),
        *((colour, "u1") for colour in ("red", "green", "blue")),
        ("sigma", "<f4"),
        ("landmark", "<i4"),
        ("robot", "<i4"),
    ]
)
"""A vertex of the PLY file."""
_PLY_TYPES = {"<f4": "float", "|u1": "uchar", "<i4": "int"}


def tum(run: Run, folder: Path) -> list[str]:
    """Each path of each robot as `<folder>/<kind>_<robot>.tum`; the kinds written.

    `trajectory`, the best particle's at the end; `online`, as published; `odometry`, composed onto
    the start; `mean`, `refined` where there are any; `truth`, at the stamps of `trajectory`.
    """
    written = []
    folder.mkdir(parents=True, exist_ok=True)
    for name, robot in run.robots.items():
        paths = {
            "trajectory": robot.path,
            "online": robot.online,
            "odometry": odometry_in_map(robot),
            "mean": robot.mean,
            "refined": robot.refined,
            "truth": EMPTY if robot.truth is None else sampled(robot.truth, robot.path.stamps_ns),
        }
        for kind, path in paths.items():
            if len(path.stamps_ns):
                (folder / f"{kind}_{name}.tum").write_text(to_tum(path))
                written.append(f"{kind} of {name}")
    return written


def g2o(run: Run, file: Path) -> list[str]:
    """A pose graph: poses, odometry between them, landmarks; what is which vertex, and left out.

    VERTEX_SE2 for every pose, robot after robot; EDGE_SE2 from each to the robot's next, the
    odometry's increment and the inverse of the covariance (7) that the filter was told;
    VERTEX_XY for every landmark, after the poses.
    """
    landmarks, paths = _best(run)
    vertices: list[str] = []
    edges: list[str] = []
    told: list[str] = []
    for name, path in paths.items():
        if len(path.stamps_ns):
            first = len(vertices)
            vertices += [
                f"VERTEX_SE2 {first + row} {_words(pose)}\n" for row, pose in enumerate(path.poses)
            ]
            edges += _odometry_edges(run, name, path, first)
            told.append(f"{name}: vertices {first} to {len(vertices) - 1}")
    first = len(vertices)
    vertices += [
        f"VERTEX_XY {first + row} {_words(place)}\n"
        for row, place in enumerate(landmarks.positions[:, :2].tolist())
    ]
    file.write_text("".join(vertices + edges))
    source = "map.csv" if run.refined_landmarks is None else "refined_map.csv"
    return [
        *told,
        f"landmarks: {len(landmarks.ids)} vertices from {first} on, in the order of {source}",
        "left out, for g2o has no place for it: stamps, heights, covariances, descriptors",
        "left out, for a run does not keep them: observations, so landmarks have no edge",
    ]


def _odometry_edges(run: Run, name: str, path: Trajectory, first: int) -> list[str]:
    odometry = run.robots[name].odometry
    if not len(odometry.stamps_ns):
        return []
    poses = at(odometry, path.stamps_ns)
    motions = [increment(*pair) for pair in pairwise(poses)]
    seconds = np.diff(path.stamps_ns) / 1e9
    noise = run.config.filter.motion
    information = [_information(*pair, noise) for pair in zip(motions, seconds, strict=True)]
    return [
        f"EDGE_SE2 {vertex} {vertex + 1} {_words(motion)} {_words(own)}\n"
        for vertex, (motion, own) in enumerate(zip(motions, information, strict=True), start=first)
    ]


def _information(motion: np.ndarray, seconds: float, noise: MotionSettings) -> np.ndarray:
    """(6,): the upper triangle of the inverse covariance, seen from the pose motion leads to."""
    xx, xy, yy, yaw = spread(motion, seconds, noise)
    floor = STANDING_VARIANCE * np.eye(2)
    (xx, xy), (_, yy) = np.linalg.inv(np.array([[xx, xy], [xy, yy]]) + floor)
    return np.array([xx, xy, 0, yy, 0, 1 / (yaw + STANDING_VARIANCE)])


def _words(values: np.ndarray) -> str:
    """Numbers that read back as the same."""
    return " ".join(repr(float(value)) for value in values)


def ply(run: Run, file: Path) -> list[str]:
    """A binary cloud of coloured points: the landmarks, and the robots' poses on the floor.

    Of each point `landmark`, its id, -1 for a pose; `robot`, its index in the team, -1 for a
    landmark; `sigma` [m], a landmark's standard deviation in its worst direction, 0 for a pose.
    """
    landmarks, paths = _best(run)
    points = np.concatenate(
        [
            landmark_points(landmarks),
            *(pose_points(path, index) for index, path in enumerate(paths.values())),
        ]
    )
    write_points(points, file)
    return [
        f"{len(landmarks.ids)} landmarks and {len(points) - len(landmarks.ids)} poses",
        "left out: stamps, headings, directions of the covariances, descriptors",
    ]


def write_points(points: np.ndarray, file: Path) -> None:
    """Write `points` (N,) of POINT as a binary cloud (PLY)."""
    names = POINT.names or ()
    lines = [f"property {_PLY_TYPES[POINT[name].str]} {name}" for name in names]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *lines]
    file.write_bytes("\n".join([*head, "end_header\n"]).encode() + points.tobytes())


def landmark_points(landmarks: LandmarkMap) -> np.ndarray:
    """(N,) of POINT."""
    points = np.zeros(len(landmarks.ids), POINT)
    for axis, values in zip("xyz", landmarks.positions.T, strict=True):
        points[axis] = values
    points["red"], points["green"], points["blue"] = LANDMARK_COLOUR
    covariances = unpack(landmarks.covariances)
    points["sigma"] = np.sqrt(np.linalg.eigvalsh(covariances)[:, -1])
    points["landmark"] = landmarks.ids
    points["robot"] = -1
    return points


def pose_points(path: Trajectory, robot: int) -> np.ndarray:
    """(T,) of POINT."""
    points = np.zeros(len(path.stamps_ns), POINT)
    points["x"], points["y"] = path.poses[:, 0], path.poses[:, 1]
    colour = bytes.fromhex(ROBOT_COLOURS[robot % len(ROBOT_COLOURS)].removeprefix("#"))
    points["red"], points["green"], points["blue"] = colour
    points["landmark"] = -1
    points["robot"] = robot
    return points


def _best(run: Run) -> tuple[LandmarkMap, dict[str, Trajectory]]:
    """The best map and paths the run has, both from the same estimate."""
    if run.refined_landmarks is None:
        return run.landmarks, {name: robot.path for name, robot in run.robots.items()}
    return run.refined_landmarks, {name: robot.refined for name, robot in run.robots.items()}


FORMATS: dict[str, Callable[[Run, Path], list[str]]] = {"tum": tum, "g2o": g2o, "ply": ply}
"""Writes the run to a file, for TUM a folder, and tells what it wrote and left out."""


def export(run: Run, name: str, out: Path) -> list[str]:
    """Write `run` in one of FORMATS to `out`, which must not exist; what it holds, in lines."""
    if name not in FORMATS:
        raise InputError(f"unknown format '{name}': export to {', '.join(FORMATS)}")
    if out.exists():
        raise InputError(f"{out} exists; remove it or choose another with --out")
    try:
        return FORMATS[name](run, out)
    except OSError as error:
        raise InputError(f"cannot write {out}: {error.strerror}; choose another --out") from None
