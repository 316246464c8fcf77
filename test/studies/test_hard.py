"""The hard worlds: each differs in what it says and in nothing else; their rows; what is wrong."""

import csv
import functools
from dataclasses import astuple, replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from msg_defs.errors import InputError
from msg_defs.types import LandmarkMap, ObservationSet, PoseSample
from multi_robot_slam.config import Config
from multi_robot_slam.models.motion import increment, wrap
from multi_robot_slam.runs.trajectory_errors import at, rotation
from multi_robot_slam.studies import (
    accuracy,
    hard,
    hard_changes,
    hard_figures,
    hard_table,
    hard_worlds,
)
from multi_robot_slam.studies.hard import Job
from multi_robot_slam.studies.hard_table import Row
from multi_robot_slam.studies.hard_worlds import EXACT, EXACT_TWICE, WORLDS
from sim_world import stereo
from sim_world.robot import START_NS

SECOND = 1_000_000_000
SEED = 3
NEXT_DAY = ("next-day", "next-day-mapping")


@pytest.fixture(scope="module")
def base():
    small = accuracy.calibrated()
    own = replace(small.filters["rejuvenated"], particles=20)
    return replace(small, filters=small.filters | {"rejuvenated": own})


@pytest.fixture(scope="module")
def simulated(base):
    """What a team of two sends before anything is changed, simulated when it is asked for."""

    @functools.cache
    def told(name, seed):
        return hard_worlds.simulated(base, name, 2, seed)

    return lambda name, seed=SEED: told(hard_worlds.simulation_of(name), seed)


@pytest.fixture(scope="module")
def worlds(simulated):
    """Each world of a team of two."""
    return functools.cache(lambda name: hard_worlds.changed(name, simulated(name)))


def odometry(told, robot=None):
    return [e for e in told.events if isinstance(e, PoseSample) and robot in (None, e.robot)]


def frames(told, robot=None):
    return [e for e in told.events if isinstance(e, ObservationSet) and robot in (None, e.robot)]


def key(event):
    return type(event).__name__, event.robot, event.stamp_ns


def content(event):
    if isinstance(event, PoseSample):
        return (*key(event), event.pose.tobytes())
    return (
        *key(event),
        event.positions.tobytes(),
        event.covariances.tobytes(),
        event.descriptors.tobytes(),
    )


def changed(told, exact):
    """Events that the exact world does not have."""
    known = set(map(content, exact.events))
    return [event for event in told.events if content(event) not in known]


def missing(told, exact):
    """Events of the exact world whose stamp this one does not have."""
    known = set(map(key, told.events))
    return [event for event in exact.events if key(event) not in known]


def movements(samples):
    return np.array([increment(a.pose, b.pose) for a, b in pairwise(samples)])


def true_movements(told, samples):
    stamps = np.array([s.stamp_ns for s in samples])
    poses = at(told.recorded.truth[samples[0].robot], stamps)
    return np.array([increment(a, b) for a, b in pairwise(poses)])


def true_points(told, seen):
    rows = told.recorded.observation_truth[seen.robot, seen.stamp_ns]
    pose = at(told.recorded.truth[seen.robot], np.array([seen.stamp_ns]))[0]
    places = told.landmarks.positions[rows].astype(float)
    return stereo.camera_from_map(places, pose, told.scenario.camera.mount)


def test_odometry_comes_at_20_hz_and_frames_at_2_in_the_order_of_time(worlds):
    exact = worlds(EXACT)
    stamps = [e.stamp_ns for e in exact.events]
    assert stamps == sorted(stamps)
    for robot in exact.names:
        assert np.all(np.diff([e.stamp_ns for e in odometry(exact, robot)]) == SECOND // 20)
        assert np.all(np.diff([e.stamp_ns for e in frames(exact, robot)]) == SECOND // 2)
    assert exact.end_ns - START_NS >= 70 * SECOND
    assert exact.config.filter.particles == 20
    assert exact.config.seed == SEED


@pytest.mark.parametrize("robots", [2, 3])
def test_runs_last_over_70_s(base, robots):
    told = hard_worlds.simulated(base, EXACT, robots, SEED)
    assert told.end_ns - START_NS > 70 * SECOND


@pytest.mark.parametrize("name", [name for name, world in WORLDS.items() if world.rounds == 1])
def test_a_world_is_the_same_each_time(simulated, worlds, name):
    again = hard_worlds.changed(name, simulated(name))
    assert list(map(content, again.events)) == list(map(content, worlds(name).events))
    assert again.config == worlds(name).config


@pytest.mark.parametrize(("kind", "axis"), [("odometry", 0), ("camera", 1)])
def test_noise_that_is_told_is_the_same_noise(worlds, kind, axis):
    told, untold = worlds(f"{kind}-3-told"), worlds(f"{kind}-3")
    assert (told.factors, untold.factors[axis]) == ((1.0, 1.0), 3.0)
    for own, other in zip(frames(told), frames(untold), strict=True):
        assert np.array_equal(own.positions, other.positions)
        np.testing.assert_allclose(own.covariances, other.covariances * (1, 9)[axis], rtol=1e-6)
    assert list(map(content, odometry(told))) == list(map(content, odometry(untold)))
    motion, usual = told.config.filter.motion, untold.config.filter.motion
    assert motion.yaw_per_sqrt_rad == (3, 1)[axis] * usual.yaw_per_sqrt_rad
    assert motion.scale_sigma == usual.scale_sigma


@pytest.mark.parametrize("name", ["silent", "slip", "start-far", "mixture"])
def test_a_difference_is_another_for_each_seed(simulated, worlds, name):
    told, reseeded = worlds(name), simulated(name)
    reseeded = replace(reseeded, config=replace(reseeded.config, seed=SEED + 1))
    other = hard_worlds.changed(name, reseeded)
    same = list(map(content, other.events)) == list(map(content, told.events))
    assert not (same and other.config.start_poses == told.config.start_poses)


def test_worlds_of_one_simulation_are_simulated_once():
    assert {hard_worlds.simulation_of(name) for name in WORLDS} == {
        *(EXACT, EXACT_TWICE, "descriptor-noise", "short-sight", "few-observations")
    }


@pytest.mark.parametrize(
    "name",
    ["exact-certain", "start-near", "start-far-told", "first-far-told", "start-far", "swapped"],
)
def test_where_starts_differ_nothing_else_does(worlds, name):
    told, exact = worlds(name), worlds(EXACT)
    assert list(map(content, told.events)) == list(map(content, exact.events))
    usual = {"start_poses": exact.config.start_poses, "start_sigma": exact.config.start_sigma}
    assert replace(told.config, **usual) == exact.config
    sigmas = {"exact-certain": (0.0, 0.0)} | dict.fromkeys(
        ("start-far-told", "first-far-told"), (0.3, 0.175)
    )
    assert exact.config.start_sigma == Config().start_sigma
    assert told.config.start_sigma == sigmas.get(name, exact.config.start_sigma)


@pytest.mark.parametrize(
    ("name", "robot", "distance_m", "degrees"),
    [
        ("start-near", 1, 0.05, 2.0),
        ("start-far-told", 1, 0.3, 10.0),
        ("start-far", 1, 0.3, 10.0),
        ("first-near", 0, 0.05, 2.0),
        ("first-far-told", 0, 0.3, 10.0),
    ],
)
def test_one_start_is_off_as_far_as_it_says(worlds, name, robot, distance_m, degrees):
    told, exact = worlds(name), worlds(EXACT)
    off = np.array(told.config.start_poses) - np.array(exact.config.start_poses)
    assert np.hypot(*off[robot, :2]) == pytest.approx(distance_m)
    assert abs(wrap(off[robot, 2])) == pytest.approx(np.radians(degrees))
    assert np.abs(off[1 - robot]).max() < 1e-12
    assert told.culprits == (told.names[robot],)


def test_every_bay_of_a_wall_is_there_three_times(worlds):
    told, exact = worlds("unknown-one-copies"), worlds(EXACT)
    places, looks = told.landmarks.positions, told.landmarks.descriptors
    kinds, counts = np.unique(looks, axis=0, return_inverse=True, return_counts=True)[1:]
    assert (counts[kinds] == 3).mean() > 0.9
    assert counts.max() == 3
    shift = np.linalg.norm(places - exact.landmarks.positions, axis=1)
    assert shift.max() < np.hypot(1.2, 2.0)
    triples, spans = np.flatnonzero(counts == 3), []
    for one in triples[:60]:
        copies = places[kinds == one]
        assert np.ptp(copies[:, 2]) == 0
        nearest = np.linalg.norm(copies[:, None] - places, axis=2)
        nearest = np.array(
            [nearest[:, kinds == kind].min(axis=1) for kind in triples if kind != one]
        )
        on_it = nearest.max(axis=1) < 1.0
        spans += np.ptp(nearest[on_it], axis=1).tolist()
    assert len(spans) > 100
    assert np.median(spans) < 1e-5
    truth = told.recorded.observation_truth
    for event in frames(told)[::40]:
        rows = truth[event.robot, event.stamp_ns]
        assert np.abs(event.descriptors - looks[rows]).max() < 0.1
        where = at(told.recorded.truth[event.robot], np.array([event.stamp_ns]))[0]
        camera = stereo.camera_from_map(places[rows], where, told.scenario.camera.mount)
        errors = np.linalg.norm(event.positions - camera, axis=1)
        assert np.median(errors) < 0.2
    assert np.unique(places, axis=0).shape == places.shape


def test_of_one_robot_or_of_all_but_one_the_start_is_unknown(base):
    told = hard_worlds.simulated(base, EXACT, 3, SEED)
    for name, count in (("unknown-one", 1), ("unknown-all-but-one", 2)):
        own = hard_worlds.changed(name, told)
        assert not own.config.are_known[[own.names.index(one) for one in own.culprits]].any()
        assert len(own.culprits) == 3 - own.config.are_known.sum() == count
        assert replace(own.config, start_poses=told.config.start_poses) == told.config
        assert own.events == told.events


def test_the_next_day_the_same_is_sent_and_no_start_is_known(worlds):
    exact = worlds(EXACT)
    for name, mapping in (("next-day", False), ("next-day-mapping", True)):
        told = worlds(name)
        assert told.events == exact.events
        assert not told.config.are_known.any()
        assert told.culprits == told.names
        assert told.config.filter.mapping is mapping


def test_of_landmarks_that_are_gone_nobody_sees_any(worlds):
    exact, told = worlds(EXACT), worlds("next-day-tenth-gone")
    before, after = (
        {r for rows in own.recorded.observation_truth.values() for r in rows.tolist()}
        for own in (exact, told)
    )
    assert after < before
    assert 0.8 < len(after) / len(before) < 0.97
    for old, new in zip(frames(exact), frames(told), strict=True):
        rows = exact.recorded.observation_truth[old.robot, old.stamp_ns]
        stays = np.isin(rows, list(after))
        assert np.array_equal(told.recorded.observation_truth[key(new)[1:]], rows[stays])
        assert np.array_equal(new.positions, old.positions[stays])


def test_the_day_before_was_another_drive_through_the_same_building(base, worlds):
    exact, before = worlds(EXACT), hard_worlds.day_before(base, 2, SEED)
    assert np.array_equal(before.landmarks.positions, exact.landmarks.positions)
    assert before.config.seed != exact.config.seed
    for here, there in zip(exact.config.start_poses, before.config.start_poses, strict=True):
        assert np.hypot(*(np.subtract(here, there)[:2])) > 3
    assert before.config.are_known.all()


def test_swapped_robots_start_where_the_other_is_said_to(worlds):
    told, exact = worlds("swapped"), worlds(EXACT)
    assert told.config.start_poses == pytest.approx(np.array(exact.config.start_poses)[::-1])


@pytest.mark.parametrize(("name", "factor"), [("odometry-3", 3.0), ("odometry-third", 1 / 3)])
def test_odometry_errs_so_many_times_more(worlds, name, factor):
    told, exact = worlds(name), worlds(EXACT)
    for robot in told.names:
        own, usual = odometry(told, robot), odometry(exact, robot)
        true = true_movements(told, own)
        errors, usual_errors = movements(own) - true, movements(usual) - true
        assert wrap(errors) == pytest.approx(factor * wrap(usual_errors), abs=1e-9)
    assert {type(e) for e in changed(told, exact)} == {PoseSample}
    assert told.factors == (factor, 1.0)


def test_biased_odometry_tells_too_much_of_distances_and_too_little_of_turns(worlds):
    told, exact = worlds("odometry-biased"), worlds(EXACT)
    for robot in told.names:
        own, usual = movements(odometry(told, robot)), movements(odometry(exact, robot))
        assert own == pytest.approx(usual * (1.05, 1.05, 0.97), abs=1e-9)
    assert {type(e) for e in changed(told, exact)} == {PoseSample}


@pytest.mark.parametrize(("name", "factor"), [("camera-3", 3.0), ("camera-third", 1 / 3)])
def test_the_camera_errs_so_many_times_more_and_claims_what_it_did(worlds, name, factor):
    told, exact = worlds(name), worlds(EXACT)
    for own, usual in zip(frames(told), frames(exact), strict=True):
        true = true_points(exact, usual)
        assert own.positions - true == pytest.approx(factor * (usual.positions - true), abs=1e-4)
        pixels = stereo.project(own.positions.astype(float), told.scenario.camera)
        told_variances = stereo.variances(pixels, told.scenario.camera)
        assert own.covariances[:, [0, 3, 5]] == pytest.approx(told_variances, rel=1e-4)
        assert np.array_equal(own.descriptors, usual.descriptors)
    assert {type(e) for e in changed(told, exact)} == {ObservationSet}


@pytest.mark.parametrize(
    ("name", "seconds", "kinds"),
    [("silent", 30, {PoseSample, ObservationSet}), ("no-odometry", 5, {PoseSample})],
)
def test_one_robot_is_not_heard_for_so_long(worlds, name, seconds, kinds):
    told, exact = worlds(name), worlds(EXACT)
    gone = missing(told, exact)
    assert not changed(told, exact)
    assert {event.robot for event in gone} == set(told.culprits)
    assert len(told.culprits) == 1
    assert {type(event) for event in gone} == kinds
    assert len([e for e in gone if isinstance(e, PoseSample)]) == 20 * seconds
    assert told.known_ns - told.begins_ns == seconds * SECOND
    assert all(told.begins_ns < e.stamp_ns <= told.known_ns for e in gone)


def test_three_messages_of_ten_are_lost(worlds):
    told, exact = worlds("lost-messages"), worlds(EXACT)
    assert not changed(told, exact)
    gone = missing(told, exact)
    assert len(gone) / len(exact.events) == pytest.approx(0.3, abs=0.02)
    assert {type(e) for e in gone} == {PoseSample, ObservationSet}


@pytest.mark.parametrize(
    ("name", "part"), [("random-descriptors", "descriptors"), ("random-positions", "positions")]
)
def test_one_observation_of_twenty_is_random_in_one_thing(worlds, name, part):
    told, exact = worlds(name), worlds(EXACT)
    share, count = 0, 0
    other = {"descriptors": "positions", "positions": "descriptors"}[part]
    for own, usual in zip(frames(told), frames(exact), strict=True):
        share += np.any(getattr(own, part) != getattr(usual, part), axis=1).sum()
        count += len(usual.positions)
        assert np.array_equal(getattr(own, other), getattr(usual, other))
        assert np.linalg.norm(own.descriptors, axis=1) == pytest.approx(1, abs=0.2)
        placed = own.positions[np.any(own.positions != usual.positions, axis=1)].astype(float)
        assert stereo.in_view(placed, told.scenario.camera).all()
    assert share / count == pytest.approx(0.05, abs=0.01)
    assert {type(e) for e in changed(told, exact)} == {ObservationSet}


def test_the_mixture_jitters_loses_and_repeats_and_keeps_its_truth(worlds):
    told, exact = worlds("mixture"), worlds(EXACT)
    keys = list(map(key, told.events))
    once = set(keys)
    assert len(once) / len(exact.events) == pytest.approx(0.9, abs=0.02)
    assert (len(keys) - len(once)) / len(once) == pytest.approx(0.03, abs=0.01)
    stamps = [e.stamp_ns for e in told.events]
    assert stamps != sorted(stamps)
    off = np.array([(s - START_NS + SECOND // 40) % (SECOND // 20) - SECOND // 40 for s in stamps])
    assert 1e6 < off.std() < 4e6
    truth = told.recorded.observation_truth
    assert all(len(truth[e.robot, e.stamp_ns]) == len(e.positions) for e in frames(told))
    for robot in told.names:
        first = dict.fromkeys(e.stamp_ns for e in odometry(told, robot))
        assert list(first) == sorted(first)


def test_thirty_landmarks_are_a_metre_away_after_a_minute(worlds):
    told, exact = worlds("landmarks-moved"), worlds(EXACT_TWICE)
    assert len(told.old_places) == 30
    rows = np.array(list(told.old_places))
    moved = np.linalg.norm(told.landmarks.positions - exact.landmarks.positions, axis=1)
    assert moved[rows] == pytest.approx(1.0, abs=1e-5)
    assert np.count_nonzero(moved) == 30
    since = START_NS + 60 * SECOND
    seen = set()
    for own, usual in zip(frames(told), frames(exact), strict=True):
        if own.stamp_ns <= since:
            assert content(own) == content(usual)
            continue
        near = exact.recorded.observation_truth[usual.robot, usual.stamp_ns]
        kept = told.recorded.observation_truth[own.robot, own.stamp_ns]
        still = ~np.isin(near, rows)
        assert np.array_equal(own.positions[~np.isin(kept, rows)], usual.positions[still])
        here = np.isin(kept, rows)
        seen.update(kept[here].tolist())
        errors = own.positions - true_points(told, own)
        assert np.linalg.norm(errors[here]) < 0.5 * max(1, here.sum())
    assert seen == set(rows.tolist())
    assert not missing(told, exact)
    assert told.known_ns == since


@pytest.mark.parametrize(
    ("name", "robots", "seconds"), [("fusion-late", 2, 60), ("robot-late", 1, 20)]
)
def test_who_is_late_was_not_heard_before(worlds, name, robots, seconds):
    told, exact = worlds(name), worlds(hard_worlds.exact_of(name))
    gone = missing(told, exact)
    assert not changed(told, exact)
    assert len(told.culprits) == robots
    assert {e.robot for e in gone} == set(told.culprits)
    assert len([e for e in gone if isinstance(e, PoseSample)]) == robots * 20 * seconds
    assert max(e.stamp_ns for e in gone) < told.begins_ns == START_NS + seconds * SECOND
    assert told.known_ns == (told.begins_ns if robots == 1 else None)
    assert told.config == exact.config


def test_a_fusion_that_is_restarted_hears_the_rest(worlds):
    told, exact = worlds("fusion-restarted"), worlds(EXACT_TWICE)
    length = exact.end_ns - START_NS
    rest = exact.events[-len(told.events) :]
    assert list(map(content, told.events)) == list(map(content, rest))
    assert length / 3 <= told.begins_ns - START_NS <= 2 * length / 3


def test_a_fusion_that_was_killed_has_heard_nothing_for_five_to_ten_seconds(worlds):
    told, exact = worlds("fusion-killed"), worlds(EXACT)
    kept = set(map(id, told.events))
    gone = [e for e in exact.events if id(e) not in kept]
    assert min(e.stamp_ns for e in gone) > told.begins_ns
    assert max(e.stamp_ns for e in gone) <= told.known_ns
    assert 5 * SECOND <= told.known_ns - told.begins_ns <= 10 * SECOND
    assert len(gone) + len(told.events) == len(exact.events)
    assert {e.robot for e in gone} == set(told.names)
    assert told.config == exact.config


def test_a_robot_that_is_restarted_counts_from_zero_and_moves_as_before(worlds):
    told, exact = worlds("robot-restarted"), worlds(EXACT)
    (name,) = told.culprits
    own, usual = odometry(told, name), odometry(exact, name)
    after = [s.stamp_ns >= told.begins_ns for s in own]
    begin = after.index(True)
    assert np.abs(own[begin].pose).max() < 0.2
    assert movements(own[begin:]) == pytest.approx(movements(usual[begin:]), abs=1e-9)
    assert {e.robot for e in changed(told, exact)} == {name}
    assert len(changed(told, exact)) == sum(after)


def test_a_slip_is_a_metre_and_thirty_degrees_that_odometry_does_not_tell(worlds):
    told, exact = worlds("slip"), worlds(EXACT)
    (name,) = told.culprits
    own, usual = movements(odometry(told, name)), movements(odometry(exact, name))
    untold = usual - own
    untold[:, 2] = wrap(untold[:, 2])
    assert np.hypot(*untold[:, :2].sum(0)) == pytest.approx(1.0, abs=1e-6)
    assert abs(untold[:, 2].sum()) == pytest.approx(np.radians(30), abs=1e-6)
    assert (np.abs(untold).max(1) > 1e-9).sum() == 20
    assert {e.robot for e in changed(told, exact)} == {name}
    assert not missing(told, exact)
    samples = [e.pose for e in odometry(told, name)]
    assert max(np.hypot(*np.diff(samples, axis=0)[:, :2].T)) / 0.05 < 30


def test_a_robot_that_is_carried_ends_5_to_15_m_away_without_knowing(worlds):
    told, exact = worlds("carried"), worlds(EXACT)
    (name,) = told.culprits
    truth = told.recorded.truth[name]
    before, after = at(truth, np.array([told.begins_ns, told.known_ns]))
    assert 4.9 <= np.hypot(*(after - before)[:2]) <= 15.1
    samples = odometry(told, name)
    stood = [s for s in samples if told.begins_ns < s.stamp_ns <= told.known_ns]
    assert np.ptp([s.pose for s in stood[1:]], axis=0) == pytest.approx(0, abs=1e-9)
    gone = missing(told, exact)
    assert {e.robot for e in gone} == {name}
    assert all(told.begins_ns < e.stamp_ns <= told.known_ns for e in gone)
    assert {type(e) for e in gone} == {ObservationSet}
    assert not [e for e in frames(told, name) if told.begins_ns < e.stamp_ns <= told.known_ns]


@pytest.mark.parametrize(
    ("name", "field", "value"),
    [
        ("descriptor-noise", "descriptor_noise", 0.012),
        ("short-sight", "d_max_m", 5.0),
        ("few-observations", "observations", 5),
    ],
)
def test_where_the_simulation_differs_it_does_in_one_setting(worlds, name, field, value):
    told, exact = worlds(name), worlds(EXACT)
    assert told.scenario == replace(exact.scenario, **{field: value})
    assert told.config == exact.config
    assert [content(e) for e in odometry(told)] == [content(e) for e in odometry(exact)]


def fake_row(world=EXACT, robots=2, seed=0, **values):
    numbers = dict.fromkeys(hard_table.COLUMNS[3:], 1.0)
    whole = {"duplicates": 0, "exact_duplicates": 0, "old_places": 0, "noticed_frames": 1}
    whole |= {"away_s": None}
    rest = {"false_alarm": 0, "said": None, "lost": 0, "refused": 0, "noticed_s": None}
    return Row(world, robots, seed, **numbers | whole | rest | values)


def test_a_run_is_wrong_beyond_twice_the_exact_error_or_three_times_the_bound():
    assert not fake_row(published_m=1.99).is_wrong
    assert fake_row(published_m=2.01).is_wrong
    assert not fake_row(nees=28.0).is_wrong
    assert fake_row(nees=28.1).is_wrong
    assert fake_row(published_m=None).is_wrong
    assert not fake_row(published_m=5.9, optimum_m=3.0, exact_optimum_m=1.0).is_wrong
    assert fake_row(published_m=6.1, optimum_m=3.0, exact_optimum_m=1.0).is_wrong


def test_what_is_judged_depends_on_the_world():
    row = fake_row(published_m=9.0, later_m=3.0, later_aligned_m=1.5)
    assert row.ratio == 9.0
    assert replace(row, world="first-near").ratio == 1.5
    assert replace(row, world="robot-late").ratio == 3.0
    assert replace(row, world="fusion-late").ratio == 1.5
    assert replace(row, world="unknown-one").ratio == 9.0
    assert replace(row, world="slip", found_m=1.2).ratio == 1.2
    assert replace(row, world="swapped", found_aligned_m=1.1).ratio == 1.1


def test_who_is_found_again_has_still_been_wrong_until_that_was_said():
    row = fake_row("carried", later_m=9.0, found_m=1.0, nees=3.0)
    assert not row.is_wrong  # nobody was lost: it is as in any world
    lost = replace(row, away_s=3.0, noticed_s=20.0)
    assert lost.ratio == 1.0
    assert lost.is_wrong
    assert lost.is_silently_wrong
    assert not replace(lost, noticed_s=9.0).is_silently_wrong
    assert not replace(lost, later_m=1.0).is_wrong


def test_a_wrong_run_is_silent_unless_it_is_said_within_10_s():
    wrong = fake_row("slip", found_m=9.0, nees=10.0)
    assert wrong.is_silently_wrong
    assert replace(wrong, noticed_s=10.1).is_silently_wrong
    assert not replace(wrong, noticed_s=10.0).is_silently_wrong
    assert not replace(wrong, found_m=1.0).is_silently_wrong
    assert not replace(wrong, nees=9.0).is_silently_wrong
    table = hard_table.markdown([wrong, fake_row("slip", seed=1), fake_row("slip", robots=3)])
    assert "wrong and silent: 1 of 3; slip, K = 2, seed 0." in table
    assert hard_table.unmet([wrong]) == ["error", "wrong and silent"]
    assert hard_table.unmet([replace(wrong, noticed_s=3.0)]) == ["error"]


@pytest.mark.parametrize(
    ("world", "values", "missed"),
    [
        ("silent", {"published_m": 1.31}, ["error"]),
        ("silent", {"nees": 12.0}, ["NEES"]),
        ("silent", {"nees": 3.0}, []),
        ("slip", {"others_m": 1.2}, ["others"]),
        ("slip", {"noticed_frames": 6}, ["frames"]),
        ("slip", {"noticed_frames": None}, ["frames"]),
        ("slip", {"away_s": 10.1}, ["found late"]),
        ("slip", {"map_m": 1.2}, ["map"]),
        ("swapped", {"found_aligned_m": 1.31, "noticed_s": 1.0}, ["error"]),
        ("swapped", {"noticed_s": 1.0, "away_s": 9.0}, []),
        ("swapped", {}, ["not noticed"]),
        ("odometry-3", {"factor_off": 0.21}, ["factor"]),
        ("odometry-3", {"factor_off": 0.0}, []),
        ("odometry-biased", {"published_m": 1.5}, ["error"]),
        ("odometry-biased", {"published_m": 1.5, "noticed_s": 1.0}, []),
        ("random-positions", {"map_m": 1.3, "landmark_nees": 99.0}, ["map", "landmark NEES"]),
        ("landmarks-moved", {"old_places": 1}, ["old places"]),
        ("short-sight", {"published_m": 1.15}, ["optimum"]),
        ("short-sight", {"published_m": 1.15, "optimum_m": 1.1}, []),
        ("unknown-one", {"noticed_s": 9.0}, []),
        ("unknown-one", {}, ["not noticed"]),
        (EXACT, {"said": "robot_1 lost 3.0"}, ["false alarm"]),
        ("silent", {"false_alarm": 1}, ["false alarm"]),
    ],
)
def test_what_a_world_is_held_to(world, values, missed):
    row = fake_row(world, **{"nees": 3.0, "landmark_nees": 3.0, "factor_off": 0.1} | values)
    assert hard_table.unmet([row]) == missed


def test_every_world_has_a_target_and_the_table_has_their_order():
    assert list(hard_table.TARGETS) != []
    assert hard_table.TARGETS.keys() == WORLDS.keys()
    rows = [fake_row("slip"), fake_row(EXACT, 3), fake_row(EXACT, 2)]
    lines = hard_table.markdown(rows).splitlines()[2:5]
    assert [line.split("|")[1:3] for line in lines] == [
        [" exact ", " 2 "],
        [" exact ", " 3 "],
        [" slip ", " 2 "],
    ]


def test_ratios_are_of_means_and_need_every_run():
    assert hard_table.ratio_of_means([(1.0, 1.0), (6.0, 2.0)]) == pytest.approx(7 / 3)
    assert hard_table.ratio_of_means([(1.0, 1.0), (None, 2.0)]) is None
    assert hard_table.ratio_of_means([]) is None


def outcome(told, verdicts=(), run=None):
    steps = [
        SimpleNamespace(stamp_ns=stamp, verdicts=[SimpleNamespace(robot=r, level=level)])
        for stamp, r, level in verdicts
    ]
    return SimpleNamespace(told=told, run=SimpleNamespace(steps=steps))


def test_what_was_said_first_of_each_robot_since_the_difference():
    made = outcome(
        None,
        [
            (1, "a", "lost"),
            (5, "a", "consistent"),
            (6, "b", "lost"),
            (7, "a", "lost"),
            (8, "b", "lost"),
        ],
    )
    assert hard_figures.said(made.run, 5) == [(6, "b", "lost"), (7, "a", "lost")]
    assert hard_figures.is_false_alarm(made.run, SimpleNamespace(begins_ns=5), "slip")
    assert not hard_figures.is_false_alarm(made.run, SimpleNamespace(begins_ns=1), "slip")
    assert hard_figures.is_false_alarm(made.run, SimpleNamespace(begins_ns=1), EXACT)


def test_a_meeting_is_when_a_culprit_and_another_have_seen_one_landmark():
    truth = {
        ("a", 1): np.array([1, 2]),
        ("b", 2): np.array([2]),
        ("c", 3): np.array([3]),
        ("a", 4): np.array([3]),
    }
    none = np.zeros((0, 3), np.float32), np.zeros((0, 6), np.float32), np.zeros((0, 128), "f4")
    sent = tuple(ObservationSet(robot, stamp, *none) for robot, stamp in truth)
    told = SimpleNamespace(
        recorded=SimpleNamespace(observation_truth=truth), events=sent, culprits=("a",), end_ns=9
    )
    assert hard_figures.first_meeting(told) == 2
    assert hard_figures.first_meeting(SimpleNamespace(**vars(told) | {"events": sent[1:]})) == 4
    told.culprits = ("c",)
    assert hard_figures.first_meeting(told) == 4
    told.culprits = ("d",)
    assert hard_figures.first_meeting(told) == 9


def test_all_have_eight_landmarks_in_common_with_those_tied_in_before_them():
    truth = {
        ("a", 1): np.arange(8),
        ("b", 2): np.arange(20, 30),
        ("c", 3): np.arange(1, 8),
        ("c", 4): np.arange(22, 30),
        ("b", 5): np.arange(1),
        ("c", 6): np.arange(1),
    }
    recorded = SimpleNamespace(observation_truth=truth)
    told = SimpleNamespace(
        recorded=recorded, names=("a", "b", "c"), culprits=("b", "c"), end_ns=9, loaded=None
    )
    assert hard_figures.all_in_common(told) == 5  # b and c at 4, of which b has the eighth of a
    told.culprits = ("b",)
    assert hard_figures.all_in_common(told) == 4
    del truth["c", 4]
    assert hard_figures.all_in_common(told) == 9


def test_what_is_in_a_loaded_map_is_in_common_with_it():
    truth = {("a", 1): np.arange(8), ("b", 2): np.arange(20, 30), ("a", 3): np.arange(20, 24)}
    recorded = SimpleNamespace(observation_truth=truth)
    names = ("a", "b")
    told = SimpleNamespace(recorded=recorded, names=names, culprits=names, end_ns=9)
    for count, expected in ((8, 2), (4, 3), (3, 9)):
        sources = {100 + n: n for n in (*range(count), *range(22, 30))}
        told.loaded = hard_changes.Loaded(None, sources)
        assert hard_figures.all_in_common(told) == expected


def test_a_robot_is_placed_when_it_is_published_where_it_is():
    def first(stamp, x):
        poses, none = np.array([[x, 0, 0]]), np.zeros((1, 3, 3))
        return hard_figures.Published(np.array([stamp]), poses, none, np.zeros((1, 3)))

    told = SimpleNamespace(culprits=("b", "c"))
    team = {"a": first(1, 9.0), "b": first(3, 0.9), "c": first(2, 0.0)}
    assert hard_figures.all_placed(team, told) == 3
    assert hard_figures.all_placed(team | {"c": first(2, 1.1)}, told) is None
    del team["c"]
    assert hard_figures.all_placed(team, told) is None


def test_frames_that_can_tell_see_two_landmarks_seen_before_the_difference():
    truth = {
        ("a", 1): np.array([1, 2]),
        ("b", 2): np.array([3]),
        ("a", 3): np.array([1, 3, 9]),
        ("a", 4): np.array([1, 9]),
        ("b", 5): np.array([1, 2]),
        ("a", 6): np.array([2, 3]),
        ("a", 7): np.array([2, 3]),
    }
    events = [SimpleNamespace(robot=robot, stamp_ns=stamp) for robot, stamp in truth]
    told = SimpleNamespace(
        recorded=SimpleNamespace(observation_truth=truth), culprits=("a",), events=events
    )
    assert hard_figures.telling_frames(told, 2, 6) == 2
    assert hard_figures.telling_frames(told, 2, 7) == 3
    told.events = events[:-1]
    assert hard_figures.telling_frames(told, 2, 7) == 2


def test_the_factor_that_differs_is_the_one_that_is_judged():
    factors = np.array([[3.3, 1.5], [3.0, 0.5]])
    assert hard_figures.factor_off(factors, (3.0, 1.0)) == pytest.approx(0.1 / np.sqrt(2))
    assert hard_figures.factor_off(factors / (3, 1), (1.0, 0.5)) == pytest.approx(np.sqrt(2))
    assert hard_figures.factor_off(np.full((2, 2), 1.1), (1.0, 1.0)) == pytest.approx(0.1)


def test_a_team_that_is_turned_as_one_has_no_error_after_aligning_and_its_nees_is_kept():
    rng = np.random.default_rng(0)
    turn = np.eye(3)
    turn[:2, :2] = rotation(0.3)
    team, noisy = {}, {}
    for name in "ab":
        truth = rng.uniform(-5, 5, (50, 3))
        spread = np.tile(np.diag([0.04, 0.01, 0.01]), (50, 1, 1))
        poses = truth @ turn.T + np.array([1.0, 2.0, 0.3])
        team[name] = hard_figures.Published(np.arange(50), poses, turn @ spread @ turn.T, truth)
        noisy[name] = team[name]._replace(poses=poses + np.array([0.0, 0.0, 0.1]))
    assert hard_figures.error(team) > 1
    straight = hard_figures.aligned(team)
    assert hard_figures.error(straight) == pytest.approx(0, abs=1e-9)
    assert straight["a"].covariances == pytest.approx(spread)
    heading = hard_figures.aligned(noisy)["b"].errors[:, 2]
    assert heading == pytest.approx(0.1)


def test_how_long_nothing_was_published_of_a_robot_that_was_lost():
    def made(*steps):
        return SimpleNamespace(
            steps=[
                SimpleNamespace(
                    stamp_ns=second * 10**9,
                    verdicts=[SimpleNamespace(robot="a", level=level)],
                    estimates=[SimpleNamespace(robot="a")] * is_published,
                )
                for second, level, is_published in steps
            ]
        )

    usual = (1, "consistent", True)
    assert hard_figures.away_s(made(usual)) is None
    found = made(usual, (2, "lost", False), (3, "lost", False), (6, "consistent", True))
    assert hard_figures.away_s(found) == 4.0
    assert hard_figures.away_s(made(usual, (2, "start wrong", False), (9, "lost", False))) == 7.0


def test_errors_are_of_the_robots_and_the_time_asked_for():
    def still(x):
        poses = np.zeros((4, 3))
        poses[:, 0] = [0, 0, x, x]
        return hard_figures.Published(np.arange(4), poses, np.zeros((4, 3, 3)), np.zeros((4, 3)))

    team = {"a": still(3.0), "b": still(4.0)}
    assert hard_figures.error(team, since_ns=0) == pytest.approx(2.5)
    assert hard_figures.error(team, since_ns=2) == pytest.approx(np.sqrt(12.5))
    assert hard_figures.error(team, ["b"], 2) == pytest.approx(4.0)
    assert hard_figures.error(team, [], 2) is None


def test_old_places_are_landmarks_of_the_map_where_what_moved_was():
    places = np.array([[0.0, 0, 0], [1.4, 0, 0], [0.1, 0, 0], [5, 5, 0]], np.float32)
    numbers = np.ones(4, np.uint32)
    landmarks = LandmarkMap(
        np.arange(4, dtype=np.uint32), places, np.ones((4, 6)), numbers, numbers, np.zeros((4, 128))
    )
    frame = SimpleNamespace(robot="a", landmarks=np.arange(4), is_new=np.ones(4, bool))
    run = SimpleNamespace(
        robots={"a": None},
        landmarks=landmarks,
        steps=[SimpleNamespace(stamp_ns=1, frames=[frame])],
        observation_truth={("a", 1): np.array([7, 8, 7, 9])},
    )
    old = {7: np.zeros(3), 8: np.array([0.4, 0, 0])}
    made = SimpleNamespace(run=run, told=SimpleNamespace(old_places=old))
    assert hard_figures.old_places(made) == 1


@pytest.fixture(scope="module")
def rows(base):
    return hard.compute(
        Job(base, EXACT, 2, 0, (EXACT, "start-far", "robot-late", "slip", *NEXT_DAY))
    )


def test_a_run_in_the_exact_world_is_its_own_reference(rows):
    exact = rows[0]
    assert exact.ratio == 1.0
    assert exact.published_m == exact.exact_published_m < 0.4
    assert exact.aligned_m <= exact.published_m
    assert exact.map_m == exact.exact_map_m
    assert exact.others_m is None
    assert not exact.is_wrong


def test_a_start_that_is_far_off_makes_the_run_worse_and_its_meeting_is_when_it_can_be_known(rows):
    far = rows[1]
    assert far.published_m > far.exact_published_m
    assert far.is_noticed
    assert 0 <= far.known_s < 112
    assert far.others_m is not None


def test_of_a_robot_that_is_late_what_comes_10_s_after_is_judged(rows):
    late = rows[2]
    assert late.ratio == late.later_m / late.exact_later_m
    assert late.exact_later_m != late.exact_published_m
    assert late.later_aligned_m <= late.later_m


def test_the_next_day_robots_are_found_in_a_map_that_stays_as_it_is(rows):
    localised, mapping = rows[4:6]
    for row in (localised, mapping):
        assert row.ratio == row.published_m / row.exact_published_m
        assert row.noticed_s is not None  # each was published first where it is
        assert row.exact_map_m > 0
    assert localised.map_m == localised.exact_map_m
    assert mapping.map_m != mapping.exact_map_m


def test_an_interrupted_study_goes_on_where_it_stopped(base, tmp_path):
    names, computed = ("swapped", EXACT, "fusion-late"), []

    def fake(job):
        computed.append((job.exact, job.robots, job.seed, job.worlds))
        return [fake_row(name, job.robots, job.seed) for name in job.worlds]

    def interrupted(function, jobs):
        yield jobs[0], fake(jobs[0])
        raise KeyboardInterrupt

    def whole(function, jobs):
        return ((job, fake(job)) for job in jobs)

    with pytest.raises(KeyboardInterrupt):
        hard.study(tmp_path, base, names, (2, 3), range(1), interrupted)
    with (tmp_path / "hard.csv").open("a") as file:
        file.write("swapped,2,0")
    found = hard.study(tmp_path, base, names, (2, 3), range(1), whole)
    assert len(found) == 6
    assert len(set(computed)) == len(computed) == 4
    hard.study(tmp_path, base, names, (2, 3), range(1), whole)
    assert len(computed) == 4
    with (tmp_path / "hard.csv").open() as file:
        written = list(csv.DictReader(file))
    assert [(row["world"], row["robots"]) for row in written] == [
        (name, k) for name in (EXACT, "swapped", "fusion-late") for k in "23"
    ]
    assert hard_table.opened(tmp_path / "hard.csv").rows == {
        hard_table.key_of(row): row for row in found
    }
    lines = (tmp_path / "hard.md").read_text().splitlines()
    assert len({line.count("|") for line in lines[:8]}) == 1


def test_rows_survive_the_file(rows, tmp_path):
    path = tmp_path / "hard.csv"
    hard_table.opened(path).write()
    hard_table.opened(path).append({hard_table.key_of(row): row for row in rows})
    for row, again in zip(rows, hard_table.opened(path).rows.values(), strict=True):
        for value, known in zip(astuple(row), astuple(again), strict=True):
            assert known == (pytest.approx(value, rel=1e-5) if isinstance(value, float) else value)


@pytest.mark.parametrize("text", ["1,2", "two", ""])
def test_teams_are_of_two_robots_or_more(text):
    with pytest.raises(InputError, match="2,3"):
        hard.teams_of(text)
    assert hard.teams_of("3,2") == (2, 3)


def test_an_unknown_world_is_refused():
    with pytest.raises(InputError, match="no row 'worse'; there are exact"):
        hard_worlds.worlds_of("slip,worse")
