"""Whatever decodable nonsense comes in, the run goes on and says what it lost."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import recordings
from hypothesis import given
from hypothesis import strategies as st

from msg_defs import scenario_file
from msg_defs.errors import InputError
from msg_defs.types import ObservationSet, PoseSample
from multi_robot_slam.config import SECTION, Config, Plausible
from multi_robot_slam.filter import rbpf
from multi_robot_slam.filter.settings import FilterSettings, RejuvenationSettings
from multi_robot_slam.models.motion import MotionSettings
from multi_robot_slam.pipeline import offline, plausibility
from multi_robot_slam.pipeline.odometry import MOST_SAMPLES, Odometry
from multi_robot_slam.pipeline.pipeline import FAILED_STEP, Pipeline
from multi_robot_slam.pipeline.time_guard import MOST_HELD, MOST_UNANSWERED, TimeGuard
from multi_robot_slam.runs import evaluation
from multi_robot_slam.smoothing import solve
from multi_robot_slam.smoothing.solve import SmoothingError
from sim_world.scenario import Scenario
from sim_world.simulator import Simulation

SECOND = 10**9
SIMULATION = Simulation(Scenario(robots=3, movements=60, observations=8), seed=5)
STEPS = list(SIMULATION.steps())
CONFIG = recordings.configuration(
    SIMULATION, particles=30, rejuvenation=RejuvenationSettings(ancestors_below=0.0)
)
ODD = 8
"""The step at which something odd comes."""


def clean():
    return [e for step in STEPS for robot in step for e in (robot.odometry, robot.observations)]


def run(events, config=CONFIG):
    """The steps, what was dropped and what was told."""
    told = []
    pipeline = Pipeline(config, told.append)
    steps = [step for event in events for step in pipeline.handle(event)] + pipeline.finish()
    return steps, pipeline, told


def error_m(steps):
    """The largest distance of any estimate from the truth; that of odometry alone is 1 m."""
    truth = {(r.truth.robot, r.truth.stamp_ns): r.truth.pose for step in STEPS for r in step}
    return max(
        np.hypot(*(e.pose - truth[e.robot, e.stamp_ns])[:2])
        for step in steps
        for e in step.estimates
        if (e.robot, e.stamp_ns) in truth
    )


def with_odd(change):
    """All events, one of them changed: `change(event)` returns an event or None."""
    changed = False
    result = []
    for event in clean():
        is_due = event.stamp_ns >= STEPS[ODD][0].odometry.stamp_ns and event.robot == "robot_2"
        odd = change(event) if is_due and not changed else None
        changed |= odd is not None
        result.append(odd or event)
    assert changed
    return result


def observed(**changes):
    def change(event):
        if not isinstance(event, ObservationSet):
            return None
        return replace(event, **{k: make(getattr(event, k)) for k, make in changes.items()})

    return change


def odometry(make):
    return lambda e: replace(e, pose=make(e.pose)) if isinstance(e, PoseSample) else None


def first_row(value):
    def make(array):
        array = array.copy()
        array[0] = value
        return array

    return make


def isotropic(variance):
    return observed(covariances=first_row([variance, 0, 0, variance, 0, variance]))


CASES = {
    "covariance 3e38": (isotropic(3e38), "implausible observations", "largest_sigma_m"),
    "covariance 1e-14": (isotropic(1e-14), "implausible observations", "smallest_sigma_m"),
    "nearly flat covariance": (
        observed(covariances=first_row([1, 1 - 1e-12, 0, 1, 0, 1])),
        "implausible observations",
        "smallest_sigma_m",
    ),
    "position 1e19": (
        observed(positions=first_row([0, 0, 1e19])),
        "implausible observations",
        "farthest_m",
    ),
    "descriptors of zeros": (
        observed(descriptors=first_row(0.0)),
        "implausible descriptors",
        "norm 0",
    ),
    "descriptors times 512": (
        observed(descriptors=lambda d: d * 512),
        "implausible descriptors",
        "publish unit vectors",
    ),
    "odometry 1e150": (
        odometry(lambda pose: pose + np.array([1e150, 0, 0])),
        "implausible odometry",
        "farthest_odometry_m",
    ),
    "odometry at 10,000 km": (
        odometry(lambda pose: pose + np.array([1e7, 0, 0])),
        "odometry jump",
        "fastest_m_s",
    ),
    "odometry 20 m off": (
        odometry(lambda pose: pose + np.array([20.0, 0, 0])),
        "odometry jump",
        "fastest_m_s",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_one_odd_message_is_lost_alone(name):
    change, reason, remedy = CASES[name]
    steps, pipeline, told = run(with_odd(change))
    assert pipeline.dropped == {reason: 1}
    assert len(told) == 1
    assert "robot_2 at " in told[0]
    assert remedy in told[0]
    assert len(steps) == len(STEPS)
    assert all(np.isfinite(s.effective_particles) for s in steps)
    assert error_m(steps) < 3.0


def test_what_is_far_or_exact_but_possible_is_used():
    """At 900 m, with 0.1 mm or 1 km, in UTM coordinates, and as OpenCV quantises descriptors."""
    seen = STEPS[0][0].observations
    far = replace(seen, positions=first_row([0, 0, 900])(seen.positions))
    exact = isotropic(1e-8)(seen)
    vague = isotropic(1e6)(seen)
    bytes_of = np.round(seen.descriptors * 512).clip(0, 255) / np.float32(512)
    quantised = replace(seen, descriptors=bytes_of.astype(np.float32))
    utm = replace(STEPS[0][0].odometry, pose=np.array([5e5, 9.9e6, 0.0]))
    for event in (far, exact, vague, quantised, utm):
        assert plausibility.refusal(event, Plausible()) is None


@pytest.mark.parametrize("sigma_m", [1e-5, 1e4])
def test_limits_are_of_the_standard_deviation(sigma_m):
    inwards = 1.05 if sigma_m < 1 else 0.95
    seen = STEPS[0][0].observations
    of = {s: isotropic(s**2)(seen) for s in (sigma_m * inwards, sigma_m / inwards)}
    assert [bool(plausibility.refusal(seen, Plausible())) for seen in of.values()] == [False, True]


def test_a_robot_whose_frames_are_all_implausible_holds_up_nobody():
    pipeline = Pipeline(CONFIG)
    done, count = [], 8
    for event in clean()[: 6 * count]:
        if event.robot == "robot_2" and isinstance(event, ObservationSet):
            event = observed(descriptors=lambda d: d * 0)(event)
        done += pipeline.handle(event)
    assert len(done) >= count - 1
    assert pipeline.dropped == {"implausible descriptors": count}


def test_a_wild_sample_at_the_very_end_is_counted():
    *events, odometry_3, frame_3 = clean()
    wild = replace(odometry_3, pose=odometry_3.pose + np.array([50.0, 0, 0]))
    steps, pipeline, _ = run([*events, wild, frame_3])
    assert pipeline.dropped == {"odometry jump": 1, "frame without odometry": 1}
    assert len(steps) == len(STEPS)


@given(st.integers(1, 3000), st.integers(1, 1000))
def test_thinning_keeps_as_many_as_allowed_evenly(count, most):
    rows = np.arange(count, dtype=np.float32)[:, None]
    thin = plausibility.thinned(
        ObservationSet("a", 0, rows, rows, rows), Plausible(most_observations=most)
    )
    kept = thin.positions[:, 0]
    assert len(kept) == min(count, most)
    assert kept[0] == 0
    gaps = np.diff(np.append(kept, count))
    assert gaps.max() - gaps.min() <= 1


def test_a_dense_cloud_is_thinned_counted_and_told():
    config = replace(CONFIG, plausible=replace(CONFIG.plausible, most_observations=5))
    steps, pipeline, told = run(clean(), config)
    assert max(len(frame.landmarks) for step in steps for frame in step.frames) == 5
    seen = [len(robot.observations.positions) for step in STEPS for robot in step]
    reason = "observations beyond the most of a frame"
    assert pipeline.dropped == {reason: sum(n - 5 for n in seen if n > 5)}
    assert "8 observations, of which 5" in told[0]
    assert "plausible.most_observations" in told[0]


def test_a_run_of_dense_clouds_is_judged_by_what_was_used(tmp_path):
    _, config = recordings.record(tmp_path / "bag", particles=10)
    config = replace(config, plausible=replace(config.plausible, most_observations=3))
    run = offline.estimate(tmp_path / "bag", config, lambda text: None)
    assert {len(truth) for truth in run.observation_truth.values()} <= {0, 1, 2, 3}
    assert evaluation.evaluate(run)["association_precision"] > 0.9


def later(events, robot, since, by_s):
    """All stamps of `robot` from `since` on shifted."""
    return [
        replace(e, stamp_ns=e.stamp_ns + int(by_s * SECOND))
        if e.robot == robot and e.stamp_ns >= since
        else e
        for e in events
    ]


@pytest.mark.parametrize("kind", [PoseSample, ObservationSet])
@pytest.mark.parametrize("ahead_s", [6.0, 3600.0])
@pytest.mark.parametrize("step", [0, ODD, len(STEPS) - 1])
def test_one_stamp_far_ahead_is_that_robots_fault(kind, ahead_s, step):
    """The others are filtered as if it had not been sent."""
    odd_ns = STEPS[step][0].odometry.stamp_ns
    events = clean()
    index = next(
        i
        for i, e in enumerate(events)
        if e.robot == "robot_2" and isinstance(e, kind) and e.stamp_ns >= odd_ns
    )
    without = events[:index] + events[index + 1 :]
    odd = replace(events[index], stamp_ns=events[index].stamp_ns + int(ahead_s * SECOND))
    steps, pipeline, told = run([*events[:index], odd, *events[index + 1 :]])
    expected, other, _ = run(without)
    assert pipeline.dropped == other.dropped + Counter({"stamp far ahead": 1})
    assert [s.stamp_ns for s in steps] == [s.stamp_ns for s in expected]
    for step, same in zip(steps, expected, strict=True):
        for estimate, right in zip(step.estimates, same.estimates, strict=True):
            assert estimate.pose.tobytes() == right.pose.tobytes()
    assert any("synchronise the robots' clocks" in text for text in told)


def test_a_clock_that_is_wrong_for_good_holds_up_nobody():
    since = STEPS[ODD][0].odometry.stamp_ns
    steps, pipeline, _ = run(later(clean(), "robot_2", since, 3600.0))
    others = [{f.robot for f in s.frames} & {"robot_1", "robot_3"} for s in steps]
    assert others == [{"robot_1", "robot_3"}] * len(STEPS)
    assert set(pipeline.dropped) == {"stamp far ahead"}


def test_a_team_that_paused_goes_on():
    """All clocks leap: what comes first finds the others silent, as when a robot comes back."""
    since = STEPS[ODD][0].odometry.stamp_ns
    events = clean()
    for robot in CONFIG.robots:
        events = later(events, robot, since, 3600.0)
    steps, pipeline, _ = run(events)
    assert pipeline.dropped == {"late frame": 2}
    assert [len(s.frames) for s in steps] == [3] * ODD + [1] + [3] * (len(STEPS) - ODD - 1)


def test_a_robot_that_is_left_alone_goes_on():
    since = STEPS[ODD][0].odometry.stamp_ns
    events = [e for e in clean() if e.robot == "robot_1" or e.stamp_ns < since]
    steps, pipeline, _ = run(events)
    assert not pipeline.dropped
    assert len(steps) == len(STEPS)


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 10**4)), max_size=60))
def test_the_guard_lets_each_event_through_once_or_drops_it(sent):
    events = [PoseSample(f"robot_{r}", s * SECOND, np.zeros(3)) for r, s in sent]
    dropped = []
    guard = TimeGuard(5 * SECOND, dropped.append)
    admitted = [a for e in events for a in guard.admit(e)] + guard.rest()
    assert sorted(map(id, admitted + dropped)) == sorted(map(id, events))


@pytest.mark.parametrize("ahead_s", [6.0, 3600.0])
@pytest.mark.parametrize("kinds", [ObservationSet, (PoseSample, ObservationSet)])
def test_a_stamp_far_ahead_before_a_rest_moves_nobodys_time(ahead_s, kinds):
    """The team rests, what is held back is filtered, and all go on: nothing else is lost."""
    resting = 6 * ODD
    odd = [
        replace(e, stamp_ns=e.stamp_ns + int(ahead_s * SECOND))
        if e.robot == "robot_3" and isinstance(e, kinds)
        else e
        for e in clean()[resting - 2 : resting]
    ]
    pipeline = Pipeline(CONFIG)
    steps = run_on(pipeline, [*clean()[: resting - 2], *odd])
    steps += run_on(pipeline, clean()[resting:])
    assert pipeline.dropped == {"stamp far ahead": 1 if kinds is ObservationSet else 2}
    assert [len(s.frames) for s in steps] == [3 - (i == ODD - 1) for i in range(len(STEPS))]


def run_on(pipeline, events):
    """The steps of these events, after which the team rests."""
    return [step for event in events for step in pipeline.handle(event)] + pipeline.finish()


def at(robot, second):
    return PoseSample(robot, int(second * SECOND), np.zeros(3))


def admitted(guard, *events):
    """The stamps that are let through at each event [s]."""
    return [[e.stamp_ns / SECOND for e in guard.admit(event)] for event in events]


def test_a_robot_alone_is_believed_when_its_stream_goes_on():
    guard = TimeGuard(5 * SECOND)
    sent = [at("a", second) for second in (0, 1, 60, 60.1, 60.2)]
    assert admitted(guard, *sent) == [[], [0, 1], [], [60, 60.1], [60.2]]


@pytest.mark.parametrize(
    ("sent", "believed"),
    [
        ([("a", 60)], []),
        ([("a", 60), ("a", 60)], []),
        ([("a", 60), ("a", 60.1)], [60, 60.1]),
        ([("a", 3600), ("a", 60), ("a", 60.1)], [60, 60.1]),
        ([("a", 60), ("a", 60.1), ("b", 1)], []),
    ],
)
def test_a_rest_believes_what_goes_on_and_nobody_has_answered(sent, believed):
    dropped = []
    guard = TimeGuard(5 * SECOND, dropped.append)
    admitted(guard, *(at(robot, 0) for robot in "abc"))
    let_through = [s for now in admitted(guard, *(at(*one) for one in sent)) for s in now]
    assert let_through == [second for robot, second in sent if robot == "b"]
    assert [e.stamp_ns / SECOND for e in guard.rest()] == believed
    assert len(dropped) == len(sent) - len(let_through) - len(believed)


def test_what_a_rest_has_dropped_speaks_for_nothing():
    guard = TimeGuard(5 * SECOND)
    admitted(guard, at("a", 0), at("b", 0), at("a", 3600))
    assert guard.rest() == []
    assert admitted(guard, at("a", 3700)) == [[]]


def test_a_rest_believes_the_only_events_there_are():
    guard = TimeGuard(5 * SECOND)
    assert admitted(guard, at("a", 0)) == [[]]
    assert [e.stamp_ns for e in guard.rest()] == [0]


def test_two_robots_that_leap_as_far_are_believed():
    guard = TimeGuard(5 * SECOND)
    sent = [at("a", 0), at("b", 0), at("c", 0), at("a", 60), at("b", 61), at("c", 61)]
    assert admitted(guard, *sent) == [[], [0, 0], [0], [], [60, 61], [61]]


def test_a_clock_that_is_ahead_stays_within_the_limit_of_the_others():
    guard, newest = TimeGuard(5 * SECOND), 0.0
    for i in range(400):
        newest = max(newest, i / 10)
        guard.admit(at("a", i / 10))
        for let_through in admitted(guard, at("b", i / 10 + (6 if i > 50 else 0))):
            assert all(stamp <= newest + 5 for stamp in let_through)


def test_the_guard_keeps_no_more_than_it_may():
    dropped = []
    guard = TimeGuard(SECOND, dropped.append)
    for i in range(3 * MOST_HELD):
        guard.admit(PoseSample("right", i * 10**6, np.zeros(3)))
        guard.admit(PoseSample("wrong", 3600 * SECOND + i * 10**6, np.zeros(3)))
    assert len(dropped) >= 2 * MOST_HELD - 1
    assert {e.robot for e in dropped} == {"wrong"}


def seen_at(robot, second):
    return replace(STEPS[0][0].observations, robot=robot, stamp_ns=int(second * SECOND))


@pytest.mark.parametrize("kind", [at, seen_at])
def test_a_robot_that_goes_on_after_a_pause_loses_nothing_however_long_it_is_held(kind):
    dropped = []
    guard = TimeGuard(60 * SECOND, dropped.append)
    admitted(guard, at("a", 0), at("b", 0))
    sent = [100 + i / 64 for i in range(4000)]
    let_through = [s for now in admitted(guard, *(kind("a", s) for s in sent)) for s in now]
    assert not dropped
    assert let_through == sent


def test_frames_are_given_up_before_odometry():
    dropped = []
    guard = TimeGuard(60 * SECOND, dropped.append)
    admitted(guard, at("a", 0), at("b", 0))
    for i in range(MOST_HELD):
        guard.admit(at("a", 3600 + i / 100))
        if i % 10 == 0:
            guard.admit(seen_at("a", 3600 + i / 100))
            guard.admit(at("b", i / 100))
    assert [e.stamp_ns / SECOND for e in dropped] == [3600 + i / 10 for i in range(100)]
    assert {type(e) for e in dropped} == {ObservationSet}


def test_a_robot_whose_clock_stands_still_far_ahead_fills_no_memory():
    dropped = []
    guard = TimeGuard(60 * SECOND, dropped.append)
    admitted(guard, at("a", 0), at("b", 0))
    for _ in range(MOST_UNANSWERED + 7):
        guard.admit(at("a", 3600))
    assert len(dropped) == 7
    guard.admit(at("b", 1))
    assert len(dropped) == MOST_UNANSWERED + 7 - MOST_HELD


def drive(poses, period_s=0.1):
    """What an `Odometry` makes of these poses: the motions to each that is reached, and reasons."""
    told, motions = [], []
    odometry = Odometry(
        Plausible(), MotionSettings(), lambda sample, refusal: told.append(refusal.reason)
    )
    for i, pose in enumerate(poses):
        stamp = int((i + 1) * period_s * SECOND)
        odometry.take(PoseSample("a", stamp, np.array(pose, float)))
        if odometry.newest_ns == stamp:
            motions.append((i, odometry.motion_to(stamp)[0]))
            odometry.use()
    return motions, told, odometry


def test_odometry_that_is_reset_goes_on_without_motion_across_the_jump():
    poses = [[0.1 * i, 0.0, 0.0] for i in range(100)]
    again = [[0.1 * i, 0.0, 0.0] for i in range(20)]
    motions, told, odometry = drive(poses + again)
    assert told == ["odometry reset"]
    total = np.sum([motion for _, motion in motions], axis=0)
    np.testing.assert_allclose(total, [0.1 * (99 + 19), 0, 0], atol=1e-9)
    np.testing.assert_allclose(odometry.used_pose, again[-1], atol=1e-9)


@given(
    st.integers(1, 63),
    st.sampled_from([(4.0, 0.0, 0.0), (1e7, -1e7, 0.0), (0.0, 0.0, 2.5), (5.0, 0.0, 3.0)]),
    st.integers(1, 2),
)
def test_wild_samples_never_become_motion(where, off, count):
    poses = np.array([[0.1 * i, 0.0, 0.02 * i] for i in range(64)])
    wild = poses.copy()
    wild[where : where + count] += off
    motions, told, odometry = drive(wild)
    odometry.drop_doubted()
    assert max(np.hypot(*motion[:2]) for _, motion in motions) < 0.5
    assert told == ["odometry jump"] * min(count, len(poses) - where)


def test_odometry_that_no_frame_uses_is_bounded_counted_and_told():
    told = []
    odometry = Odometry(
        Plausible(), MotionSettings(), lambda sample, refusal: told.append(refusal.reason)
    )
    for i in range(MOST_SAMPLES + 7):
        odometry.take(PoseSample("a", i, np.zeros(3)))
    assert told == ["odometry not kept"] * 7


@pytest.mark.parametrize(
    "error", [np.linalg.LinAlgError("singular"), ArithmeticError("no finite numbers")]
)
def test_a_step_that_cannot_be_done_is_lost_alone(monkeypatch, error):
    """The next motion begins where the last step that was done ended."""
    right, done = rbpf.step, []

    def fails_once(state, frames, settings, rng):
        done.append(frames)
        if len(done) == ODD:
            raise error
        return right(state, frames, settings, rng)

    monkeypatch.setattr(rbpf, "step", fails_once)
    steps, pipeline, told = run(clean())
    assert pipeline.dropped == {FAILED_STEP: 1}
    assert len(steps) == len(STEPS) - 1
    assert str(error) in told[0]
    before, after = done[ODD - 1][0], done[ODD][0]
    assert after.seconds == pytest.approx(2 * before.seconds)
    assert error_m(steps) < 3.0


def test_after_a_first_step_that_cannot_be_done_the_second_frame_is_the_start(monkeypatch):
    """And the robot has moved there from its start pose, as its odometry says."""
    right, done = rbpf.step, []

    def fails_first(state, frames, settings, rng):
        done.append(frames)
        if len(done) == 1:
            raise ArithmeticError("no finite numbers")
        return right(state, frames, settings, rng)

    moved = STEPS[1][0].odometry
    monkeypatch.setattr(rbpf, "step", fails_first)
    steps, pipeline, _ = run(clean())
    assert pipeline.dropped == {FAILED_STEP: 1}
    assert len(steps) == len(STEPS) - 1
    first, second, third = (frames[0] for frames in done[:3])
    start = np.array(CONFIG.start_poses[0])
    assert not second.motion.any()
    assert second.seconds == 0
    assert third.start is None
    np.testing.assert_array_equal(first.start.mean, start)
    np.testing.assert_array_equal(first.start.covariance, np.zeros((3, 3)))
    assert np.hypot(*(second.start.mean - start)[:2]) == pytest.approx(np.hypot(*moved.pose[:2]))
    assert np.hypot(*moved.pose[:2]) > 0.1
    assert (np.diag(second.start.covariance) > 0).all()
    assert third.seconds > 0


OPEN = Plausible(
    farthest_m=1e30,
    smallest_sigma_m=1e-30,
    largest_sigma_m=1e30,
    descriptor_norm_error=1e30,
    farthest_odometry_m=1e300,
    fastest_m_s=1e300,
)
"""Whoever believes everything."""


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("proposal", ["informed", "motion"])
def test_even_who_believes_everything_keeps_a_finite_state(name, proposal):
    config = replace(CONFIG, plausible=OPEN, filter=replace(CONFIG.filter, proposal=proposal))
    steps, pipeline, _ = run(with_odd(CASES[name][0]), config)
    assert len(steps) + pipeline.dropped[FAILED_STEP] == len(STEPS)
    assert len(steps) > ODD
    for step in steps:
        assert np.isfinite(step.effective_particles)
        assert all(np.isfinite(estimate.pose).all() for estimate in step.estimates)
    assert all(np.isfinite(path.poses).all() for path in pipeline.trajectories().values())


@pytest.mark.parametrize("name", ["team/alice", "bo b/", "", "1st", "ro-bot", "é", "a\n"])
def test_a_robot_has_a_name_that_ros_can_use(name):
    with pytest.raises(InputError, match="use letters, digits"):
        Config(robots=(name,))
    with pytest.raises(InputError, match="use letters, digits"):
        scenario_file.from_mapping(Config, {"robots": [name]})


def test_plausible_ranges_are_settings():
    text = "multi_robot_slam: {plausible: {farthest_m: 20.0}, filter: {particles: 3}}"
    config = scenario_file.from_yaml(Config, text, SECTION)
    assert config.plausible == Plausible(farthest_m=20.0)
    assert config.filter == FilterSettings(particles=3)
    seen = STEPS[0][0].observations
    far = replace(seen, positions=first_row([0, 0, 21])(seen.positions))
    assert "21 m away" in plausibility.refusal(far, config.plausible).remedy


def test_a_smoothing_that_fails_is_counted_and_told_and_the_run_goes_on(monkeypatch):
    def fail(*_, **__):
        raise SmoothingError("smoothing 12 poses: the information is not positive definite")

    always = RejuvenationSettings(ancestors_below=1.0, delay_s=2.5)
    config = replace(CONFIG, filter=replace(CONFIG.filter, rejuvenation=always))
    monkeypatch.setattr(solve, "smooth", fail)
    steps, pipeline, told = run(clean(), config)
    assert len(steps) == len(STEPS)
    assert all(step.rejuvenated is None for step in steps)
    assert 0 < pipeline.dropped["failed smoothing"] <= len(STEPS) // 5
    assert any("12 poses" in line for line in told)
    assert all(np.isfinite(e.pose).all() for step in steps for e in step.estimates)


@pytest.mark.parametrize("ahead_s", [0.6, 1.0, 4.0])
def test_an_odometry_stamp_ahead_costs_that_sample(ahead_s):
    def ahead(event):
        if isinstance(event, PoseSample):
            return replace(event, stamp_ns=event.stamp_ns + int(ahead_s * SECOND))
        return None

    steps, pipeline, told = run(with_odd(ahead))
    assert len(steps) == len(STEPS)
    assert dict(pipeline.dropped) == {"odometry stamp ahead": 1}
    assert any("robot_2" in line and "clock" in line for line in told)


@pytest.mark.parametrize("ahead_s", [0.6, 1.0, 4.0])
def test_what_a_robot_drives_is_not_lost_with_a_sample_stamped_ahead(ahead_s):
    """The frame between has a wrong share of the way; the next one makes up for it."""
    told, total = [], np.zeros(3)
    odometry = Odometry(
        Plausible(), MotionSettings(), lambda sample, refusal: told.append(refusal.reason)
    )
    for step in range(12):
        stamp_ns = SECOND + step * SECOND // 2
        ahead_ns = int(ahead_s * SECOND) * (step == 5)
        odometry.take(PoseSample("robot_1", stamp_ns + ahead_ns, np.array([0.3 * step, 0.0, 0.0])))
        if odometry.newest_ns >= stamp_ns:
            total += odometry.motion_to(stamp_ns)[0]
            odometry.use()
    assert told == ["odometry stamp ahead"]
    np.testing.assert_allclose(total, [0.3 * 11, 0.0, 0.0], atol=1e-9)
