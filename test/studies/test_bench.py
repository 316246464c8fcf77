"""The benchmark measures a sound run and writes what it promises; nothing here depends on time."""

import json

import numpy as np
import pytest
from numba import njit

from msg_defs.errors import InputError
from multi_robot_slam.models import stereo
from multi_robot_slam.models.motion import MotionSettings, increment, standard_deviations
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.studies import (
    bench,
    bench_limits,
    bench_rows,
    bench_table,
    machine,
    rivals,
    session,
)
from multi_robot_slam.studies.session import Clock, Session
from multi_robot_slam.studies.workload import World

BENCH = ("study", "bench")
TINY = bench_limits.Sizes(
    particles=100,
    few_particles=40,
    default_particles=60,
    textbook_particles=2,
    robots=2,
    observations=6,
    landmarks=60,
    small_map=40,
    large_map=80,
    memory_map=90,
    grown_map=150,
    literal_map=20,
    steps=5,
    rounds=1,
    many_robots=3,
    rate_hz=2.0,
    start_s=2.0,
    live_s=6.0,
    bag_s=1.0,
)


@pytest.fixture(scope="module")
def rows():
    return bench_rows.measure(TINY)


def test_every_figure_is_there_in_order_and_finite(rows):
    assert [row.name for row in rows] == list(bench_table.TARGETS)
    for row in rows:
        assert np.isfinite([row.value, row.target, row.limit, *row.spread]).all()
        assert row.value > 0
        assert row.limit > 0
        assert row.spread[0] <= row.spread[1]


def test_a_target_is_met_from_the_right_side(rows):
    for row in rows:
        is_least = row.name.startswith(("speedup", "run_times"))
        assert row.met == (row.value >= row.target if is_least else row.value <= row.target)


def test_json_is_a_list_of_objects(rows):
    written = json.loads(bench.to_json(rows))
    assert [set(row) >= {"name", "value", "unit", "target", "limit"} for row in written]
    assert [bench_table.Row(**row | {"spread": tuple(row["spread"])}) for row in written] == rows


def test_a_survey_has_a_clock_for_each_step_and_sees_what_was_asked():
    team = Session(40, 1, 20, 5, "informed", ring=400)
    steps = team.state.steps
    clocks = team.survey(120)
    assert len(clocks) == team.state.steps - steps > 0
    assert len(team.world.seen) >= 120


@pytest.mark.parametrize("proposal", ["motion", "informed"])
def test_the_workload_is_matched_right_and_makes_the_map_it_promises(proposal):
    team = Session(150, robots=3, particles=100, observations=10, proposal=proposal)
    assert team.settings.resample_below == 1
    known = team.size()
    assert len(team.world.seen) >= 150
    assert known >= 0.95 * len(team.world.seen)
    for _ in range(20):
        team.step()
    assert team.right_share() >= session.LEAST_RIGHT
    assert team.size() > known  # some landmarks are new, also while time is taken


def test_another_seed_is_another_world():
    teams = [Session(40, 1, 20, 5, "informed", seed) for seed in (0, 0, 1)]
    one, same, other = (team.state.poses[0, 0] for team in teams)
    np.testing.assert_array_equal(one, same)
    assert (one != other).any()


def test_a_run_that_matches_wrongly_is_no_benchmark():
    team = Session(60, robots=1, particles=50, observations=10, proposal="informed")
    team.world._descriptors = np.roll(team.world._descriptors, 1, axis=0)
    team.step()
    with pytest.raises(RuntimeError, match="broken run"):
        team.right_share()
    with pytest.raises(RuntimeError, match="broken run"):
        session.require(np.nan, "matches")


def test_each_landmark_is_observed_in_as_many_steps_as_promised():
    world = World(200, 2, MotionSettings(), observations=15, seed=1)
    counts = np.zeros(200, int)
    for _ in range(120):
        for frame in world.drive(session.SPEED):
            counts[world.latest[frame.robot]] += 1
    passed = counts[30:60]  # not in sight at the start, out of sight at the end
    assert passed.tolist() == [15 / session.SPEED] * 30


def test_observations_and_odometry_have_the_noise_they_state():
    noise = MotionSettings()
    world = World(400, 2, noise, observations=15, seed=2)
    squared, deviations = [], []
    poses = world.poses()
    for step in range(120):
        for frame, before, after in zip(world.drive(2.0), poses, world.poses(), strict=True):
            v, R = frame.positions, frame.covariances
            exact = world._landmarks[world.latest[frame.robot]] - [*after[:2], 0]
            error = v - stereo.to_map([0, 0, -after[2]], exact)
            squared.append(
                np.einsum("bi,bi->b", error, np.linalg.solve(unpack(R), error[..., None])[..., 0])
            )
            if step:
                u = increment(before, after)
                deviations.append((frame.motion - u) / standard_deviations(u, 0.0, noise))
        poses = world.poses()
    assert np.mean(squared) == pytest.approx(3, abs=5 * np.sqrt(6 / np.size(squared)))
    assert np.mean(np.square(deviations)) == pytest.approx(
        1, abs=5 * np.sqrt(2 / np.size(deviations))
    )


def test_sessions_take_turns():
    class Fake:
        def __init__(self, name):
            self.name = name

        def step(self):
            order.append(self.name)
            return Clock(1, 1, 1)

    order = []
    clocks = session.take_turns({"a": Fake("a"), "b": Fake("b")}, 3)
    assert order == ["a", "b"] * 4
    assert {name: len(times) for name, times in clocks.items()} == {"a": 3, "b": 3}


def test_a_step_is_as_long_as_its_parts_and_the_filter_is_left_as_it_was():
    team = Session(30, robots=1, particles=20, observations=5, proposal="motion")
    before = dict(session.rbpf.PROPOSALS), dict(vars(team.state.landmarks))
    clock = team.step()
    assert clock.step > clock.proposal > clock.gather > 0
    proposals, attributes = before
    assert proposals == session.rbpf.PROPOSALS
    assert vars(team.state.landmarks).keys() == attributes.keys()


def test_operations_are_counted_in_the_loops_alone():
    @njit
    def kernel(x, a):
        b = a * a + a
        for i in range(x.size):
            x[i + 1] = x[i] * a - b
            x[i] /= a
        return x * 2

    assert machine.operations(kernel) == 3


def test_the_yardstick_loops_do_their_work():
    source, target = np.arange(1000, dtype=np.float32), np.zeros(1000, np.float32)
    machine.copy(source, target)
    np.testing.assert_array_equal(source, target)
    values = np.full(5, 1, np.float32)
    machine.multiply_add(values, np.float32(0.5), 2)
    expected = 1.0
    for _ in range(2 * machine.MULTIPLY_ADDS):
        expected = expected * 0.5 + 0.5
    np.testing.assert_allclose(values, expected, rtol=1e-6)
    rates = machine.measure(working_set=100_000, passes=2)
    assert rates.ns_per_byte > 0
    assert rates.ns_per_operation > 0


def test_bytes_are_counted_once_wherever_they_hang():
    class Thing:
        def __init__(self, **parts):
            vars(self).update(parts)

    whole = np.zeros((10, 4), np.float32)
    thing = Thing(a=whole, b=[whole[2:4], (whole.T, np.zeros(3))], c=Thing(d="text", e=7))
    assert bench_rows.bytes_of(thing, set()) == 160 + 24


@pytest.mark.parametrize("verb", [BENCH, ("bench",)], ids=["study", "other_programs"])
def test_command_prints_and_writes_the_rows(command, monkeypatch, tmp_path, verb):
    asked = []
    row = bench_table.Row("first_step_s", 0.5, "s", 2.0, 0.2, (0.4, 0.6), True, "a note")

    def fake_run(quick, seed):
        asked.append((quick, seed))
        return [row]

    monkeypatch.setattr(bench, "run", fake_run)
    code, out, _ = command(*verb, "--quick", "--first-seed", "7", "--json", tmp_path / "rows.json")
    assert code == 0
    assert asked == [(True, 7)]
    assert "first_step_s" in out
    assert "a note" in out
    assert json.loads((tmp_path / "rows.json").read_text())[0]["value"] == 0.5


def test_command_refuses_what_it_cannot_do(command, monkeypatch, tmp_path):
    code, _, err = command(*BENCH, "--json", tmp_path / "no" / "rows.json")
    assert code == 2
    assert "choose another" in err
    monkeypatch.setattr(rivals, "LITERAL", tmp_path / "literal_algorithm1.py")
    code, _, err = command(*BENCH)
    assert code == 2
    assert "source checkout" in err
    with pytest.raises(InputError):
        rivals.check_literal()
