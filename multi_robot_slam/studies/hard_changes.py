"""What can be otherwise than the fusion is told, one thing at a time.

A change takes what an exact team sends and is told, and gives it back with its own difference and
no other. Directions, signs and moments come from the random numbers it is handed. Of the truth
nothing changes but what the change is about: robots drive, and see, as they did.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple

import numpy as np

from msg_defs.types import Event, LandmarkMap, ObservationSet, PoseSample, Trajectory
from multi_robot_slam import runs
from multi_robot_slam.config import UNKNOWN, Config, StartPose
from multi_robot_slam.filter.kept import KeptMap
from multi_robot_slam.models.motion import MotionSettings, increment
from multi_robot_slam.runs.trajectory_errors import at, wrap
from sim_world import stereo
from sim_world.robot import MIN_DEPTH_M, START_NS
from sim_world.scenario import Scenario

MOVED_LANDMARKS, MOVED_M, MOVED_AFTER_S = 30, 1.0, 60.0
BAY_M, COPIES = 1.2, 3
SLIP_S = 1.0
"""A slip takes so long: in one sample it would be no motion of any robot, and refused."""
AUTOSAVE_S = 5.0
"""The longest time since the last state was saved."""
BACK_AFTER_S = 5.0
"""A fusion that was killed is there again: it starts, and loads what is compiled."""
NEAREST_M = 0.5
"""Nearest random position of an observation."""


class Loaded(NamedTuple):
    """The map that a team left the day before, with which the fusion begins."""

    kept: KeptMap
    sources: dict[int, int]
    """Id -> row in the true map, of the landmarks that come from one."""


@dataclass(frozen=True, eq=False)
class Told:
    """What a team sends to its fusion, what this is told before, and what is true."""

    scenario: Scenario
    config: Config
    """Of the fusion: what it is told."""
    events: tuple[Event, ...]
    """In the order in which they arrive."""
    recorded: runs.Recorded
    """The truth."""
    culprits: tuple[str, ...]
    """The robots that the difference is about."""
    begins_ns: int = START_NS
    """When the difference begins."""
    known_ns: int | None = None
    """From when on it can be noticed; None: from the culprits' first meeting with another robot."""
    factors: tuple[float, float] = (1.0, 1.0)
    """True standard deviations of odometry and camera over those that the fusion is told."""
    old_places: dict[int, np.ndarray] = field(default_factory=dict)
    """Row in the true map -> (3,) where a landmark was before it moved."""
    loaded: Loaded | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Of the robots."""
        return self.config.robots

    @property
    def end_ns(self) -> int:
        """The newest stamp."""
        return max(event.stamp_ns for event in self.events)

    @property
    def landmarks(self) -> LandmarkMap:
        """The true map."""
        assert self.recorded.true_landmarks is not None
        return self.recorded.true_landmarks


Change = Callable[[Told, np.random.Generator], Told]


def nothing(told: Told, rng: np.random.Generator) -> Told:
    """The exact world."""
    return told


def in_turn(*changes: Change) -> Change:
    """All of them, one after the other."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        for one in changes:
            told = one(told, rng)
        return told

    return change


def certain(told: Told, rng: np.random.Generator) -> Told:
    """The fusion is told that the starts are known exactly."""
    return replace(told, config=replace(told.config, start_sigma=(0.0, 0.0)))


def start_off(
    robot: int, distance_m: float, degrees: float, sigma: tuple[float, float] | None = None
) -> Change:
    """A robot starts so far from where the fusion is told; `sigma` (m, rad) is told if given."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        direction, side = rng.uniform(-np.pi, np.pi), rng.choice([-1, 1])
        off = np.array([np.cos(direction), np.sin(direction), 0.0]) * distance_m
        off[2] = side * np.radians(degrees)
        starts = [np.array(start) for start in told.config.start_poses]
        starts[robot] = starts[robot] + off
        config = replace(told.config, start_poses=_tuples(starts))
        if sigma is not None:
            config = replace(config, start_sigma=sigma)
        return replace(told, config=config, culprits=(told.names[robot],))

    return change


def starts_swapped(told: Told, rng: np.random.Generator) -> Told:
    """Each of two robots is told to start where the other does."""
    one, other = rng.choice(len(told.names), 2, replace=False)
    starts = [np.array(start) for start in told.config.start_poses]
    starts[one], starts[other] = starts[other], starts[one]
    config = replace(told.config, start_poses=_tuples(starts))
    return replace(told, config=config, culprits=(told.names[one], told.names[other]))


def one_start_unknown(told: Told, rng: np.random.Generator) -> Told:
    """Of one robot nobody says where it starts."""
    return _unknown(told, (_anyone(told, rng),))


def one_start_known(told: Told, rng: np.random.Generator) -> Told:
    """Of one robot alone it is said where it starts."""
    known = _anyone(told, rng)
    return _unknown(told, tuple(name for name in told.names if name != known))


def all_starts_unknown(told: Told, rng: np.random.Generator) -> Told:
    """Of no robot it is said where it starts."""
    return _unknown(told, told.names)


def only_localised(told: Told, rng: np.random.Generator) -> Told:
    """The map does not change."""
    own = replace(told.config.filter, mapping=False)
    return replace(told, config=replace(told.config, filter=own))


def landmarks_gone(share: float) -> Change:
    """Each landmark is gone with this probability: nobody sees it any more."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        is_gone = rng.random(len(told.landmarks.ids)) < share
        return _only_seen(told, lambda seen, rows: ~is_gone[rows])

    return change


def walls_thrice(told: Told, rng: np.random.Generator) -> Told:
    """Each bay of a wall, 1.2 m wide, is there three times, with all that is on it."""
    landmarks = _repeated(told, rng)
    old, new = (one.positions.astype(float) for one in (told.landmarks, landmarks))

    def again(seen: ObservationSet, rows: np.ndarray) -> ObservationSet:
        by = _in_camera(told, seen, new[rows]) - _in_camera(told, seen, old[rows])
        looks = landmarks.descriptors[rows] - told.landmarks.descriptors[rows]
        moved = _at_points(told, seen, seen.positions + by)
        return replace(moved, descriptors=seen.descriptors + looks)

    result = _seen(told, again)
    return replace(result, recorded=replace(result.recorded, true_landmarks=landmarks))


def _repeated(told: Told, rng: np.random.Generator) -> LandmarkMap:
    """The true landmarks, of whose bays with as many each two become copies of a third."""
    assert told.recorded.walls is not None
    segments, places = told.recorded.walls.segments, told.landmarks.positions.astype(float)
    begins, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    lengths = np.hypot(*along.T)
    along /= lengths[:, None]
    apart = places[:, None, :2] - begins
    ways = np.clip(np.einsum("nwi,wi->nw", apart, along), 0, lengths)
    walls = np.linalg.norm(apart - ways[:, :, None] * along, axis=2).argmin(axis=1)
    way = ways[np.arange(len(places)), walls]
    bays: dict[tuple[int, int], list[int]] = {}
    for row, bay in enumerate(
        zip(walls.tolist(), (way // BAY_M).astype(int).tolist(), strict=True)
    ):
        bays.setdefault(bay, []).append(row)
    of_size: dict[int, list[tuple[int, int]]] = {}
    for bay, rows in bays.items():
        of_size.setdefault(len(rows), []).append(bay)
    descriptors = told.landmarks.descriptors.copy()
    for alike in of_size.values():
        order = rng.permutation(len(alike))
        for first, *copies in (order[i : i + COPIES] for i in range(0, len(order), COPIES)):
            originals = bays[alike[first]]
            for wall, number in (alike[copy] for copy in copies):
                rows = bays[wall, number]
                within = way[originals] % BAY_M + number * BAY_M
                places[rows, :2] = begins[wall] + within[:, None] * along[wall]
                places[rows, 2] = told.landmarks.positions[originals, 2]
                descriptors[rows] = descriptors[originals]
    return replace(told.landmarks, positions=places.astype(np.float32), descriptors=descriptors)


def _unknown(told: Told, names: tuple[str, ...]) -> Told:
    """The start poses of the robots `names` are unknown."""
    starts = zip(told.names, told.config.start_poses, strict=True)
    known: list[StartPose] = [UNKNOWN if name in names else start for name, start in starts]
    config = replace(told.config, start_poses=tuple(known))
    return replace(told, config=config, culprits=names)


def odometry_noise(factor: float, is_told: bool = False) -> Change:
    """The errors of all odometry are so many times what they were, and what is told unless so."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        def noisier(stamps: np.ndarray, moved: np.ndarray, true: np.ndarray) -> np.ndarray:
            errors = moved - true
            errors[:, 2] = wrap(errors[:, 2])
            return true + factor * errors

        noisy = _driven(told, told.names, noisier)
        if not is_told:
            return replace(noisy, factors=(factor, told.factors[1]))
        motion = _with_noise(told.config.filter.motion, factor)
        return replace(
            noisy, config=replace(told.config, filter=replace(told.config.filter, motion=motion))
        )

    return change


def odometry_biased(told: Told, rng: np.random.Generator) -> Told:
    """All odometry says 5 % more of distances, and 3 % less of turns."""
    return _driven(told, told.names, lambda stamps, moved, true: moved * (1.05, 1.05, 0.97))


def camera_noise(factor: float, is_told: bool = False) -> Change:
    """The errors of all observed positions are so many times what they were, likewise."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        def noisier(seen: ObservationSet, rows: np.ndarray) -> ObservationSet:
            true = _in_camera(told, seen, told.landmarks.positions[rows].astype(float))
            noisy = _at_points(told, seen, true + factor * (seen.positions - true))
            covariances = noisy.covariances * (factor**2 if is_told else 1.0)
            return replace(noisy, covariances=covariances)

        noisy = _seen(told, noisier)
        return noisy if is_told else replace(noisy, factors=(told.factors[0], factor))

    return change


def silent(told: Told, rng: np.random.Generator) -> Told:
    """Nothing that one robot sends in 30 s arrives."""
    name, (begins, ends) = _anyone(told, rng), _moments(told, rng, 30.0)
    kept = [e for e in told.events if e.robot != name or not begins < e.stamp_ns <= ends]
    return replace(
        told, events=tuple(kept), culprits=(name,), begins_ns=int(begins), known_ns=int(ends)
    )


def without_odometry(told: Told, rng: np.random.Generator) -> Told:
    """No odometry of one robot arrives for 5 s."""
    name, (begins, ends) = _anyone(told, rng), _moments(told, rng, 5.0)

    def is_missing(event: Event) -> bool:
        is_its = isinstance(event, PoseSample) and event.robot == name
        return is_its and begins < event.stamp_ns <= ends

    kept = tuple(event for event in told.events if not is_missing(event))
    return replace(told, events=kept, culprits=(name,), begins_ns=begins, known_ns=ends)


def lost(share: float) -> Change:
    """Each message is lost with this probability."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        arrives = rng.random(len(told.events)) >= share
        return replace(
            told, events=tuple(e for e, is_in in zip(told.events, arrives, strict=True) if is_in)
        )

    return change


def random_descriptors(share: float) -> Change:
    """Each observation has a descriptor of nothing with this probability."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        def wrong(seen: ObservationSet, rows: np.ndarray) -> ObservationSet:
            hit = rng.random(len(rows)) < share
            looks = np.abs(rng.standard_normal(seen.descriptors.shape))  # SIFT has no negative ones
            looks /= np.linalg.norm(looks, axis=1, keepdims=True)
            mixed = np.where(hit[:, None], looks, seen.descriptors).astype(np.float32)
            return replace(seen, descriptors=mixed)

        return _seen(told, wrong)

    return change


def random_positions(share: float) -> Change:
    """Each observation is somewhere in both pictures, at any depth, with this probability."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        camera, farthest_m = told.scenario.camera, told.scenario.d_max_m

        def wrong(seen: ObservationSet, rows: np.ndarray) -> ObservationSet:
            hit = rng.random(len(rows)) < share
            depths = rng.uniform(NEAREST_M, farthest_m, len(rows))
            disparities = camera.focal_px * camera.baseline_m / depths
            columns = rng.uniform(disparities, camera.width_px) - camera.centre_px[0]
            up = camera.centre_px[1] - rng.uniform(0, camera.height_px, len(rows))
            rays = np.column_stack([columns, up, np.full(len(rows), camera.focal_px)])
            points = rays / camera.focal_px * depths[:, None]
            return _at_points(told, seen, np.where(hit[:, None], points, seen.positions))

        return _seen(told, wrong)

    return change


def jittered(told: Told, rng: np.random.Generator) -> Told:
    """Stamps are off by milliseconds, messages arrive up to 0.1 s late, and 3 % of them twice.

    What one robot sends of one kind arrives in its order, as it does on a topic. A frame and the
    odometry of its instant are stamped alike.
    """
    stamps = {
        key: key[1] + round(rng.normal(0.0, 2e6))
        for key in dict.fromkeys((e.robot, e.stamp_ns) for e in told.events)
    }
    arrives_ns: dict[tuple[str, type], int] = {}
    arrivals: list[tuple[int, Event]] = []
    for event in told.events:
        stamped = replace(event, stamp_ns=stamps[event.robot, event.stamp_ns])
        stream = event.robot, type(event)
        arrives_ns[stream] = max(
            arrives_ns.get(stream, 0), event.stamp_ns + int(rng.uniform(0, 1e8))
        )
        for late_ns in (0, int(5e7))[: 1 + (rng.random() < 0.03)]:
            arrivals.append((arrives_ns[stream] + late_ns, stamped))
    arrivals.sort(key=lambda arrival: arrival[0])
    truth = {
        (robot, stamps.get((robot, stamp), stamp)): rows
        for (robot, stamp), rows in told.recorded.observation_truth.items()
    }
    recorded = replace(told.recorded, observation_truth=truth)
    return replace(told, events=tuple(event for _, event in arrivals), recorded=recorded)


def landmarks_moved(told: Told, rng: np.random.Generator) -> Told:
    """After a minute 30 landmarks, which are seen before and after, are 1 m away."""
    since = START_NS + int(MOVED_AFTER_S * 1e9)
    seen_in = [
        {
            int(r)
            for (_, s), rows in told.recorded.observation_truth.items()
            if (s > since) is after
            for r in rows
        }
        for after in (False, True)
    ]
    both = sorted(seen_in[0] & seen_in[1])
    rows = rng.choice(both, min(MOVED_LANDMARKS, len(both)), replace=False)
    directions = rng.uniform(-np.pi, np.pi, len(rows))
    places = told.landmarks.positions.astype(float)
    moved = places.copy()
    moved[rows, :2] += MOVED_M * np.column_stack([np.cos(directions), np.sin(directions)])

    def shifted(seen: ObservationSet, own: np.ndarray) -> ObservationSet:
        if seen.stamp_ns <= since or not np.isin(own, rows).any():
            return seen
        by = _in_camera(told, seen, moved[own]) - _in_camera(told, seen, places[own])
        return _at_points(told, seen, seen.positions + by)

    landmarks = replace(told.landmarks, positions=moved.astype(np.float32))
    result = _seen(told, shifted)
    return replace(
        result,
        recorded=replace(result.recorded, true_landmarks=landmarks),
        begins_ns=since,
        known_ns=since,
        old_places={int(row): places[row] for row in rows},
    )


def fusion_late(seconds: float) -> Change:
    """The fusion does not hear what is sent in the first seconds."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        return _from(told, START_NS + int(seconds * 1e9))

    return change


def robot_late(seconds: float) -> Change:
    """One robot is not heard in the first seconds, in which it drives."""

    def change(told: Told, rng: np.random.Generator) -> Told:
        name, since_ns = _anyone(told, rng), START_NS + int(seconds * 1e9)
        return replace(_from(told, since_ns, (name,)), culprits=(name,), known_ns=since_ns)

    return change


def fusion_restarted(told: Told, rng: np.random.Generator) -> Told:
    """In mid-run the fusion is started anew. What it said before is not judged, and left out."""
    return _from(told, _moments(told, rng, 0.0)[0])


def fusion_killed(told: Told, rng: np.random.Generator) -> Told:
    """In mid-run the fusion is killed, and goes on from a state that was saved before.

    It then does what it would have done if it had heard nothing since that state, to the byte.
    """
    begins, ends = _moments(told, rng, rng.uniform(0, AUTOSAVE_S) + BACK_AFTER_S)
    kept = tuple(e for e in told.events if not begins < e.stamp_ns <= ends)
    return replace(told, events=kept, culprits=told.names, begins_ns=begins, known_ns=ends)


def robot_restarted(told: Told, rng: np.random.Generator) -> Told:
    """The odometry of one robot starts again from zero in mid-run."""
    name, (begins, _) = _anyone(told, rng), _moments(told, rng, 0.0)
    origin = at(told.recorded.odometry[name], np.array([begins]))[0]

    def again(event: Event) -> Event:
        if event.robot != name or event.stamp_ns < begins or not isinstance(event, PoseSample):
            return event
        return replace(event, pose=increment(origin, event.pose))

    return replace(
        told,
        events=tuple(map(again, told.events)),
        culprits=(name,),
        begins_ns=begins,
        known_ns=begins,
    )


def slipped(told: Told, rng: np.random.Generator) -> Told:
    """Within a second one robot slips 1 m and turns 30 degrees, and its odometry does not tell."""
    name, (begins, ends) = _anyone(told, rng), _moments(told, rng, SLIP_S)
    direction, side = rng.uniform(-np.pi, np.pi), rng.choice([-1, 1])
    slip = np.array([np.cos(direction), np.sin(direction), side * np.radians(30.0)])

    def untold(stamps: np.ndarray, moved: np.ndarray, true: np.ndarray) -> np.ndarray:
        during = (stamps > begins) & (stamps <= ends)
        moved[during] -= slip / max(1, during.sum())
        return moved

    changed = _driven(told, (name,), untold)
    return replace(changed, culprits=(name,), begins_ns=begins, known_ns=ends)


def carried(told: Told, rng: np.random.Generator) -> Told:
    """One robot is carried 5 to 15 m along its way: wheels stand still, its camera is covered."""
    name, (begins, _) = _anyone(told, rng), _moments(told, rng, 25.0)
    truth, distance_m = told.recorded.truth[name], rng.uniform(5.0, 15.0)
    away = np.hypot(*(truth.poses[:, :2] - at(truth, np.array([begins]))[0, :2]).T)
    away[truth.stamps_ns <= begins] = 0.0
    ends = int(truth.stamps_ns[np.argmax(away >= min(distance_m, away.max()))])

    def unmoved(stamps: np.ndarray, moved: np.ndarray, true: np.ndarray) -> np.ndarray:
        moved[(stamps > begins) & (stamps <= ends)] = 0.0
        return moved

    def is_covered(event: Event) -> bool:
        is_its = isinstance(event, ObservationSet) and event.robot == name
        return is_its and begins < event.stamp_ns <= ends

    changed = _driven(told, (name,), unmoved)
    kept = tuple(event for event in changed.events if not is_covered(event))
    return replace(changed, events=kept, culprits=(name,), begins_ns=begins, known_ns=ends)


def _anyone(told: Told, rng: np.random.Generator) -> str:
    return told.names[rng.integers(len(told.names))]


def _moments(told: Told, rng: np.random.Generator, lasts_s: float) -> tuple[int, int]:
    """Beginning and end [ns] of what lasts so long: it begins in the middle third of the rest."""
    spare_ns = told.end_ns - START_NS - int(lasts_s * 1e9)
    begins = START_NS + int(spare_ns * rng.uniform(1 / 3, 2 / 3))
    return begins, begins + int(lasts_s * 1e9)


def _from(told: Told, since_ns: int, names: Sequence[str] | None = None) -> Told:
    """The robots `names` (all) are heard from `since_ns` on."""
    names = told.names if names is None else names
    kept = tuple(e for e in told.events if e.robot not in names or e.stamp_ns >= since_ns)
    return replace(told, events=kept, culprits=tuple(names), begins_ns=since_ns)


def _with_noise(motion: MotionSettings, factor: float) -> MotionSettings:
    """Standard deviations times `factor`."""
    names = {f.name for f in fields(motion)} - {"scale_sigma"}
    return replace(motion, **{name: factor * getattr(motion, name) for name in names})


def _tuples(starts: Sequence[np.ndarray]) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(x), float(y), float(wrap(yaw))) for x, y, yaw in starts)


def _driven(
    told: Told,
    names: Sequence[str],
    change: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
) -> Told:
    """With other odometry of the robots `names`.

    `change` takes the stamps (n,) at which movements end, these (n, 3) as measured, and as they
    truly were; it returns those that are told.
    """
    told_poses: dict[tuple[str, int], np.ndarray] = {}
    odometry = dict(told.recorded.odometry)
    for name in names:
        path, truth = odometry[name], told.recorded.truth[name]
        true = _movements(at(truth, path.stamps_ns))
        moved = change(path.stamps_ns[1:], _movements(path.poses), true)
        odometry[name] = Trajectory(path.stamps_ns, _composed(path.poses[0], moved))
        keys = [(name, stamp) for stamp in path.stamps_ns.tolist()]
        told_poses |= zip(keys, odometry[name].poses, strict=True)

    def again(event: Event) -> Event:
        key = event.robot, event.stamp_ns
        if isinstance(event, PoseSample) and key in told_poses:
            return replace(event, pose=told_poses[key])
        return event

    recorded = replace(told.recorded, odometry=odometry)
    return replace(told, events=tuple(map(again, told.events)), recorded=recorded)


def _movements(poses: np.ndarray) -> np.ndarray:
    """(n, 3) poses -> (n - 1, 3): each seen from the one before."""
    dx, dy, dyaw = np.diff(poses, axis=0).T
    cos, sin = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    return np.column_stack([cos * dx + sin * dy, cos * dy - sin * dx, wrap(dyaw)])


def _composed(first: np.ndarray, movements: np.ndarray) -> np.ndarray:
    """(n + 1, 3) poses from `first` (3,) on; the inverse of `_movements`."""
    yaws = first[2] + np.concatenate([[0.0], np.cumsum(movements[:, 2])])
    cos, sin = np.cos(yaws[:-1]), np.sin(yaws[:-1])
    dx, dy = movements[:, 0], movements[:, 1]
    steps = np.column_stack([cos * dx - sin * dy, sin * dx + cos * dy])
    places = first[:2] + np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    return np.column_stack([places, wrap(yaws)])


def _seen(told: Told, change: Callable[[ObservationSet, np.ndarray], ObservationSet]) -> Told:
    """With other observations; those that come too near the camera are not made.

    `change` takes a frame and the true landmark of each observation.
    """
    truth = told.recorded.observation_truth
    events = tuple(
        change(e, truth[e.robot, e.stamp_ns]) if isinstance(e, ObservationSet) else e
        for e in told.events
    )
    changed = replace(told, events=events)
    return _only_seen(changed, lambda seen, rows: seen.positions[:, 2] > MIN_DEPTH_M)


def _only_seen(told: Told, which: Callable[[ObservationSet, np.ndarray], np.ndarray]) -> Told:
    """With some observations alone: `which` (B,) of a frame, given the true landmark of each."""
    events, truth = [], dict(told.recorded.observation_truth)
    for event in told.events:
        if isinstance(event, ObservationSet):
            key = event.robot, event.stamp_ns
            stays = which(event, truth[key])
            if not stays.all():
                event, truth[key] = _only(event, stays), truth[key][stays]
        events.append(event)
    recorded = replace(told.recorded, observation_truth=truth)
    return replace(told, events=tuple(events), recorded=recorded)


def _only(seen: ObservationSet, rows: np.ndarray) -> ObservationSet:
    return replace(
        seen,
        positions=seen.positions[rows],
        covariances=seen.covariances[rows],
        descriptors=seen.descriptors[rows],
    )


def _in_camera(told: Told, seen: ObservationSet, places: np.ndarray) -> np.ndarray:
    """(B, 3) `places` in `map` as the camera has them at the frame's true pose."""
    pose = at(told.recorded.truth[seen.robot], np.array([seen.stamp_ns]))[0]
    return stereo.camera_from_map(places, pose, told.scenario.camera.mount)


def _at_points(told: Told, seen: ObservationSet, points: np.ndarray) -> ObservationSet:
    """The frame with its observations at `points` (B, 3), and as sure of them as a camera is."""
    camera, measured = told.scenario.camera, points.astype(np.float32)
    covariances = np.zeros((len(points), 6), np.float32)
    pixels = stereo.project(measured.astype(float), camera)
    covariances[:, [0, 3, 5]] = stereo.variances(pixels, camera)
    return replace(seen, positions=measured, covariances=covariances)
