"""Which squared descriptor distance E_0 tells equal landmarks from different ones, in a bag.

Poses tell what is one place: two observations are equal where their points in `map` are nearest to
each other and agree. Different ones are those that the filter would have to choose from: within its
gate when it comes back, and not one place. The gate is derived from every other pair of frames, and
judged by the rest.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from msg_defs.errors import InputError
from msg_defs.types import EncodedObservations, ObservationSet, Trajectory
from multi_robot_slam import runs
from multi_robot_slam.config import Config
from multi_robot_slam.datasets.levelling import Cloud
from multi_robot_slam.models import stereo
from multi_robot_slam.models.symmetric import inverses, pack, unpack
from multi_robot_slam.pipeline import offline
from multi_robot_slam.runs.trajectory_errors import at, covers
from multi_robot_slam.studies.front_end import (
    AT_A_LOOP,
    EUROC_TRUTH,
    GATE,
    ONE_PLACE,
    PoseSigma,
)

APART_S = 2.0
"""Frames nearer in time show the same from the same side, which is easy."""
FARTHEST_M = 3.0
LARGEST_TURN_RAD = np.radians(30)
"""Frames further apart or turned further show little in common, or from another side."""
MOST_PAIRS = 2000
"""Of frames, evenly spread over all there are."""
MOST_WRONG = 0.02
"""Share of wrong matches that the filter is to live with (`gate`)."""
LEAST_EQUAL = 100
"""Equal landmarks below which nothing can be said."""

TRUTH, ESTIMATE = EUROC_TRUTH, AT_A_LOOP
"""How far poses are off: true ones, and those of a run where the bag has no truth."""


class Spread(NamedTuple):
    """Squared distances E (19) of descriptors."""

    equal: np.ndarray
    """Between observations of one place, nearest to each other."""
    different: np.ndarray
    """Of each observation from what looks most like it among other places within the gate."""
    right: np.ndarray
    """Of each observation from what looks most like it within the gate, where that is its place."""
    wrong: np.ndarray
    """The same, where it is another one."""

    def gate(self, most: float) -> float:
        """E_0: as large as possible, with a share of at most `most` wrong matches within it."""
        levels = np.sort(np.concatenate([self.right, self.wrong]))
        good = np.flatnonzero([self.wrong_within(level) <= most for level in levels])
        return float(levels[good[-1]]) if len(good) else 0.0

    def wrong_within(self, level: float) -> float:
        """Share of wrong ones among the matches up to `level`."""
        right, wrong = int((self.right <= level).sum()), int((self.wrong <= level).sum())
        return wrong / max(right + wrong, 1)


NOTHING = Spread(*(np.empty(0) for _ in range(4)))


class Frame(NamedTuple):
    """What one robot saw at one instant."""

    stamp_s: float
    pose: np.ndarray
    """(3,) in `map`."""
    cloud: Cloud
    """In `map`."""
    distances: np.ndarray
    """(B,) from the robot [m]."""


@dataclass(frozen=True)
class Derivation:
    """What the bag says."""

    spread: Spread
    """Of all pairs of frames."""
    derived_from: Spread
    judged_by: Spread
    """Two halves of them."""
    pairs: int
    is_by_truth: bool


def derive(bag: Path, config: Config) -> Derivation:
    """Compare all frames of the bag that may show one place."""
    recorded = runs.recorded(bag, config.robots)
    paths = {name: path for name, path in recorded.truth.items() if len(path.stamps_ns)}
    is_by_truth = len(paths) == len(config.robots)
    if not is_by_truth:
        run = offline.estimate(bag, config, warn=lambda text: None, refine=True)
        paths = {name: robot.refined for name, robot in run.robots.items()}
    frames = [*_frames(bag, config, paths)]
    pairs = _thinned([*_pairs(frames)])
    poses = TRUTH if is_by_truth else ESTIMATE
    found = [spread_of(a, b, poses) for a, b in pairs]
    whole = _joined(found)
    if len(whole.equal) < LEAST_EQUAL:
        raise InputError(
            f"{bag}: {len(whole.equal)} landmarks seen twice in {len(pairs)} pairs of frames, and "
            f"{LEAST_EQUAL} are the least; take a bag that comes back to where it was"
        )
    return Derivation(whole, _joined(found[::2]), _joined(found[1::2]), len(pairs), is_by_truth)


def _frames(bag: Path, config: Config, paths: dict[str, Trajectory]) -> Iterator[Frame]:
    """The keyframes whose poses are known."""
    last: dict[str, np.ndarray] = {}
    for event in offline.events(bag, config):
        if not isinstance(event, ObservationSet | EncodedObservations):
            continue
        path, stamp = paths[event.robot], np.array([event.stamp_ns])
        if not covers(path, stamp)[0]:
            continue
        pose = at(path, stamp)[0]
        before = last.get(event.robot)
        if before is not None and _is_near(before, pose, config):
            continue
        last[event.robot] = pose
        seen = event.decode() if isinstance(event, EncodedObservations) else event
        yield _frame(seen, pose, config)


def _is_near(before: np.ndarray, pose: np.ndarray, config: Config) -> bool:
    moved, turned = np.hypot(*(pose - before)[:2]), abs(_wrapped(pose[2] - before[2]))
    return bool(moved < config.keyframe.distance_m and turned < config.keyframe.yaw_rad)


def _wrapped(angle: float) -> float:
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def _frame(seen: ObservationSet, pose: np.ndarray, config: Config) -> Frame:
    mount = config.mount_of(config.robots.index(seen.robot))
    positions, covariances = stereo.to_body(seen.positions, seen.covariances, mount)
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    in_map = pack(turn @ unpack(covariances) @ turn.T)
    cloud = Cloud(stereo.to_map(pose, positions), in_map, seen.descriptors)
    return Frame(seen.stamp_ns / 1e9, pose, cloud, np.linalg.norm(positions, axis=1))


def _pairs(frames: Sequence[Frame]) -> Iterator[tuple[Frame, Frame]]:
    """Those that may show one place, of one robot or of two."""
    for first, second in combinations(frames, 2):
        dx, dy, turn = second.pose - first.pose
        is_apart = abs(second.stamp_s - first.stamp_s) >= APART_S or np.hypot(dx, dy) > 0
        near = np.hypot(dx, dy) <= FARTHEST_M and abs(_wrapped(turn)) <= LARGEST_TURN_RAD
        if is_apart and near:
            yield first, second


def _thinned(pairs: list[tuple[Frame, Frame]]) -> list[tuple[Frame, Frame]]:
    step = max(1, -(-len(pairs) // MOST_PAIRS))
    return pairs[::step]


def spread_of(first: Frame, second: Frame, poses: PoseSigma) -> Spread:
    """E between equal and different landmarks of two frames whose poses err by `poses`."""
    exact = _mahalanobis_sq(first, second, poses)
    loose = _mahalanobis_sq(first, second, AT_A_LOOP)
    squared = 2 - 2 * first.cloud.descriptors @ second.cloud.descriptors.T
    if not squared.size:
        return NOTHING
    is_equal = exact <= np.minimum(exact.min(axis=1, keepdims=True), GATE)
    is_equal &= exact <= exact.min(axis=0, keepdims=True)
    near = np.where(loose <= GATE, squared, np.inf)
    nearest = np.where(exact > ONE_PLACE, near, np.inf).min(axis=0)
    best = near.argmin(axis=0), np.arange(squared.shape[1])
    is_match = np.isfinite(near[best])
    is_right = (exact[best] <= ONE_PLACE)[is_match]
    chosen = squared[best][is_match]
    return Spread(
        squared[is_equal], nearest[np.isfinite(nearest)], chosen[is_right], chosen[~is_right]
    )


def _mahalanobis_sq(first: Frame, second: Frame, poses: PoseSigma) -> np.ndarray:
    """(A, B): D of the points of one frame against those of the other."""
    parts = []
    for frame in (first, second):
        variance = poses.place_m**2 + (poses.angle_rad * frame.distances) ** 2
        parts.append(unpack(frame.cloud.covariances) + variance[:, None, None] * np.eye(3))
    total = pack(parts[0][:, None] + parts[1][None])
    information = unpack(inverses(total.reshape(-1, 6))).reshape(*total.shape[:2], 3, 3)
    apart = first.cloud.positions[:, None] - second.cloud.positions[None]
    return np.einsum("abi,abij,abj->ab", apart, information, apart)


def _joined(found: Sequence[Spread]) -> Spread:
    return Spread(*(np.concatenate(parts) for parts in zip(NOTHING, *found, strict=True)))


EDGES = np.arange(0.0, 1.01, 0.05)


def markdown(found: Derivation, gate: float, wrong: float = MOST_WRONG) -> str:
    """Both distributions, the threshold and how it was found, beside the `gate` in use."""
    equal, different = found.spread.equal, found.spread.different
    poses = "true poses" if found.is_by_truth else "the run's refined poses"
    lines = [
        f"{found.pairs} pairs of frames, by {poses}: {len(equal)} observations of one place, "
        f"{len(different)} of another one within the gate, each with what looks most like it.",
        "",
        "| E up to | equal | different | wrong among those within |",
        "|---:|---:|---:|---:|",
    ]
    for edge in EDGES[1:]:
        lines.append(
            f"| {edge:.2f} | {_share(equal, edge)} | {_share(different, edge)} | "
            f"{100 * found.spread.wrong_within(edge):.2f} % |"
        )
    own, rest = found.derived_from.gate(wrong), found.judged_by
    lines += [
        "",
        f"E_0 = {own:.3f}: the largest with {100 * wrong:g} % wrong at most, from every other pair "
        f"of frames; in the rest {100 * rest.wrong_within(own):.2f} % are wrong within it, and "
        f"{_share(rest.equal, own)} of the equal ones are. filter.descriptor_gate is {gate:g}: "
        f"{100 * rest.wrong_within(gate):.2f} % and {_share(rest.equal, gate)}.",
    ]
    return "\n".join(lines) + "\n"


def _share(values: np.ndarray, edge: float) -> str:
    return f"{100 * np.mean(values <= edge):.1f} %" if len(values) else "-"
