"""Evidence of existence: a slow twin, the law of (X1), ghosts, what moves, hides and comes back."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import worlds
from looking import EYE, Watcher, circle, field, in_view, rays_to

from multi_robot_slam.filter import rbpf
from multi_robot_slam.filter.existence import (
    ALIKE_BY_CHANCE,
    COUNTS,
    Evidence,
    Existence,
    Placed,
    log_chance,
    published,
)
from multi_robot_slam.filter.looks import NEARLY_RAD, WITNESSES, frames_of
from multi_robot_slam.filter.running import ParticleFilter
from multi_robot_slam.filter.settings import (
    LEAST_UNKNOWNS,
    ExistenceSettings,
    RejuvenationSettings,
)
from multi_robot_slam.filter.views import BEARING_RAD, ELEVATION_RAD, NEAREST_M, RATIO, USED
from multi_robot_slam.smoothing.aliases import Aliases

SETTINGS = ExistenceSettings()
PLACES = field()
EVERYTHING = np.ones(len(PLACES), bool)


def evidence_of(watcher, places, settings=SETTINGS, robots=1, sigma=0.01):
    """Names of the landmarks, and the evidence for them."""
    names, placed = watcher.placed(places, sigma)
    frames = frames_of(watcher.records, np.array(watcher.poses), watcher.identities)
    known = Existence.nothing(robots)
    found = known.also(frames, placed, known.seen(frames), settings).evidence
    np.testing.assert_array_equal(found.ids, placed.ids)
    return names, found


def are_there(watcher, places, settings=SETTINGS, alike=(), **changes):
    """The names of the landmarks that are published; those of `alike` look like each other."""
    names, found = evidence_of(watcher, places, settings, **changes)
    descriptors = np.eye(len(names), 600, dtype=np.float32)
    group = [names.index(name) for name in alike if name in names]
    descriptors[group] = descriptors[group[:1]]
    kept = published(found, descriptors, 0.04, settings)
    return {name for name, is_kept in zip(names, kept, strict=True) if is_kept}


def row_of(watcher, places, name, **changes):
    """The counts of one landmark by their names."""
    names, found = evidence_of(watcher, places, **changes)
    return {count: int(getattr(found, count)[names.index(name)]) for count in COUNTS}


class TestSlowTwin:
    """All once more with dictionaries, one look at a time."""

    @staticmethod
    def cell(ray):
        across, far = np.hypot(ray[0], ray[1]), np.linalg.norm(ray)
        return (
            int(np.log(max(far / NEAREST_M, 1)) / np.log(RATIO)),
            int((np.arctan2(ray[1], ray[0]) + np.pi) / BEARING_RAD) % 72,
            int((np.arctan2(ray[2], across) + np.pi / 2) / ELEVATION_RAD),
        )

    def counts(self, watcher, places, sigma):
        names, _ = watcher.placed(places)
        name_of = {watcher.ids[name]: name for name in names}
        used, heights = {}, {}
        for record, own in zip(watcher.records, watcher.identities, strict=True):
            for identity, new, ray in zip(own, record.new_ids, record.ranging.rays, strict=True):
                if identity != new:
                    far, bearing, elevation = self.cell(ray)
                    key = record.robot, far, bearing
                    used[key] = used.get(key, 0) + 1
                    key = record.robot, far, elevation
                    heights[key] = heights.get(key, 0) + 1
        result = {name: dict.fromkeys(COUNTS, 0) for name in names}
        anchors, visits, known = {}, {}, set()
        for record, pose, own in zip(
            watcher.records, watcher.poses, watcher.identities, strict=True
        ):
            robot = record.robot
            old = anchors.get(robot, np.full(3, 1e9))
            turn = abs((pose[2] - old[2] + np.pi) % (2 * np.pi) - np.pi)
            is_new = np.hypot(*(pose - old)[:2]) >= SETTINGS.apart_m or turn >= SETTINGS.apart_rad
            if is_new:
                anchors[robot], visits[robot] = pose, visits.get(robot, 0) + 1
            seen = [name_of[i] for i in own.tolist()]
            again = [i for i, new in zip(own.tolist(), record.new_ids, strict=True) if i != new]
            old_rays = [
                (name_of[i], ray)
                for i, new, ray in zip(
                    own.tolist(), record.new_ids, record.ranging.rays, strict=True
                )
                if i != new
            ]
            witness = sorted(again)[WITNESSES - 1] if len(again) >= WITNESSES else np.inf
            for name in known if is_new else ():
                row = result[name]
                ray = rays_to(pose, np.array([places[name]]))[0]
                distance, bearing = np.linalg.norm(ray), np.arctan2(ray[1], ray[0])
                far, cell, elevation = self.cell(ray)
                around = [(far, cell - 1), (far, cell), (far, cell + 1), (far + 1, cell)]
                levels = [
                    key[2]
                    for key, count in heights.items()
                    if key[:2] == (robot, far) and count >= USED
                ]
                is_behind = [
                    abs(np.angle(np.exp(1j * (np.arctan2(r[1], r[0]) - bearing)))) <= NEARLY_RAD
                    and np.linalg.norm(r) >= distance
                    for other, r in old_rays
                    if other != name
                ]
                is_look = (
                    (name in seen or witness <= row["horizon"])
                    and 2 * sigma <= BEARING_RAD / 2 * distance
                    and far > 0
                    and all(used.get((robot, d, b % 72), 0) >= USED for d, b in around)
                    and min(levels, default=99) < elevation < max(levels, default=-1)
                    and (name in seen or any(is_behind))
                )
                if is_look and name in seen:
                    row["found"] += 1
                elif is_look:
                    row["failed"] += 1
                    row["in_a_row"] += 1
            for name in seen:
                row, place = result[name], (visits[robot], robot)
                if name not in known or row["last_place"] != place:
                    row["places"] += 1
                row |= {"last_place": place, "horizon": record.new_ids.max(), "in_a_row": 0}
                known.add(name)
        return [result[name] for name in names]

    def test_the_compiled_looks_are_those_of_the_slow_twin(self):
        rng = np.random.default_rng(3)
        watcher = Watcher()
        first, second = circle(laps=1.3), circle(laps=1.3, turned=-0.6)
        for f in range(len(first)):
            for robot, pose in ((0, first[f]), (1, second[f])):
                if f % 9 == 4:  # it stands
                    pose = (first, second)[robot][f - 1] + np.array([0.02, 0, 0.01])
                rows = np.flatnonzero(in_view(pose, PLACES) & (rng.random(len(PLACES)) < 0.7))
                watcher.look(pose, rows.tolist(), PLACES[rows], robot)
        _, found = evidence_of(watcher, PLACES, robots=2)
        expected = self.counts(watcher, PLACES, 0.01)
        for name in ("places", "horizon", "found", "failed", "in_a_row"):
            np.testing.assert_array_equal(
                getattr(found, name), [row[name] for row in expected], err_msg=name
            )
        assert found.found.sum() > 300
        assert found.failed.sum() > 150


class TestChance:
    """(X1)."""

    @pytest.mark.parametrize(("found", "failed", "last"), [(2, 0, 3), (3, 2, 2), (4, 1, 1)])
    def test_it_is_the_share_of_all_orders_that_end_so(self, found, failed, last):
        looks = (True,) * found + (False,) * (failed + last)
        orders = list(permutations(range(len(looks))))
        ends = [not any(looks[i] for i in order[len(looks) - last :]) for order in orders]
        chance = np.exp(log_chance(np.array([found]), np.array([failed]), np.array([last])))
        np.testing.assert_allclose(chance, np.mean(ends))

    @pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
    def test_a_detector_that_misses_is_no_reason_more_often_than_is_said(self, share):
        rng = np.random.default_rng(0)
        looks = rng.random((20_000, 19)) < share
        in_a_row = np.where(looks.any(1), looks[:, ::-1].argmax(1), 19)
        found = looks.sum(1)
        chance = log_chance(found, 19 - found - in_a_row, in_a_row)
        for limit in (0.1, 0.01):
            expected = limit * len(looks)
            assert (chance < np.log(limit)).sum() < expected + 3 * np.sqrt(expected)

    def test_what_was_found_for_hours_goes_after_four_looks(self):
        of = [log_chance(np.array([h]), np.array([0]), np.arange(6)) for h in (20, 500, 10**6)]
        for chance in of:
            np.testing.assert_array_equal(chance < np.log(1e-4), [0, 0, 0, 0, 1, 1])

    def test_nothing_is_ever_against_what_was_not_missed(self):
        found, failed = np.meshgrid(np.arange(40), np.arange(40))
        for chance in (log_chance(found, failed, 0 * found), log_chance(0 * found, failed, found)):
            np.testing.assert_allclose(chance, 0, atol=1e-12)


class TestGhosts:
    def test_what_is_always_found_is_there(self):
        toured = Watcher()
        toured.tour(circle(), PLACES, lambda f: EVERYTHING)
        names, found = evidence_of(toured, PLACES)
        assert found.failed.sum() == 0
        assert found.found.sum() > 1000
        assert are_there(toured, PLACES) == {
            n for n, places in zip(names, found.places, strict=True) if places >= 2
        }

    def test_what_was_seen_once_is_not_published(self):
        places = dict(enumerate(PLACES)) | {"ghost": np.array([0.0, 6.0, 1.0])}
        watcher = Watcher()
        watcher.tour(circle(), PLACES, lambda f: EVERYTHING)
        pose = np.array([0.0, 3.0, np.pi / 2])
        watcher.look(pose, ["ghost"], places["ghost"][None])
        assert "ghost" not in are_there(watcher, places)
        assert "ghost" in are_there(watcher, places, replace(SETTINGS, published_from=1))
        standing = pose + 0.05
        watcher.look(standing, ["ghost"], places["ghost"][None])
        assert "ghost" not in are_there(watcher, places)
        watcher.look(pose + np.array([0.3, 0, 0]), ["ghost"], places["ghost"][None])
        assert "ghost" in are_there(watcher, places)

    def test_another_robot_has_another_place(self):
        watcher = Watcher()
        for robot in range(2):
            watcher.look(np.zeros(3), ["it"], np.array([[4.0, 0, 1]]), robot)
        assert are_there(watcher, {"it": [4.0, 0, 1]}, robots=2) == {"it"}


class TestMoved:
    LAPS, PER_LAP = 4, 38
    WHICH = 7

    def moving(self, goes_at, comes_back_at=10**9, found_anew=False):
        """A tour in which one landmark is gone for a while, and the places of all."""
        often = np.array(
            [sum(in_view(pose, PLACES[[n]])[0] for pose in circle(1)) for n in range(len(PLACES))]
        )
        which = int(np.argsort(-often)[self.WHICH])
        places = dict(enumerate(PLACES)) | {"anew": PLACES[which] + [0.9, 0.4, 0]}
        watcher = Watcher()
        for f, pose in enumerate(circle(self.LAPS)):
            rows = np.flatnonzero(in_view(pose, PLACES))
            is_gone = goes_at <= f < comes_back_at
            names = [int(n) for n in rows if not (is_gone and n == which)]
            if found_anew and is_gone and in_view(pose, places["anew"][None])[0]:
                names.append("anew")
            watcher.look(pose, names, np.array([places[n] for n in names]).reshape(-1, 3))
        return watcher, places, which

    def test_what_is_no_longer_found_goes_and_nothing_else(self):
        watcher, places, which = self.moving(goes_at=2 * self.PER_LAP)
        row = row_of(watcher, places, which)
        assert row["found"] >= 8
        assert row["in_a_row"] >= 5
        whole, _, _ = self.moving(goes_at=10**9)
        assert are_there(whole, places) - are_there(watcher, places) == {which}

    def test_it_is_back_when_it_is_seen_again(self):
        gone, places, which = self.moving(2 * self.PER_LAP)
        last = max(f for f, p in enumerate(gone.poses) if in_view(p, PLACES[[which]])[0])
        watcher, _, _ = self.moving(2 * self.PER_LAP, comes_back_at=last)
        assert which not in are_there(gone, places)
        assert which in are_there(watcher, places)

    def test_what_looks_like_it_elsewhere_says_so_sooner(self):
        limit = ExistenceSettings(gone_below=1e-6)
        alone = self.moving(3 * self.PER_LAP)
        watcher, places, which = self.moving(3 * self.PER_LAP, found_anew=True)
        assert row_of(watcher, places, "anew")["places"] >= 2
        assert which in are_there(alone[0], places, limit)
        assert which in are_there(watcher, places, limit)
        there = are_there(watcher, places, limit, alike=(which, "anew"))
        assert which not in there
        assert "anew" in there

    def test_two_that_look_alike_and_are_both_found_stay(self):
        watcher = Watcher()
        watcher.tour(circle(3), PLACES, lambda f: EVERYTHING)
        everything = are_there(watcher, PLACES)
        assert are_there(watcher, PLACES, alike=range(len(PLACES))) == everything

    def test_a_newer_one_alike_counts_as_found_as_easily(self):
        """(X1) of both together, and the odds that there are two of a kind."""
        found = Evidence(
            np.array([1, 50]),
            *np.array([[5, 9], [0, 0], [40, 90], [1, 6], [3, 0], [3, 0]]),
        )
        chance = log_chance(np.array([7]), np.array([0]), np.array([3]))[0] + np.log(
            ALIKE_BY_CHANCE
        )
        alike = np.ones((2, 128), np.float32) / np.sqrt(128, dtype=np.float32)
        for factor, stays in ((0.99, True), (1.01, False)):
            settings = ExistenceSettings(gone_below=factor * np.exp(chance))
            np.testing.assert_array_equal(published(found, alike, 0.04, settings), [stays, True])
        earlier = replace(found, horizon=np.array([60, 90]))
        np.testing.assert_array_equal(published(earlier, alike, 0.04, settings), [True, True])


class TestNoLook:
    """What says nothing of a landmark."""

    def test_what_is_out_of_view(self):
        watcher = Watcher()
        watcher.tour(circle(1), PLACES, lambda f: EVERYTHING)
        before = are_there(watcher, PLACES)
        is_far = np.abs(PLACES[:, 0]) > 5
        watcher.tour(circle(2, turned=np.pi / 2), PLACES, lambda f: ~is_far)
        rows = np.flatnonzero(is_far)
        _, found = evidence_of(watcher, PLACES)
        names, _ = watcher.placed(PLACES)
        looked = {n for n, row in zip(names, found.in_a_row, strict=True) if row}
        in_sight = {
            int(n) for n in rows if any(in_view(p, PLACES[[n]])[0] for p in circle(2, turned=1.57))
        }
        assert looked <= in_sight
        assert before - are_there(watcher, PLACES) <= in_sight

    def test_what_is_hidden(self):
        """From half time on a wall stands all around: what is behind it is out of sight."""
        watcher = Watcher()
        watcher.tour(circle(2), PLACES, lambda f: EVERYTHING)
        is_behind = np.hypot(PLACES[:, 0], PLACES[:, 1]) > 5
        before = are_there(watcher, PLACES)
        watcher.tour(circle(3), PLACES, lambda f: ~is_behind)
        assert before <= are_there(watcher, PLACES)
        hidden = [n for n in before if is_behind[n]]
        names, found = evidence_of(watcher, PLACES)
        in_a_row = dict(zip(names, found.in_a_row, strict=True))
        assert len(hidden) > 50
        assert sum(in_a_row[n] > 0 for n in hidden) < 0.05 * len(hidden)

    def test_what_a_robot_says_that_does_not_know_where_it_is(self):
        """It comes back 2 m off and makes everything anew."""
        watcher = Watcher()
        watcher.tour(circle(2), PLACES, lambda f: EVERYTHING)
        before = are_there(watcher, PLACES)
        places = dict(enumerate(PLACES))
        for pose in circle(2):
            rows = np.flatnonzero(in_view(pose, PLACES))
            off = pose + np.array([2.0, 1.0, 0])
            own = {f"anew {n}": PLACES[n] + [2.0, 1.0, 0] for n in rows}
            watcher.look(off, list(own), np.array(list(own.values())).reshape(-1, 3))
            places |= own
        assert before <= are_there(watcher, places)
        names, found = evidence_of(watcher, places)
        of = dict(zip(names, found.in_a_row, strict=True))
        assert all(of[n] == 0 for n in before)

    def test_what_stands_still(self):
        """A robot that rests and misses the same thing in every frame has looked once."""
        watcher = Watcher()
        watcher.tour(circle(2), PLACES, lambda f: EVERYTHING)
        pose = circle(1)[10]
        rows = np.flatnonzero(in_view(pose, PLACES))
        gone = rows[np.arange(len(rows)) % 3 == 0]
        is_there = ~np.isin(np.arange(len(PLACES)), gone)
        watcher.tour(np.tile(pose, (50, 1)), PLACES, lambda f: is_there)
        _, found = evidence_of(watcher, PLACES)
        assert found.in_a_row.max() == 1

    def test_a_landmark_whose_place_is_vague(self):
        watcher = Watcher()
        watcher.tour(circle(2), PLACES, lambda f: EVERYTHING)
        watcher.tour(circle(1), PLACES, lambda f: np.arange(len(PLACES)) % 2 == 0)
        assert evidence_of(watcher, PLACES)[1].failed.sum() > 100
        assert evidence_of(watcher, PLACES, sigma=1.0)[1].failed.sum() == 0


class TestSettling:
    """Evidence of frames that leave."""

    @staticmethod
    def toured():
        rng = np.random.default_rng(1)
        watcher = Watcher()
        watcher.tour(circle(2), PLACES, lambda f: rng.random(len(PLACES)) < 0.8)
        return watcher

    @pytest.mark.parametrize("parts", [[20, 30, 100], [0, 1, 75], [76]])
    def test_in_parts_as_at_once(self, parts):
        toured = self.toured()
        _, placed = toured.placed(PLACES)
        poses = np.array(toured.poses)
        everything = frames_of(toured.records, poses, toured.identities)
        views = Existence.nothing(1).seen(everything)
        whole = Existence.nothing(1).also(everything, placed, views, SETTINGS)
        partly, first = Existence.nothing(1), 0
        for last in [*np.cumsum(parts), len(poses)]:
            own = slice(first, last)
            frames = frames_of(toured.records[own], poses[own], toured.identities[own])
            partly, first = partly.also(frames, placed, views, SETTINGS), last
        for name in ("ids", *COUNTS):
            np.testing.assert_array_equal(
                getattr(partly.evidence, name), getattr(whole.evidence, name)
            )
        np.testing.assert_array_equal(partly.views.bearings, whole.views.bearings)
        np.testing.assert_array_equal(partly.views.elevations, whole.views.elevations)
        np.testing.assert_array_equal(partly.anchors, whole.anchors)
        np.testing.assert_array_equal(partly.visits, whole.visits)

    def test_no_frames_change_nothing(self):
        known = Existence.nothing(2)
        nothing = frames_of([], np.empty((0, 3)), [])
        _, placed = Watcher().placed({})
        found = known.also(nothing, placed, known.seen(nothing), SETTINGS)
        assert len(found.evidence.ids) == 0
        assert found.renamed(Aliases().joined(np.array([[1, 2]]))).evidence.ids.size == 0

    def test_joined_landmarks_are_one(self):
        """Looks that failed for the one while it was seen under the other id do not count."""
        found = Evidence(
            np.array([1, 5, 9]),
            *np.array([[4, 2, 3], [7, 8, 9], [10, 99, 50], [6, 1, 2], [5, 1, 3], [4, 1, 2]]),
        )
        joined = found.renamed(Aliases().joined(np.array([[1, 9]])))
        np.testing.assert_array_equal(joined.ids, [1, 5])
        expected = [[7, 2], [9, 8], [50, 99], [8, 1], [1 + 1 + 2, 1], [2, 1]]
        for name, values in zip(COUNTS, expected, strict=True):
            np.testing.assert_array_equal(getattr(joined, name), values, err_msg=name)
        assert found.renamed(Aliases().joined(np.array([[20, 30]]))) is found

    def test_what_is_forgotten_is_unknown(self):
        toured = self.toured()
        _, placed = toured.placed(PLACES)
        frames = frames_of(toured.records, np.array(toured.poses), toured.identities)
        known = Existence.nothing(1)
        found = known.also(frames, placed, known.seen(frames), SETTINGS)
        fewer = found.forget(placed.ids[::2]).evidence
        np.testing.assert_array_equal(fewer.ids, placed.ids[1::2])
        np.testing.assert_array_equal(fewer.found, found.evidence.found[1::2])


def test_the_eye_is_where_the_rays_begin():
    watcher = Watcher()
    watcher.look(np.zeros(3), [0, 1], PLACES[:2])
    watcher.look(np.zeros(3), [], np.empty((0, 3)))
    frames = frames_of(watcher.records, np.array(watcher.poses), watcher.identities)
    np.testing.assert_allclose(frames.eyes, [EYE, np.zeros(3)])
    np.testing.assert_array_equal(frames.newest, [1, -1])
    np.testing.assert_array_equal(frames.starts, [0, 2, 2])
    np.testing.assert_array_equal(frames.is_known, [False, False])


def test_frames_that_settled_count_as_if_they_had_stayed():
    """The places of each landmark, from the counts of settled frames and from all frames kept."""
    small = RejuvenationSettings(ancestors_below=1.0, delay_s=0.0, unknowns=LEAST_UNKNOWNS)
    own = worlds.settings(
        proposal="informed", particles=30, rejuvenation=small, existence=SETTINGS, threads=1
    )
    particles = ParticleFilter(worlds.START, own, np.random.default_rng(1))
    for frames in worlds.drive(seed=4, steps=45):
        particles.step(frames)
    state = particles.state
    assert len(state.history.settled) > 60
    best = rbpf.best_particle(state)
    columns, values = state.landmarks.of_particle(best)
    ids = state.landmarks.ids[columns].astype(np.int64)
    counts = []
    for known, past in (
        (state.existence, list(state.history.lineage(best))[::-1]),
        (Existence.nothing(3), state.history.whole_lineage(best)),
    ):
        seen = frames_of(
            [record for record, _ in past],
            np.array([record.poses[:, row] for record, row in past]),
            [record.matches[:, row] for record, row in past],
        )
        placed = Placed.of(ids, values)
        found = known.also(seen, placed, known.seen(seen), SETTINGS)
        counts.append((found.evidence.of(ids).places, found.visits, *found.views))
    assert (counts[0][0] > 10).sum() > 10
    for settled, kept in zip(*counts, strict=True):
        np.testing.assert_array_equal(settled, kept)
    assert np.isin(state.existence.evidence.ids, ids).all()
