"""What a gap in the odometry hides: against slow formulas, and against ways driven at random."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msg_defs.types import PoseSample
from multi_robot_slam.config import Config, Plausible
from multi_robot_slam.models.motion import (
    NO_EXTRA,
    MotionSettings,
    increment,
    move,
    standard_deviations,
)
from multi_robot_slam.pipeline.gaps import Gap, Instant, Rates
from multi_robot_slam.pipeline.odometry import MOST_GAPS, RESET, Odometry
from multi_robot_slam.pipeline.pairing import RobotInputs

SECOND = 10**9
NOISE = MotionSettings(0.03, 0.01, 0.02, 0.05, yaw_per_sqrt_s=0.01)
NONE = MotionSettings(0.0, 0.0, 0.0, 0.0)
POSES = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


def rotation(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def slow_hidden(gap, begin, end, noise):
    """(G1) to (G6) in the map, with matrices, and a sum over the way."""
    T = (gap.end.stamp_ns - gap.start.stamp_ns) / 1e9
    s, t = ((np.clip(i.stamp_ns, gap.start.stamp_ns, gap.end.stamp_ns) - gap.start.stamp_ns) / 1e9
            for i in (begin, end))  # fmt: skip
    s, t = s / T, t / T
    ahead, turn = increment(gap.start.pose, gap.end.pose)[[0, 2]]
    chord = np.hypot(*(gap.end.pose - gap.start.pose)[:2])
    own = np.array([chord if ahead >= 0 else -chord, turn]) / T
    rates = gap.before
    square_v, square_w = rates.square
    change_v, change_w = (
        min(rates.changing[i] * T / 2, 2 * (rates.square[i] - rates.mean[i] ** 2))
        + (2 * (own[i] - rates.last[i])) ** 2
        for i in (0, 1)
    )
    L, A = max(chord, np.sqrt(square_v) * T), max(abs(turn), np.sqrt(square_w) * T)
    along, yaw = np.sqrt(change_v) * T / 4, np.sqrt(change_w) * T / 4
    across = L * np.sqrt(turn**2 / 64 + yaw**2 / 8)
    bridge = 4 * (t - s) * (1 - (t - s))
    dx, dy = (gap.end.pose - gap.start.pose)[:2]
    R = rotation(np.arctan2(dy, dx))
    total = bridge * R @ np.diag([along**2, across**2]) @ R.T
    f, l = noise.forward_per_sqrt_m**2, noise.left_per_sqrt_m**2  # noqa: E741
    leak = L * min(A * A / 3, 1)
    R = rotation(gap.start.pose[2])
    total += (t - s) * R @ np.diag([f * (L - chord) + l * leak, l * (L - chord) + f * leak]) @ R.T
    turned = (
        noise.yaw_per_sqrt_m**2 * L + noise.yaw_per_sqrt_rad**2 * A + noise.yaw_per_sqrt_s**2 * T
    )
    for share in s + (t - s) * (np.arange(500) + 0.5) / 500:
        x, y = end.pose[:2] - (gap.start.pose + share * (gap.end.pose - gap.start.pose))[:2]
        total += (t - s) * turned / 500 * np.outer([-y, x], [-y, x])
    x, y = (end.pose - begin.pose)[:2]
    total += 4 * s * (1 - s) * yaw**2 * np.outer([-y, x], [-y, x])
    R = rotation(begin.pose[2])
    variances = np.diag(R.T @ total @ R)
    more = noise.yaw_per_sqrt_m**2 * (L - chord) + noise.yaw_per_sqrt_rad**2 * (A - abs(turn))
    return np.append(variances, bridge * yaw**2 + (t - s) * more)


@settings(max_examples=40)
@given(
    POSES,
    POSES,
    POSES,
    POSES,
    st.tuples(*[st.floats(0, 2)] * 8),
    st.tuples(*[st.floats(0, 9)] * 2),
)
def test_what_is_hidden_is_the_slow_formula_s(start, end, first, last, rates, stamps):
    mean, more, changing, before = np.array(rates).reshape(4, 2)
    one, other = sorted(stamps)
    known = Rates.unknown(Instant(0, start))._replace(
        mean=mean, square=mean**2 + more**2, changing=changing, last=before
    )
    gap = Gap(Instant(3 * SECOND, start), Instant(5 * SECOND, end), known)
    instants = Instant(int(one * SECOND), first), Instant(int(other * SECOND) + 1, last)
    expected = slow_hidden(gap, *instants, NOISE)
    covers = min(instants[1].stamp_ns, 5 * SECOND) > max(instants[0].stamp_ns, 3 * SECOND)
    np.testing.assert_allclose(
        gap.hidden(*instants, NOISE), expected * covers, rtol=1e-5, atol=1e-9
    )


@given(st.lists(st.tuples(st.floats(0, 2), st.floats(-1, 1), st.floats(0.3, 5)), min_size=1))
def test_rates_are_means_over_time_that_fade(moved):
    rates, second, pose = Rates.unknown(Instant(0, np.zeros(3))), 0.0, np.zeros((3, 1))
    own, lasted = [], []
    for distance, turn, seconds in moved:
        second += seconds
        move(pose, np.array([[distance], [0.0], [turn]]))
        rates = rates.until(Instant(round(second * 1e9), pose[:, 0].copy()))
        own.append([distance / seconds, turn / seconds])
        lasted.append(seconds)
    own, lasted = np.array(own), np.array(lasted)
    weights = lasted * np.exp(-(second - np.cumsum(lasted)) / 30)
    np.testing.assert_allclose(rates.mean, np.average(own, 0, weights), atol=1e-6)
    np.testing.assert_allclose(rates.square, np.average(own**2, 0, weights), atol=1e-6)
    np.testing.assert_allclose(rates.last, own[-1], atol=1e-6)
    if len(own) > 1:
        changes = np.diff(own, axis=0) ** 2 / ((lasted[1:] + lasted[:-1]) / 2)[:, None]
        np.testing.assert_allclose(
            rates.changing, np.average(changes, 0, weights[1:]), rtol=1e-5, atol=1e-6
        )


def odometry(noise=NONE, told=None):
    tell = (lambda sample, refusal: None) if told is None else (lambda s, r: told.append(r))
    return Odometry(Plausible(), noise, tell)


def feed(taker, stamps_s, poses):
    for second, pose in zip(stamps_s, poses, strict=True):
        taker.take(PoseSample("a", round(second * SECOND), np.array(pose, float)))


def driven(rng, steps):
    """A way with bends and stops: poses (T, 3) every 50 ms, speeds that change every 2 s or so."""
    at = np.flatnonzero(rng.random(steps) < 0.05 / 2.0)
    speeds, rates = np.zeros((2, steps))
    for first, last in pairwise([*at, steps]):
        speeds[first:last] = rng.uniform(0, 1) * (rng.random() < 0.8)
        rates[first:last] = rng.normal(0, 0.4)
    yaws = np.cumsum(np.append(0, rates * 0.05))
    x, y = (np.cumsum(np.append(0, speeds * 0.05 * f(yaws[:-1]))) for f in (np.cos, np.sin))
    return np.column_stack([x, y, yaws])


@pytest.mark.parametrize("missing", [3, 19, 79])
@pytest.mark.parametrize("share", [0.25, 0.5])
def test_the_true_pose_within_a_gap_is_as_far_off_as_told(missing, share):
    """Of 100 ways: two sigmas hold at least 90 % of the poses, and all in all they are no wider.

    They must hold whoever changes speed as seldom, hence are wider than one kind of way needs.
    """
    rng = np.random.default_rng(missing)
    first, last = 200, 200 + missing + 1
    at = first + round(share * (last - first))
    errors, told = [], []
    for _ in range(100):
        way = driven(rng, last)
        taker = odometry()
        feed(taker, np.arange(first + 1) / 20, way[: first + 1])
        taker.motion_to(first * SECOND // 20)
        taker.use()
        feed(taker, [last / 20], way[last:])
        moved = taker.motion_to(at * SECOND // 20)
        errors.append(increment(way[first], way[at]) - moved.motion)
        told.append(np.maximum(moved.extra, 1e-6))
    errors, told = np.abs(errors), np.array(told)
    within = np.mean(errors < 2 * told, axis=0)
    assert (within >= 0.9).all(), within
    widths = np.sqrt(np.mean(np.square(told), axis=0) / np.mean(np.square(errors), axis=0))
    assert ((widths > 0.8) & (widths < 5)).all(), widths


def test_at_the_samples_themselves_a_gap_hides_nothing_of_wheels_without_noise():
    taker = odometry()
    stamps = [*np.arange(0, 4, 0.1), 6.0, 6.1]
    feed(taker, stamps, [(t, 0.1 * t, 0.05 * t) for t in stamps])
    taker.motion_to(3 * SECOND)
    taker.use()
    moved = taker.motion_to(round(6.1 * SECOND))
    np.testing.assert_allclose(moved.extra, 0, atol=1e-6)
    assert taker.motion_to(5 * SECOND).extra[1] > 0.01


def test_noise_of_a_straight_way_in_one_go_is_that_of_its_small_steps():
    """(7) and what the gap adds, against wheels that err in steps of a centimetre."""
    rng = np.random.default_rng(0)
    taker, stamps = odometry(NOISE), [*np.arange(0, 3, 0.1), 12.9]
    feed(taker, stamps, [(t, 0, 0) for t in stamps])
    taker.motion_to(round(2.9 * SECOND))
    taker.use()
    motion, seconds, extra = taker.motion_to(round(12.9 * SECOND))
    told = standard_deviations(motion, seconds, NOISE, extra)
    ends = np.zeros((3, 2000))
    step = np.array([0.01, 0.0, 0.0])
    sigma = standard_deviations(step, 0.01, NOISE)[:, None]
    for _ in range(1000):
        move(ends, step[:, None] + sigma * rng.standard_normal(ends.shape))
    np.testing.assert_allclose(told, ends.std(axis=1), rtol=0.07)


@pytest.mark.parametrize("bend", [0.1, 0.3])
def test_noise_of_a_way_with_bends_is_no_less_than_told(bend):
    """A robot that swings left and right at the same rates all the time, before and in the gap."""
    rng = np.random.default_rng(1)
    times = np.arange(0, 40, 0.1)
    rates = bend * np.sign(np.sin(times))
    poses = np.zeros((3, len(times)))
    for k in range(1, len(times)):
        poses[:, k] = poses[:, k - 1]
        move(poses[:, k : k + 1], np.array([[0.05], [0.0], [0.1 * rates[k]]]))
    taker = odometry(NOISE)
    kept = np.r_[:200, 399]
    feed(taker, times[kept], poses.T[kept])
    taker.motion_to(round(times[199] * SECOND))
    taker.use()
    motion, seconds, extra = taker.motion_to(round(times[399] * SECOND))
    told = standard_deviations(motion, seconds, NOISE, extra)
    ends = np.tile(poses[:, 199:200], 2000)
    for k in range(200, 400):
        step = np.array([0.05, 0.0, 0.1 * rates[k]])
        sigma = standard_deviations(step, 0.1, NOISE)[:, None]
        move(ends, step[:, None] + sigma * rng.standard_normal(ends.shape))
    true = np.array([increment(poses[:, 199], end) for end in ends.T]).std(axis=0)
    assert (told > 0.95 * true).all(), (told, true)
    assert (told < 2 * true).all(), (told, true)


@given(
    st.floats(0.5, 200), st.floats(0, 0.1), st.integers(0, 1000), st.floats(0.1, 0.9)
)  # fmt: skip
def test_regular_odometry_of_any_rate_has_no_gap(rate_hz, jitter, seed, share):
    rng = np.random.default_rng(seed)
    taker = odometry(NOISE)
    stamps = (np.arange(60) + rng.uniform(-jitter, jitter, 60) + 1) / rate_hz
    feed(taker, stamps, rng.normal(0, 0.01, (60, 3)))
    taker.motion_to(round(stamps[0] * SECOND))
    taker.use()
    moved = taker.motion_to(round((stamps[30] + share * (stamps[31] - stamps[30])) * SECOND))
    assert moved.extra is NO_EXTRA


def test_two_intervals_in_turn_are_usual():
    taker = odometry(NOISE)
    stamps = np.cumsum(np.tile([0.2, 0.8], 40))
    feed(taker, stamps, np.zeros((80, 3)))
    taker.motion_to(SECOND)
    taker.use()
    assert taker.motion_to(int(30.5 * SECOND)).extra is NO_EXTRA


def test_a_new_rate_is_usual_after_a_while():
    taker = odometry(NOISE)
    stamps = [*np.arange(0, 5, 0.05), *np.arange(5, 25, 0.5)]
    feed(taker, stamps, [(0.2 * t, 0, 0) for t in stamps])
    taker.motion_to(int(15.2 * SECOND))
    taker.use()
    assert taker.motion_to(int(20.2 * SECOND)).extra is NO_EXTRA


def test_a_sample_that_is_taken_back_takes_its_gap_with_it():
    taker = odometry(NOISE)
    stamps = [*np.arange(0, 3, 0.1), 4.0, *np.arange(3.0, 3.95, 0.1)]
    feed(taker, stamps, [(t, 0, 0) for t in stamps])
    taker.motion_to(2 * SECOND)
    taker.use()
    assert taker.motion_to(int(3.85 * SECOND)).extra is NO_EXTRA


def test_a_reset_hides_as_much_as_the_robot_may_have_driven_meanwhile():
    told = []
    taker = odometry(NONE, told)
    feed(taker, np.arange(0, 5, 0.1), [(0.8 * t, 0, 0.2 * t) for t in np.arange(0, 5, 0.1)])
    taker.motion_to(round(4.9 * SECOND))
    taker.use()
    feed(taker, [6.9, 7.0, 7.1], [(400, 0, 0)] * 3)
    moved = taker.motion_to(round(7.1 * SECOND))
    assert told == [RESET]
    np.testing.assert_allclose(moved.motion, 0, atol=1e-9)
    np.testing.assert_allclose(moved.extra, [1.6 / 2**0.5, 1.6 / 2**0.5, 0.4], rtol=1e-3)


def test_gaps_without_number_are_taken_for_longer_ones():
    taker, few = odometry(NOISE), odometry(NOISE)
    kept = [k for k in range(4000) if k % 4]
    for one, until in ((taker, 4000), (few, 3 * MOST_GAPS)):
        own = [k for k in kept if k < until]
        feed(one, np.array(own) / 10, [(0.01 * k, 0, 0) for k in own])
        one.motion_to(2 * SECOND)
        one.use()
    assert len(taker._gaps) == MOST_GAPS
    assert (taker.motion_to_newest().extra[:2] > few.motion_to_newest().extra[:2]).all()


def test_a_frame_after_a_gap_has_what_it_hides():
    inputs = RobotInputs(0, Config(), lambda event, refusal: None)
    stamps = [*np.arange(1, 5, 0.1), 8.0]
    feed(inputs.odometry, stamps, [(t, 0.1 * t, 0.0) for t in stamps])
    inputs.frame(4 * SECOND, None, None)
    inputs.odometry.use()
    frame = inputs.frame(6 * SECOND, None, None)
    assert (frame.extra[1:] > 0).all()
    np.testing.assert_array_equal(frame.extra, inputs.odometry.motion_to(6 * SECOND).extra)
