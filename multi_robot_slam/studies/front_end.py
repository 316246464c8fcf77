"""How good the front end's landmarks are: against recordings with truth, and against the clock.

A `View` is what one pair showed, and where its camera truly was. Two views of one place tell how
exact landmarks are (`landmark_nees`), how well descriptors find them again (`revisited`,
`descriptor_spread`), and how well one pose follows from another (`pose_errors`, `odometry_drift`).
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from multi_robot_slam.datasets.stereo_recording import StereoPairs, StereoRecording
from multi_robot_slam.front_end.front_end import FrontEnd, Seen
from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.front_end.settings import DESCRIPTOR_GATE, CameraSettings
from multi_robot_slam.models.symmetric import inverses, pack, unpack

GATE = 11.345
"""D_0: 99 % of chi-squared with three degrees of freedom."""

OPTICAL_TO_CAMERA = np.diag([1.0, -1.0, 1.0])
"""From x right, y down, z forward to the paper's X right, Y up, Z forward; its own inverse."""


@dataclass(frozen=True)
class PoseSigma:
    """Standard deviation of a pose, in each direction and about each axis."""

    place_m: float = 0.0
    angle_rad: float = 0.0


EUROC_TRUTH = PoseSigma(0.006, 0.0022)
KITTI_TRUTH = PoseSigma(0.015, 0.0006)
"""How far the two recordings' truth is off for one frame: what is left between the true motion of
two frames and the one fitted to their several hundred common points, over the root of two."""

AT_A_LOOP = PoseSigma(0.03, 0.006)
"""How well a robot knows its pose when it comes back."""

SAME_SIZE = 1.3
"""Largest ratio of the sizes of one keypoint; beyond it E is hardly ever small."""

ONE_PLACE = 16.27
"""D up to which two observations of one landmark are told from two landmarks: 99.9 %."""


@dataclass(frozen=True, eq=False)
class View:
    """What one pair showed, and where it was taken."""

    stamp_s: float
    seen: Seen
    place: np.ndarray
    """(3,) [m]: of the rectified left camera, in `map`."""
    rotation: np.ndarray
    """(3, 3): from the camera (X right, Y up, Z forward) to `map`."""

    def to(self, other: View, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) of this camera as the other one has them."""
        return (points @ self.rotation.T + self.place - other.place) @ other.rotation


def rig_of(pairs: StereoPairs) -> StereoRig:
    """The geometry of a recording's camera."""
    return StereoRig.of(*pairs.calibration, rectify=not pairs.is_rectified)


def views(recording: StereoRecording, settings: CameraSettings) -> Iterator[View]:
    """Each pair of `recording` through the front end."""
    front_end = FrontEnd(rig_of(recording), settings)
    truth = recording.truth.at(recording.stamps_ns)
    for row, stamp in enumerate(recording.stamps_ns.tolist()):
        yield View(
            stamp_s=stamp * 1e-9,
            seen=front_end.observe(*recording.images(row)),
            place=truth.places[row],
            rotation=truth.rotations[row] @ OPTICAL_TO_CAMERA,
        )


OVERLAP = 0.5
"""Share of the points of either view that the other one must have in sight."""

LARGEST_TURN = np.radians(30)
"""Between the two optical axes: SIFT does not find again what is seen from another side."""


def overlapping(views: Sequence[View], rig: StereoRig, apart_s: float) -> list[tuple[View, View]]:
    """Pairs of views of one place, at least `apart_s` apart."""
    return [
        (first, second)
        for first, second in combinations(views, 2)
        if second.stamp_s - first.stamp_s >= apart_s
        and first.rotation[:, 2] @ second.rotation[:, 2] >= np.cos(LARGEST_TURN)
        and min(_in_sight(first, second, rig), _in_sight(second, first, rig)) >= OVERLAP
    ]


def _in_sight(view: View, other: View, rig: StereoRig) -> float:
    """Share of the points of `view` that project into `other`."""
    points = view.to(other, view.seen.positions)
    ahead = points[points[:, 2] > 0]
    column, row, _ = rig.pixel(ahead).T
    inside = (column >= 0) & (column < rig.width_px) & (row >= 0) & (row < rig.height_px)
    return float(inside.sum() / max(len(points), 1))


@dataclass(frozen=True, eq=False)
class Compared:
    """Every point of one view against every one of another."""

    mahalanobis_sq: np.ndarray
    """(A, B): D of the difference, against both covariances and that of the poses."""
    descriptor_sq: np.ndarray
    """(A, B): E (19)."""
    size_ratio: np.ndarray
    """(A, B): of the larger keypoint to the smaller one, in metres."""

    @property
    def same(self) -> np.ndarray:
        """(A, B) bool: the two are one keypoint.

        They are nearest to each other and within the gate, and of one size: a corner of a poster
        and the poster are two keypoints at one place.
        """
        nearest = self.mahalanobis_sq <= self.mahalanobis_sq.min(axis=1, keepdims=True)
        nearest &= self.mahalanobis_sq <= self.mahalanobis_sq.min(axis=0, keepdims=True)
        return nearest & (self.mahalanobis_sq <= GATE) & (self.size_ratio <= SAME_SIZE)


def compared(first: View, second: View, poses: PoseSigma) -> Compared:
    """Every point of `first`, where `second` should see it, against every one that it saw."""
    points = first.to(second, first.seen.positions.astype(float))
    turn = second.rotation.T @ first.rotation
    of_first = turn @ unpack(first.seen.covariances) @ turn.T + _of_poses(points, poses)
    total = of_first[:, None] + unpack(second.seen.covariances)[None]
    difference = second.seen.positions[None] - points[:, None]
    sizes = [view.seen.sizes / view.seen.pixels[:, 2] for view in (first, second)]
    ratio = np.log(sizes[0])[:, None] - np.log(sizes[1])
    information = unpack(inverses(pack(total).reshape(-1, 6))).reshape(total.shape)
    return Compared(
        mahalanobis_sq=np.einsum("abi,abij,abj->ab", difference, information, difference),
        descriptor_sq=np.maximum(2 - 2 * first.seen.descriptors @ second.seen.descriptors.T, 0),
        size_ratio=np.exp(np.abs(ratio)),
    )


def _of_poses(points: np.ndarray, poses: PoseSigma) -> np.ndarray:
    """Covariance (n, 3, 3) that two poses in error give to `points` (n, 3) of one in the other."""
    squares = (points**2).sum(axis=1)[:, None, None] * np.eye(3)
    lever = squares - points[:, :, None] * points[:, None, :]
    return 2 * (poses.place_m**2 * np.eye(3) + poses.angle_rad**2 * lever)


def matches(compared: Compared, gate: float, within: float = np.inf) -> np.ndarray:
    """(k, 2) rows of first and second that match as in the filter.

    Of the points of `first` with D <= `within`, each of `second` takes the one with the smallest E,
    if that is at most `gate`; what two of them take is the better one's.
    """
    distances = np.where(compared.mahalanobis_sq <= within, compared.descriptor_sq, np.inf)
    if not distances.size:
        return np.empty((0, 2), int)
    first = distances.argmin(axis=0)
    second = np.arange(len(first))
    is_match = (distances[first, second] <= gate) & (distances.argmin(axis=1)[first] == second)
    return np.column_stack([first, second])[is_match]


# --- landmarks against truth ---------------------------------------------------------------------


@dataclass(frozen=True)
class Consistency:
    """Squared Mahalanobis distances of landmarks that were seen twice."""

    count: int
    beyond: float
    """Share beyond the 99 % quantile."""
    mean: float
    """Of those within it; 2.89 if errors are as Gaussian as their covariances say."""
    median: float
    """Of all; 2.37 likewise."""

    @classmethod
    def of(cls, values: np.ndarray) -> Consistency:
        """Of D (n,)."""
        inside = values <= GATE
        return cls(
            len(values), float(1 - inside.mean()), float(values[inside].mean()),
            float(np.median(values)),
        )  # fmt: skip


GROSS = 100.0
"""D beyond which two points that look alike are different ones: ten standard deviations."""


def landmark_nees(
    pairs: Iterable[tuple[View, View]], gate: float, truth: PoseSigma = PoseSigma()
) -> np.ndarray:
    """D (n,) of all points that match between two views, but those that are grossly wrong.

    Matches are the best in both directions, with E <= `gate`. `truth` is how exact the poses are.
    """
    values = [np.empty(0)]
    for first, second in pairs:
        both = compared(first, second, truth)
        found = both.mahalanobis_sq[*matches(both, gate).T]
        values.append(found[found <= GROSS])
    return np.concatenate(values)


# --- descriptors ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Association:
    """What becomes of points that are seen again."""

    matched: int
    right: int
    again: int
    """Points that the other view has, too."""

    @property
    def precision(self) -> float:
        """Share of the matches that are one place."""
        return self.right / max(self.matched, 1)

    @property
    def recall(self) -> float:
        """Share of the points seen again that are matched, and rightly."""
        return self.right / max(self.again, 1)


def revisited(
    pairs: Iterable[tuple[View, View]],
    gate: float,
    truth: PoseSigma = PoseSigma(),
    pose: PoseSigma = AT_A_LOOP,
) -> Association:
    """Association of the points of two views as in the filter, whose pose is as good as `pose`.

    A point is seen again where the other view has an observation of the same place: nearest to each
    other by the true poses, and within D_0. Whether a match is right is judged by the same gate.
    """
    matched = right = again = 0
    for first, second in pairs:
        exact = compared(first, second, truth)
        found = matches(compared(first, second, pose), gate, within=GATE)
        is_right = exact.mahalanobis_sq[*found.T] <= ONE_PLACE
        matched += len(found)
        right += int(is_right.sum())
        again += int(exact.same.sum())
    return Association(matched, right, again)


@dataclass(frozen=True, eq=False)
class DescriptorSpread:
    """Squared distances E (19) of descriptors."""

    equal: np.ndarray
    """(n,): between two observations of one place."""
    different: np.ndarray
    """(m,): between observations of two places, each with the most similar of the other view."""

    def gate(self, wrong: float = 0.01) -> float:
        """E_0: as large as possible, with `wrong` of the matches within it wrong at most.

        As if every observation had one other landmark to choose: the most similar of all that the
        other view shows, which is the worst case.
        """
        levels = np.sort(np.concatenate([self.equal, self.different]))
        right = np.searchsorted(np.sort(self.equal), levels, side="right")
        false = np.searchsorted(np.sort(self.different), levels, side="right")
        good = np.flatnonzero(false <= wrong * (right + false))
        return float(levels[good[-1]]) if len(good) else 0.0


def descriptor_spread(
    pairs: Iterable[tuple[View, View]],
    truth: PoseSigma = PoseSigma(),
    pose: PoseSigma = AT_A_LOOP,
) -> DescriptorSpread:
    """E between equal and between different landmarks of pairs of views.

    Different ones are those that the filter would have to choose from: within its gate if its pose
    is as good as `pose`, but not within that of the true poses.
    """
    equal, different = [np.empty(0)], [np.empty(0)]
    for first, second in pairs:
        exact, loose = compared(first, second, truth), compared(first, second, pose)
        equal.append(exact.descriptor_sq[exact.same])
        is_other = (loose.mahalanobis_sq <= GATE) & (exact.mahalanobis_sq > ONE_PLACE)
        if is_other.size:
            nearest = np.where(is_other, exact.descriptor_sq, np.inf).min(axis=0)
            different.append(nearest[np.isfinite(nearest)])
    return DescriptorSpread(np.concatenate(equal), np.concatenate(different))


# --- poses ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Motion:
    """From one camera to another: a point x of the first is R x + t in the second."""

    rotation: np.ndarray
    """R (3, 3)."""
    shift: np.ndarray
    """t (3,) [m]."""
    inliers: int

    @classmethod
    def between(cls, first: View, second: View) -> Motion:
        """The true one."""
        turn = second.rotation.T @ first.rotation
        return cls(turn, second.rotation.T @ (first.place - second.place), 0)

    def error(self, truth: Motion) -> tuple[float, float]:
        """Distance [m] and angle [rad] between the two."""
        turn = Rotation.from_matrix(self.rotation @ truth.rotation.T)
        where = self.rotation.T @ self.shift - truth.rotation.T @ truth.shift
        return float(np.linalg.norm(where)), float(turn.magnitude())


TRIALS = 300
"""Triples of points that a motion is tried on."""

LEAST_INLIERS = 12

CLOSE_PX = np.array([4.0, 4.0, 2.0])
"""Column, row and disparity of a point that agrees with a motion of three others."""

HUBER = 2.0
"""Standard deviations from which on a point's weight falls."""


def estimated_motion(
    first: View, second: View, rig: StereoRig, ratio: float = 0.8
) -> Motion | None:
    """From the descriptors, positions and covariances of two views alone; None: too few agree.

    Matches are the best both ways and better than the second best by `ratio`. The best of a few
    hundred motions of three points each is refined by least squares in pixels of the second view.
    """
    rows = _unambiguous(first.seen, second.seen, ratio)
    if len(rows) < LEAST_INLIERS:
        return None
    source = first.seen.positions[rows[:, 0]].astype(float)
    target = second.seen.pixels[rows[:, 1]]
    motion = _sampled(source, target, rig)
    if motion.inliers < LEAST_INLIERS:
        return None
    of_source = unpack(first.seen.covariances)[rows[:, 0]]
    of_target = _pixel_covariances(second.seen, rig)[rows[:, 1]]
    for _ in range(8):
        motion = _refined(motion, source, of_source, target, of_target, rig)
    return motion if motion.inliers >= LEAST_INLIERS else None


def _unambiguous(first: Seen, second: Seen, ratio: float) -> np.ndarray:
    """(k, 2) rows of the two whose descriptors are best in both directions, and without a rival."""
    if len(first.descriptors) < 2 or len(second.descriptors) < 2:
        return np.empty((0, 2), int)
    distances = np.maximum(2 - 2 * first.descriptors @ second.descriptors.T, 0)
    best = distances.argmin(axis=1)
    two = np.partition(distances, 1, axis=1)
    good = (two[:, 0] < ratio**2 * two[:, 1]) & (
        distances.argmin(axis=0)[best] == np.arange(len(best))
    )
    return np.column_stack([np.arange(len(best)), best])[good]


def _pixel_covariances(seen: Seen, rig: StereoRig) -> np.ndarray:
    """(B, 3, 3): of column, row and disparity [px^2]."""
    slope = _pixel_slope(seen.positions.astype(float), rig)
    return slope @ unpack(seen.covariances) @ np.swapaxes(slope, 1, 2)


def _pixel_slope(points: np.ndarray, rig: StereoRig) -> np.ndarray:
    """d(column, row, disparity) / d(X, Y, Z) at `points` (n, 3): (n, 3, 3) [px / m]."""
    x, y, z = points.T
    slope = np.zeros((len(points), 3, 3))
    slope[:, 0, 0], slope[:, 0, 2] = rig.focal_px / z, -rig.focal_px * x / z**2
    slope[:, 1, 1], slope[:, 1, 2] = -rig.focal_px / z, rig.focal_px * y / z**2
    slope[:, 2, 2] = -rig.focal_px * rig.baseline_m / z**2
    return slope


def _sampled(source: np.ndarray, target: np.ndarray, rig: StereoRig) -> Motion:
    """The best of many motions of three points each; the same of the same points."""
    places = rig.point(*target.T)
    random = np.random.default_rng(0)
    three = random.random((TRIALS, len(source))).argpartition(3, axis=1)[:, :3]
    turns, shifts = _rigid(source[three], places[three])
    moved = source @ np.swapaxes(turns, 1, 2) + shifts[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        error = target - rig.pixel(moved)
    inside = ((np.abs(error) < CLOSE_PX).all(axis=2) & (moved[..., 2] > 0)).sum(axis=1)
    best = int(inside.argmax())
    return Motion(turns[best], shifts[best], int(inside[best]))


def _rigid(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R (T, 3, 3), t (T, 3) that bring `source` (T, n, 3) closest to `target`, without scale."""
    middle, end = source.mean(axis=1, keepdims=True), target.mean(axis=1, keepdims=True)
    left, _, right = np.linalg.svd(np.swapaxes(target - end, 1, 2) @ (source - middle))
    signs = np.ones((len(source), 1, 3))
    signs[:, 0, 2] = np.linalg.det(left @ right)
    turn = left * signs @ right
    return turn, (end - middle @ np.swapaxes(turn, 1, 2))[:, 0]


def _refined(
    motion: Motion,
    source: np.ndarray,
    of_source: np.ndarray,
    target: np.ndarray,
    of_target: np.ndarray,
    rig: StereoRig,
) -> Motion:
    """One step of weighted least squares, with Huber's weights; points beyond ten sigmas out."""
    moved = source @ motion.rotation.T + motion.shift
    ahead = moved[:, 2] > 0.05
    moved, turn = moved[ahead], motion.rotation
    slope = _pixel_slope(moved, rig)
    lever = slope @ turn
    total = of_target[ahead] + lever @ of_source[ahead] @ np.swapaxes(lever, 1, 2)
    error = target[ahead] - rig.pixel(moved)
    information = np.linalg.inv(total)
    distance = np.sqrt(np.einsum("ni,nij,nj->n", error, information, error))
    weight = np.where(distance < 10, HUBER / np.maximum(distance, HUBER), 0)
    cross = np.cross(np.eye(3)[None], moved[:, None])  # rows: e_i x p
    by_pose = np.concatenate([slope @ np.swapaxes(cross, 1, 2), slope], axis=2)
    weighted = np.swapaxes(by_pose, 1, 2) @ information * weight[:, None, None]
    normal = (weighted @ by_pose).sum(axis=0) + 1e-9 * np.eye(6)
    step = np.linalg.solve(normal, (weighted @ error[..., None]).sum(axis=0)[:, 0])
    small = Rotation.from_rotvec(step[:3]).as_matrix()
    inside = int((distance**2 <= GATE).sum())
    return Motion(small @ turn, small @ motion.shift + step[3:], inside)


def pose_errors(pairs: Iterable[tuple[View, View]], rig: StereoRig) -> np.ndarray:
    """(n, 2): distance [m] and angle [rad] of the estimated motions from the true ones.

    A pair without an estimate is left out.
    """
    errors = []
    for first, second in pairs:
        motion = estimated_motion(first, second, rig)
        if motion is not None:
            errors.append(motion.error(Motion.between(first, second)))
    return np.array(errors).reshape(-1, 2)


@dataclass(frozen=True)
class Drift:
    """Where odometry from pair to pair ends."""

    distance_m: float
    """Length of the true path."""
    place_m: float
    """Distance of the last place from the true one."""
    angle_rad: float
    lost: int
    """Steps without an estimate, for which the last one was repeated."""

    @property
    def percent(self) -> float:
        """Of the way."""
        return 100 * self.place_m / self.distance_m


def odometry_drift(views: Sequence[View], rig: StereoRig) -> Drift:
    """Chain the motions from each view to the next, from the true pose of the first one."""
    rotation, place = views[0].rotation, views[0].place
    last, lost = Motion(np.eye(3), np.zeros(3), 0), 0
    for first, second in pairwise(views):
        motion = estimated_motion(first, second, rig)
        lost += motion is None
        last = motion or last
        rotation = rotation @ last.rotation.T
        place = place - rotation @ last.shift
    way = sum(float(np.linalg.norm(b.place - a.place)) for a, b in pairwise(views))
    turn = Rotation.from_matrix(views[-1].rotation.T @ rotation)
    where = float(np.linalg.norm(place - views[-1].place))
    return Drift(way, where, float(turn.magnitude()), lost)


# --- time ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Timing:
    """Medians, on one thread [ms]."""

    pair_ms: float
    """The front end, rectification included."""
    sift_ms: float
    """OpenCV's SIFT on the left image alone, at the same scale."""


def timing(pairs: StereoPairs, settings: CameraSettings, rounds: int = 3) -> Timing:
    """How long a pair takes beside SIFT alone: one after the other, in the time of the thread."""
    front_end = FrontEnd(rig_of(pairs), settings)
    features = settings.features
    sift = cv2.SIFT.create(
        nfeatures=features.features, contrastThreshold=features.contrast_threshold
    )
    images = [pairs.images(row) for row in range(len(pairs))]
    small = [cv2.resize(left, None, fx=features.scale, fy=features.scale) for left, _ in images]
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        front_end.observe(*images[0])
        taken = []
        for _ in range(rounds):
            for pair, left in zip(images, small, strict=True):
                stamps = [time.thread_time()]
                front_end.observe(*pair)
                stamps.append(time.thread_time())
                sift.detectAndCompute(left, None)
                stamps.append(time.thread_time())
                taken.append(np.diff(stamps))
    finally:
        cv2.setNumThreads(threads)
    pair_ms, sift_ms = 1e3 * np.median(taken, axis=0)
    return Timing(float(pair_ms), float(sift_ms))


# --- all of it -----------------------------------------------------------------------------------

LOOP_S = 20.0
"""Views of one place so far apart in time are a revisit."""


def figures(seen: Sequence[View], rig: StereoRig, truth: PoseSigma) -> dict[str, float]:
    """All figures of one recording's views, by name; those of revisits only where it has some.

    `truth` is how exact the recording's poses are: `EUROC_TRUTH`, `KITTI_TRUTH`.
    """
    pairs = overlapping(seen, rig, 0.0)
    late = [pair for pair in pairs if pair[1].stamp_s - pair[0].stamp_s >= LOOP_S]
    as_is = Consistency.of(landmark_nees(pairs, DESCRIPTOR_GATE))
    told = Consistency.of(landmark_nees(pairs, DESCRIPTOR_GATE, truth))
    drift = odometry_drift(seen, rig)
    found = {
        "points": float(np.mean([view.seen.counts.kept for view in seen])),
        "pairs of views": len(pairs),
        "landmark NEES within the gate": as_is.mean,
        "beyond the gate": as_is.beyond,
        "landmark NEES, truth's errors counted": told.mean,
        "beyond the gate, truth's errors counted": told.beyond,
        "drift [%]": drift.percent,
        "drift [deg]": float(np.degrees(drift.angle_rad)),
        "steps lost": drift.lost,
    }
    return found | (_of_revisits(late, rig, truth) if late else {})


def _of_revisits(
    pairs: Sequence[tuple[View, View]], rig: StereoRig, truth: PoseSigma
) -> dict[str, float]:
    """What concerns views that are long apart."""
    again, spread = revisited(pairs, DESCRIPTOR_GATE, truth), descriptor_spread(pairs, truth)
    errors = pose_errors(pairs, rig)
    place, angle = np.median(errors, axis=0) if len(errors) else (np.nan, np.nan)
    return {
        "revisits": len(pairs),
        "precision": again.precision,
        "recall": again.recall,
        "E of equal, median": float(np.median(spread.equal)),
        "E of different, first percentile": float(np.quantile(spread.different, 0.01)),
        "descriptor_gate": spread.gate(),
        "poses": len(errors),
        "pose, median [m]": float(place),
        "pose, median [deg]": float(np.degrees(angle)),
    }
