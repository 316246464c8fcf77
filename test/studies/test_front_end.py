"""What is said of the front end: on made-up views, whose errors are known, and on real ones."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from multi_robot_slam.datasets import euroc, kitti
from multi_robot_slam.front_end.covariance import propagated
from multi_robot_slam.front_end.front_end import FrontEnd
from multi_robot_slam.front_end.rig import StereoRig
from multi_robot_slam.front_end.settings import DESCRIPTOR_GATE, CameraSettings, FeatureSettings
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.studies import front_end as study

RIG = StereoRig(400.0, (320.0, 240.0), 0.12, 640, 480)
SIGMAS = np.array([0.5, 0.5, 0.1])
BLACK = np.zeros((RIG.height_px, RIG.width_px), np.uint8)
NOTHING = FrontEnd(RIG, CameraSettings()).observe(BLACK, BLACK)


def unit(rows):
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def scene(count=300, seed=0):
    """Points (n, 3) ahead, and a descriptor (n, 128) for each."""
    random = np.random.default_rng(seed)
    points = random.uniform([-3, -2, 2], [3, 2, 6], (count, 3))
    return points, unit(random.uniform(0, 1, (count, 128)) ** 4)


def view(points, looks, stamp_s=0.0, place=(0, 0, 0), turn=(0, 0, 0), seed=0, noise=1.0):
    """What a camera sees of them, with noise of `SIGMAS`; descriptors are never twice the same."""
    random = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(turn).as_matrix()
    pixels = RIG.pixel((points - np.asarray(place)) @ rotation)
    inside = (pixels[:, :2] > 0).all(axis=1) & (pixels[:, :2] < [640, 480]).all(axis=1)
    pixels = pixels[inside] + noise * SIGMAS * random.normal(size=(inside.sum(), 3))
    seen = replace(
        NOTHING,
        positions=RIG.point(*pixels.T).astype(np.float32),
        covariances=propagated(RIG, pixels, np.tile(SIGMAS, (len(pixels), 1))).astype(np.float32),
        descriptors=unit(looks[inside] + 0.01 * random.normal(size=(inside.sum(), 128))),
        pixels=pixels,
        sizes=pixels[:, 2] / 5,
    )
    return study.View(stamp_s, seen, np.asarray(place, float), rotation)


def two(seed=0, noise=1.0):
    points, looks = scene(seed=seed)
    first = view(points, looks, seed=seed, noise=noise)
    place, turn = (0.3, -0.1, 0.4), (0.02, -0.1, 0.03)
    return first, view(points, looks, 30.0, place, turn, seed + 100, noise)


def test_landmarks_as_exact_as_they_say_have_a_nees_of_three():
    values = study.landmark_nees((two(seed) for seed in range(12)), gate=0.5)
    found = study.Consistency.of(values)
    assert found.count > 1000
    assert found.mean == pytest.approx(2.89, abs=0.2)
    assert found.median == pytest.approx(2.37, abs=0.2)
    assert found.beyond < 0.025


def test_a_truth_in_error_is_counted_where_it_is_told():
    first, second = two(noise=0.0)
    off = replace(second, place=second.place + np.array([0.02, 0, 0]))
    told = study.landmark_nees([(first, off)], 0.5, study.PoseSigma(place_m=0.02))
    assert told.mean() < 0.7 * study.landmark_nees([(first, off)], 0.5).mean()


def test_comparing_is_the_slow_formula():
    first, second = two()
    poses = study.PoseSigma(0.03, 0.01)
    both = study.compared(first, second, poses)
    turn = second.rotation.T @ first.rotation
    for a, b in [(0, 0), (3, 7), (20, 5)]:
        x = turn @ first.seen.positions[a] + second.rotation.T @ (first.place - second.place)
        cross = np.cross(np.eye(3), x)
        total = turn @ unpack(first.seen.covariances[a]) @ turn.T
        total = total + unpack(second.seen.covariances[b])
        total += 2 * (0.03**2 * np.eye(3) + 0.01**2 * cross.T @ cross)
        error = second.seen.positions[b] - x
        exact = error @ np.linalg.solve(total, error)
        assert both.mahalanobis_sq[a, b] == pytest.approx(exact, rel=1e-4)
        difference = first.seen.descriptors[a] - second.seen.descriptors[b]
        assert both.descriptor_sq[a, b] == pytest.approx(difference @ difference, abs=1e-5)


def test_points_that_look_different_are_all_found_again():
    found = study.revisited([two()], gate=0.2)
    assert found.again > 100
    assert found.precision > 0.99  # one error in a thousand is larger than ONE_PLACE
    assert found.recall > 0.97
    assert study.revisited([two()], gate=0.0).matched == 0


def test_keypoints_of_two_sizes_at_one_place_are_not_one():
    first, second = two()
    assert study.compared(first, second, study.PoseSigma()).same.any()
    larger = replace(second, seen=replace(second.seen, sizes=2 * second.seen.sizes))
    assert not study.compared(first, larger, study.PoseSigma()).same.any()


def test_points_that_look_alike_are_taken_for_each_other():
    """Within what the pose leaves open; with a pose that is known they are not."""
    points, _ = scene(600)
    alike = unit(np.ones((600, 128)))
    pair = view(points, alike, seed=1), view(points, alike, 30.0, (0.1, 0, 0), seed=2)
    assert study.revisited([pair], 0.2, pose=study.PoseSigma(0.2, 0.05)).precision < 0.7
    known = study.revisited([pair], 0.2, pose=study.PoseSigma())
    assert known.precision > 0.9


def test_the_gate_lies_between_equal_and_different():
    spread = study.descriptor_spread([two()], pose=study.PoseSigma(0.3, 0.1))
    highest, lowest = spread.equal.max(), np.quantile(spread.different, 0.05)
    assert highest <= spread.gate() < lowest
    assert lowest > 10 * highest


def test_the_gate_allows_one_wrong_match_in_a_hundred():
    random = np.random.default_rng(0)
    spread = study.DescriptorSpread(random.uniform(0, 1, 5000), random.uniform(0.3, 3, 5000))
    gate = spread.gate(0.01)
    right, wrong = (spread.equal <= gate).sum(), (spread.different <= gate).sum()
    assert wrong / (right + wrong) <= 0.01
    assert gate > 0.3
    assert spread.gate(0.1) > gate


def test_views_of_one_place_are_those_that_share_points_and_time_lies_between():
    points, looks = scene()
    here, later = view(points, looks), view(points, looks, 30.0, (0.2, 0, 0))
    soon = view(points, looks, 5.0)
    elsewhere = view(points, looks, 60.0, turn=(0, 0.6, 0))
    assert study.overlapping([here, soon, later, elsewhere], RIG, 20.0) == [
        (here, later),
        (soon, later),
    ]


def test_a_motion_follows_from_landmarks_alone():
    for seed in range(4):
        first, second = two(seed)
        motion = study.estimated_motion(first, second, RIG)
        place, angle = motion.error(study.Motion.between(first, second))
        assert place < 0.02
        assert angle < 0.005
        assert motion.inliers > 60


def test_wrong_matches_do_not_move_it():
    first, second = two()
    rows = np.arange(len(second.seen.descriptors))
    rows[: len(rows) // 3] = np.roll(rows[: len(rows) // 3], 1)
    mixed = replace(second.seen, descriptors=second.seen.descriptors[rows])
    motion = study.estimated_motion(first, replace(second, seen=mixed), RIG)
    assert motion.error(study.Motion.between(first, second))[0] < 0.03


def test_without_common_points_there_is_no_motion():
    points, looks = scene()
    others = unit(np.random.default_rng(9).uniform(0, 1, looks.shape))
    assert study.estimated_motion(view(points, looks), view(points, others), RIG) is None
    none = view(points[:0], looks[:0])
    assert study.estimated_motion(none, view(points, looks), RIG) is None


def test_odometry_without_errors_does_not_drift():
    points, looks = scene(600)
    way = [
        view(points, looks, n, (0.02 * n, 0, 0.1 * n), (0, 0.02 * n, 0), n, noise=0.0)
        for n in range(6)
    ]
    drift = study.odometry_drift(way, RIG)
    assert drift.lost == 0
    assert drift.percent < 0.01
    assert drift.distance_m == pytest.approx(5 * np.hypot(0.02, 0.1))
    noisy = [view(points, looks, n, v.place, (0, 0.02 * n, 0), n) for n, v in enumerate(way)]
    assert 0.05 < study.odometry_drift(noisy, RIG).percent < 10


def test_figures_are_those_of_the_single_functions():
    first, second = two()
    found = study.figures([first, second], RIG, study.PoseSigma())
    nees = study.Consistency.of(study.landmark_nees([(first, second)], DESCRIPTOR_GATE))
    assert found["landmark NEES within the gate"] == nees.mean
    assert found["revisits"] == found["poses"] == 1
    assert found["pose, median [m]"] == study.pose_errors([(first, second)], RIG)[0, 0]
    assert found["drift [%]"] == study.odometry_drift([first, second], RIG).percent
    soon = replace(second, stamp_s=1.0)
    assert "revisits" not in study.figures([first, soon], RIG, study.PoseSigma())


def settings(**features):
    return CameraSettings(features=FeatureSettings(**features))


def test_a_room_that_was_flown_through(shared_data):
    """EuRoC: poses, consistency and matches of a part of the flight."""
    recording = euroc.read(shared_data / "stereo" / "euroc_v101_keyframes")
    chosen = replace(recording.of(range(20, 36)), truth=recording.truth)
    seen = list(study.views(chosen, settings()))
    rig = study.rig_of(recording)
    pairs = study.overlapping(seen, rig, 0.0)
    assert len(pairs) > 8
    place, angle = np.median(study.pose_errors(pairs, rig), axis=0)
    assert place < 0.025
    assert np.degrees(angle) < 0.4
    nees = study.Consistency.of(study.landmark_nees(pairs, DESCRIPTOR_GATE, study.EUROC_TRUTH))
    assert 0.8 < nees.mean < 3.6
    assert nees.beyond < 0.05
    assert study.revisited(pairs, DESCRIPTOR_GATE, study.EUROC_TRUTH).precision > 0.97


def test_a_street_that_was_driven_along(shared_data):
    """KITTI: consistency from frame to frame, and drift."""
    recording = kitti.read(shared_data / "stereo" / "kitti_05_100-159")
    chosen = replace(recording.of(range(12)), truth=recording.truth)
    seen = list(study.views(chosen, settings(nearest_m=3.0, farthest_m=100.0)))
    drift = study.odometry_drift(seen, study.rig_of(recording))
    assert drift.lost == 0
    assert drift.percent < 2.5
    assert np.degrees(drift.angle_rad) < 1.0
    nees = study.Consistency.of(study.landmark_nees(pairwise(seen), DESCRIPTOR_GATE))
    assert 1.0 < nees.mean < 3.6
    assert nees.beyond < 0.06


def test_the_time_is_that_of_one_thread_beside_sift_alone(shared_data):
    recording = euroc.read(shared_data / "stereo" / "euroc_v101_keyframes")
    timing = study.timing(recording.of([50]), settings(scale=0.5), rounds=1)
    assert timing.sift_ms > 0
    assert timing.pair_ms > 0
