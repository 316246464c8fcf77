"""What leaves the window: nothing is lost, nothing invented."""

from dataclasses import replace

import numpy as np
import pytest
import worlds
from drives import filtered, remembered

from multi_robot_slam.models.frames import BodySightings, Record
from multi_robot_slam.models.motion import MotionSettings
from multi_robot_slam.models.symmetric import pack, unpack
from multi_robot_slam.smoothing import absorption, marginals, prior, problem
from multi_robot_slam.smoothing.prior import Prior
from multi_robot_slam.smoothing.problem import problem_of
from multi_robot_slam.smoothing.solve import smooth

ROBOTS, LANDMARKS = 2, 9
START = np.array([[0.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
STRAIGHT = MotionSettings(
    forward_per_sqrt_m=0.05, left_per_sqrt_m=0.03, yaw_per_sqrt_m=0.0, yaw_per_sqrt_rad=0.0
)


@pytest.fixture
def linear(monkeypatch):
    """Headings are known: nothing is left that is not linear."""
    for module in (prior, problem):
        monkeypatch.setattr(module, "SMALLEST_SIGMA", 1e-6)


def covariances_of(rng, count, dimensions):
    """(count, D, D) of an observation, without a tilt between plane and height."""
    roots = rng.normal(0, 0.05, (count, dimensions, dimensions)) + 0.05 * np.eye(dimensions)
    roots[:, 2:, :2] = roots[:, :2, 2:] = 0
    return roots @ roots.transpose(0, 2, 1) + 1e-4 * np.eye(dimensions)


def team(seed, steps):
    """Records of robots that do not turn, and which landmarks each saw: few at a time.

    The first landmarks are seen at the beginning and at the end, and robots see each other.
    """
    rng = np.random.default_rng(seed)
    places = rng.uniform([0, -2, 0], [8, 6, 2], (LANDMARKS, 3))
    poses, records, identities = START.copy(), [], []
    for step in range(steps):
        moves = np.tile([0.4, 0.0], (ROBOTS, 1)) if step else np.zeros((ROBOTS, 2))
        poses[:, :2] += moves + rng.normal(0, 0.02, (ROBOTS, 2)) * (step > 0)
        for robot in range(ROBOTS):
            inside = step * (LANDMARKS - 3) // steps + rng.choice(4, 3, replace=False)
            seen = np.sort(inside if step < steps - 2 else rng.choice(LANDMARKS, 3, replace=False))
            R = covariances_of(rng, 3, 3)
            noise = (np.linalg.cholesky(R) @ rng.standard_normal((3, 3, 1)))[:, :, 0]
            record = Record(
                robot,
                step,
                step,
                np.append(moves[robot], 0.0),
                places[seen] - np.append(poses[robot, :2], 0.0) + noise,
                pack(R),
                *(np.empty((0, 0)) for _ in range(4)),
            )
            if step % 3 == 1:
                apart = poses[1 - robot, :2] - poses[robot, :2] + rng.normal(0, 0.05, 2)
                tie = BodySightings(
                    np.array([1 - robot]), apart[None], np.array([[25e-4, 0, 25e-4]])
                )
                record = replace(record, sightings=tie)
            records.append(record)
            identities.append(seen)
    return records, identities


def smoothed(records, identities, known, also=(), noise=STRAIGHT):
    posed = problem_of(records, identities, known, noise, also=also)
    begin = np.array([known.poses[record.robot] for record in records])
    return posed, smooth(posed, begin, smallest_step=1e-5)


def joint(posed, found):
    """Mean and covariance of x, y of each robot's last pose, and of all landmarks of a problem."""
    last = [np.flatnonzero(posed.robots == robot)[-1] for robot in np.unique(posed.robots)]
    rows = (3 * np.array(last)[:, None] + np.arange(2)).ravel()
    unit = np.zeros((found.factor.size, len(rows)))
    unit[rows, np.arange(len(rows))] = 1
    deviations = [found.factor.solve_lower(unit).T]
    deviations.append(marginals.landmark_deviations(posed, found).reshape(3 * len(posed.ids), -1))
    deviations = np.concatenate(deviations)
    covariance = deviations @ deviations.T
    for n, own in enumerate(unpack(found.landmarks[:, 3:])):
        at = len(rows) + 3 * n
        covariance[at : at + 3, at : at + 3] += own
    return np.append(found.poses[last, :2], found.landmarks[:, :3]), covariance


def absorbed(records, identities, schedule, rename=lambda ids: ids, noise=STRAIGHT):
    """The prior after a schedule of (records known, records that leave), and how many have left."""
    known, first = Prior.exact(START), 0
    for end, count in schedule:
        posed, found = smoothed(records[first:end], identities[first:end], known, noise=noise)
        known = absorption.absorb(posed, found, count, known)
        first += count
    return known, first


SCHEDULES = {
    "nothing": [(10, 0), (20, 0)],
    "at once": [(40, 30)],
    "one step at a time": [(2 * t + 6, 2) for t in range(16)],
    "in parts": [(10, 2), (20, 10), (24, 4), (36, 14)],
    "all but the last": [(38, 38)],
    "everything": [(40, 40)],
}


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", SCHEDULES)
def test_absorbing_changes_nothing_in_a_linear_world(linear, name, seed):
    """Mean and covariance of poses and landmarks are those of the whole past."""
    records, identities = team(seed, 20)
    whole = smoothed(records, identities, Prior.exact(START))
    known, first = absorbed(records, identities, SCHEDULES[name])
    if first == len(records):
        records, identities = [*records, *team(5, 21)[0][-2:]], [*identities, *team(5, 21)[1][-2:]]
        whole = smoothed(records, identities, Prior.exact(START))
    rest = smoothed(records[first:], identities[first:], known, also=np.arange(LANDMARKS))
    (mean, covariance), (expected, expected_covariance) = joint(*rest), joint(*whole)
    sigma = np.sqrt(np.diag(expected_covariance))
    np.testing.assert_allclose((mean - expected) / sigma, 0, atol=1e-4)
    scale = np.outer(sigma, sigma)
    np.testing.assert_allclose(covariance / scale, expected_covariance / scale, atol=1e-6)


def plane_marginals(posed, found):
    """Ids, and marginals (N, 9) of a problem's landmarks."""
    deviations = marginals.landmark_deviations(posed, found)
    covariances = found.landmarks[:, 3:] + pack(deviations @ deviations.transpose(0, 2, 1))
    return posed.ids, np.append(found.landmarks[:, :3], covariances, axis=1)


def test_landmarks_that_rest_are_where_the_problem_leaves_them(linear):
    """As if the problem had held them."""
    records, identities = team(2, 20)
    known, first = absorbed(records, identities, SCHEDULES["in parts"])
    posed, found = smoothed(records[first:34], identities[first:34], known)
    ids, resting = absorption.resting(known, posed, found)
    assert sorted(ids) == np.setdiff1d(known.ids, posed.ids).tolist()
    assert len(ids) > 1
    everything, expected = plane_marginals(
        *smoothed(records[first:34], identities[first:34], known, also=np.arange(LANDMARKS))
    )
    expected = expected[np.searchsorted(everything, ids)]
    np.testing.assert_allclose(resting[:, :3], expected[:, :3], atol=1e-6)
    np.testing.assert_allclose(resting[:, 3:], expected[:, 3:], atol=1e-9)


@pytest.mark.parametrize("name", ["in parts", "one step at a time"])
def test_landmarks_joined_late_are_as_if_they_had_been_one(linear, name):
    """Their names differ while most of the past leaves; then there are two centres, then one."""
    records, identities = team(3, 20)
    whole = smoothed(records, identities, Prior.exact(START))
    split = [
        ids + LANDMARKS * (p % 3) * (ids < 4) for p, ids in enumerate(identities)
    ]  # three names for some
    known, first = absorbed(records, split, SCHEDULES[name][:-1])
    assert len(known.ids) > LANDMARKS - 3
    known = known.renamed(known.ids % LANDMARKS)
    assert len(np.unique(known.ids)) < len(known.ids)
    rest = records[first:], identities[first:]
    for count in (4, 0):
        posed, found = smoothed(*rest, known, also=np.arange(LANDMARKS))
        (mean, covariance), (expected, expected_covariance) = joint(posed, found), joint(*whole)
        sigma = np.sqrt(np.diag(expected_covariance))
        np.testing.assert_allclose((mean - expected) / sigma, 0, atol=1e-4)
        scale = np.outer(sigma, sigma)
        np.testing.assert_allclose(covariance / scale, expected_covariance / scale, atol=1e-6)
        known = absorption.absorb(posed, found, count, known)
        rest = rest[0][count:], rest[1][count:]
        assert len(np.unique(known.ids)) == len(known.ids)


def test_absorbing_nothing_is_nothing(linear):
    records, identities = team(0, 12)
    known, first = absorbed(records, identities, [(12, 6)])
    posed, found = smoothed(records[first:], identities[first:], known)
    assert absorption.absorb(posed, found, 0, known) is known


@pytest.mark.parametrize("robust_above", [np.inf, 11.345])
@pytest.mark.parametrize("sighted", [False, True])
def test_what_remains_keeps_its_optimum_and_covariance(sighted, robust_above):
    """Where robots turn, twice: at the optimum that the problem had when its records left."""
    state, settings = filtered(steps=15)
    records, identities, poses = remembered(state, sighted=sighted)
    level = np.array([1, 1, 0, 1, 0, 1])
    records = [replace(record, covariances=record.covariances * level) for record in records]
    known, first = Prior.exact(worlds.START), 0
    also = np.unique(np.concatenate(identities))

    def solved():
        posed = problem_of(records[first:], identities[first:], known, settings.motion, also=also)
        return posed, smooth(posed, poses[first:], robust_above, 1e-6, start=start)

    start = None
    posed, start = whole = solved()
    for count in (12, 18):
        known = absorption.absorb(posed, start, count, known)
        first += count
        posed, found = solved()
        (mean, covariance), (expected, expected_covariance) = joint(posed, found), joint(*whole)
        np.testing.assert_allclose(mean, expected, atol=1e-6)
        np.testing.assert_allclose(covariance, expected_covariance, atol=1e-8)
        np.testing.assert_allclose(found.of_records, whole[1].of_records[first:], atol=1e-6)
        start = found


def in_body(pose, places):
    """Places (n, 3) in the `base_link` of a robot at `pose`."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return (places - [pose[0], pose[1], 0.0]) @ turn


def seen_by_stereo(records, identities, whole, found):
    """The records as a stereo camera had seen them: covariances are long along each ray."""
    rng, result = np.random.default_rng(0), []
    for record, ids, pose in zip(records, identities, found.of_records, strict=True):
        places = found.landmarks[np.searchsorted(whole.ids, ids), :3]
        seen = in_body(pose, places)
        ray = seen - [worlds.MOUNT.forward_m, worlds.MOUNT.left_m, worlds.MOUNT.up_m]
        distance = np.linalg.norm(ray, axis=1)[:, None, None]
        along = ray[:, :, None] * ray[:, None, :] / distance**2
        R = (0.01 * distance**2) ** 2 * along + (0.003 * distance) ** 2 * (np.eye(3) - along)
        noise = np.linalg.cholesky(R) @ rng.standard_normal((len(seen), 3, 1))
        result.append(replace(record, positions=seen + noise[:, :, 0], covariances=pack(R)))
    return result


def test_tilted_covariances_are_nearly_what_they_were():
    """Heights of centres count as known, their doubt goes to the landmarks: 45 times over."""
    state, settings = filtered(steps=60)
    records, identities, poses = remembered(state)
    known, also = Prior.exact(worlds.START), np.unique(np.concatenate(identities))
    whole = problem_of(records, identities, known, settings.motion)
    records = seen_by_stereo(records, identities, whole, smooth(whole, poses))
    whole = problem_of(records, identities, known, settings.motion)
    best = smooth(whole, poses, smallest_step=1e-6)
    for first in range(0, 135, 3):
        window = slice(first, first + 15)
        posed = problem_of(records[window], identities[window], known, settings.motion)
        found = smooth(posed, best.of_records[window])
        known = absorption.absorb(posed, found, 3, known)
    posed = problem_of(records[135:], identities[135:], known, settings.motion, also=also)
    found = smooth(posed, best.of_records[135:], smallest_step=1e-6)
    (mean, covariance), (expected, expected_covariance) = joint(posed, found), joint(whole, best)
    sigma, exact = np.sqrt(np.diag(covariance)), np.sqrt(np.diag(expected_covariance))
    assert (sigma / exact).min() > 0.85
    assert (sigma / exact).max() < 1.4
    assert np.mean(((mean - expected) / exact) ** 2) < 0.2


def test_forgotten_landmarks_leave_the_rest_as_it_is(linear):
    records, identities = team(0, 20)
    known, _ = absorbed(records, identities, SCHEDULES["in parts"])
    fewer = known.forget(known.ids[[1, 4]])
    kept = np.delete(np.arange(len(known.ids)), [1, 4])
    assert fewer.ids.tolist() == known.ids[kept].tolist()
    np.testing.assert_array_equal(fewer.centres, known.centres[kept])
    rows = known.rows(np.arange(ROBOTS), kept)
    np.testing.assert_array_equal(fewer.covariance, known.covariance[np.ix_(rows, rows)])
