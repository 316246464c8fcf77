"""Laws of the figures of merit, on runs whose errors are known."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from msg_defs.errors import InputError
from msg_defs.types import LandmarkMap, Trajectory
from multi_robot_slam.runs import (
    RobotRun,
    Run,
    associations,
    consistency,
    evaluation_table,
    provenance,
    robot_errors,
    trajectory_errors,
)
from multi_robot_slam.runs.evaluation import PREFIXES, evaluate
from test.helpers import PERIOD_NS, fake_frame, fake_run, fake_step, moved

PATHS = ("", "odometry_", "online_", "online_mean_", "mean_", "refined_", "batch_")
PATH_FIGURES = (
    "path_rmse_m",
    "path_aligned_rmse_m",
    "path_team_aligned_rmse_m",
    "heading_rmse_rad",
    "heading_aligned_rmse_rad",
    "heading_team_aligned_rmse_rad",
    "rte_1m_rmse_m",
    "rte_1m_rmse_rad",
    "rte_10m_rmse_m",
    "rte_10m_rmse_rad",
)
PATH_KEYS = {path + figure for path in PATHS for figure in PATH_FIGURES}
ROBOT_KEYS = PATH_KEYS | {
    *("pose_nees", "truth_coverage", "association_precision", "association_recall"),
    *("frames", "keyframes", "worst_level"),
}
LEVEL_KEYS = {"level", "worst_level_at_s", "worst_level_cause", "worst_level_remedy"}
PLACE_KEYS = {"place_known_from_s"}
PLACE_KEYS |= {f"tied_{what}" for what in ("landmarks", "places", "runner_up", "after_s")}
RESULT_KEYS = ROBOT_KEYS | {
    "landmark_nees",
    "map_rmse_m",
    "map_aligned_rmse_m",
    "map_all_rmse_m",
    "refined_landmark_nees",
    "refined_map_rmse_m",
    "refined_map_aligned_rmse_m",
    "refined_map_all_rmse_m",
    "landmarks",
    "landmarks_seen",
    "landmarks_by_majority",
    "landmarks_unattributed",
    "misses",
    "duplicates",
    "step_ms_mean",
    "step_ms_p99",
    "step_ms_max",
    "steps",
    "particles",
    "seed",
    "bag",
    "namespace",
    "version",
    "scenario",
    "machine",
    "dropped",
    "robots",
}


def with_robots(run: Run, change) -> Run:
    """`change(index, robot)` applied to every robot."""
    changed = {name: change(i, robot) for i, (name, robot) in enumerate(run.robots.items())}
    return replace(run, robots=changed)


def observed_run(frames: list[tuple[str, int, list, list, list]], landmarks: list[int]) -> Run:
    """A run of hand-made frames (robot, step, ids, is_new, true rows), with these ids mapped."""
    run = fake_run()
    steps, truth = {}, {}
    for robot, step, ids, is_new, rows in frames:
        truth[robot, step] = np.array(rows, np.uint32)
        steps.setdefault(step, []).append(fake_frame(robot, ids, is_new))
    records = [fake_step(step, step, parts, []) for step, parts in steps.items()]
    places = run.true_landmarks.positions[[0] * len(landmarks)]
    estimated = LandmarkMap(
        ids=np.array(landmarks, np.uint32),
        positions=places,
        covariances=np.zeros((len(landmarks), 6), np.float32),
        observations=np.ones(len(landmarks), np.uint32),
        robots=np.ones(len(landmarks), np.uint32),
        descriptors=np.zeros((len(landmarks), 128), np.float32),
    )
    return replace(run, steps=records, observation_truth=truth, landmarks=estimated)


LATER_PATHS = ("online_mean", "mean", "refined", "yardstick")


def test_perfect_run_has_no_error():
    run = with_robots(fake_run(), lambda _, r: replace(r, **dict.fromkeys(LATER_PATHS, r.truth)))
    result = evaluate(run)
    for figures in (result, *result["robots"].values()):
        for key in PATH_KEYS - {key for key in PATH_KEYS if "rte_10m" in key}:
            assert figures[key] == pytest.approx(0, abs=1e-12), key
        assert figures["association_precision"] == figures["association_recall"] == 1
    assert result["map_rmse_m"] == 0
    assert result["map_aligned_rmse_m"] == pytest.approx(0, abs=1e-6)
    assert result["duplicates"] == result["misses"] == result["landmarks_unattributed"] == 0


def test_what_was_published_comes_before_what_hindsight_makes_of_it():
    result = evaluate(fake_run())
    for figures in (result, *result["robots"].values()):
        assert next(iter(figures)) == "online_path_rmse_m"


def test_known_offset_gives_that_rmse():
    run = with_robots(
        fake_run(), lambda _, r: replace(r, path=moved(r.truth, (0.3, -0.4, 0.1)), online=r.truth)
    )
    result = evaluate(run)
    assert result["path_rmse_m"] == pytest.approx(0.5)
    assert result["heading_rmse_rad"] == pytest.approx(0.1)
    assert result["online_path_rmse_m"] == 0


def test_online_error_is_of_the_published_poses():
    run = with_robots(fake_run(), lambda _, r: replace(r, online=moved(r.truth, (0, 2.0, 0))))
    result = evaluate(run)
    assert result["online_path_rmse_m"] == pytest.approx(2)
    assert result["path_rmse_m"] == 0


@pytest.mark.parametrize("name", LATER_PATHS)
def test_each_path_has_its_own_error(name):
    run = with_robots(fake_run(), lambda _, r: replace(r, **{name: moved(r.truth, (0, 2.0, 0))}))
    result = evaluate(run)
    for figures in (result, *result["robots"].values()):
        assert figures[f"{PREFIXES[name]}path_rmse_m"] == pytest.approx(2)
        assert figures["path_rmse_m"] == 0


def test_nees_of_honest_covariances_is_three():
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(20_000, 3, 3))
    errors = (roots @ rng.standard_normal((20_000, 3, 1)))[:, :, 0]
    covariances = roots @ roots.transpose(0, 2, 1)
    tolerance = 5 * np.sqrt(2 * 3 / 20_000)
    assert consistency.nees(errors, covariances) == pytest.approx(3, abs=tolerance)
    assert consistency.nees(errors, covariances / 4) == pytest.approx(12, abs=4 * tolerance)


def test_nees_leaves_out_what_claims_certainty():
    covariances = np.stack([np.eye(3), np.zeros((3, 3)), np.ones((3, 3)), np.diag([1.0, 1.0, 0])])
    assert consistency.nees(np.ones((4, 3)), covariances) == pytest.approx(3)
    assert consistency.nees(np.ones((3, 3)), covariances[1:]) is None
    assert consistency.nees(np.empty((0, 3)), np.empty((0, 3, 3))) is None
    rounding = 1e-15 * np.random.default_rng(0).normal(size=(1, 3, 50))
    assert consistency.nees(np.ones((1, 3)), rounding @ rounding.transpose(0, 2, 1) / 50) is None


@pytest.mark.parametrize("turns", [-1, 0, 2])
def test_pose_nees_is_of_mean_and_covariance(turns):
    run = fake_run()
    error = np.array([0.2, -0.1, 0.3 + 2 * np.pi * turns])
    covariance = np.diag([0.04, 0.04, 0.09])
    steps = [
        replace(
            step,
            estimates=tuple(
                replace(e, pose=e.pose + 7, mean=e.pose + error, covariance=covariance)
                for e in step.estimates
            ),
        )
        for step in run.steps
    ]
    result = evaluate(replace(run, steps=steps))
    for figures in (result, *result["robots"].values()):
        assert figures["pose_nees"] == pytest.approx(1 + 0.25 + 1)


def test_landmark_nees_is_that_of_the_map():
    run = fake_run()  # sigma 0.1 m
    away = run.landmarks.positions + np.float32([0.1, 0.2, 0])
    result = evaluate(replace(run, landmarks=replace(run.landmarks, positions=away)))
    assert result["landmark_nees"] == pytest.approx(1 + 4, rel=1e-4)


def test_refined_map_has_its_own_error():
    run = fake_run()
    away = replace(run.landmarks, positions=run.landmarks.positions + np.float32([0, 0, 0.5]))
    result = evaluate(replace(run, refined_landmarks=away))
    assert result["refined_map_rmse_m"] == pytest.approx(0.5, rel=1e-5)
    assert result["map_rmse_m"] == 0


def test_team_pools_all_poses_of_all_robots():
    def change(index: int, robot: RobotRun) -> RobotRun:
        length = (20, 5)[index]
        path = Trajectory(robot.truth.stamps_ns[:length], robot.truth.poses[:length])
        return replace(robot, path=moved(path, ((1.0, 3.0)[index], 0, 0)))

    result = evaluate(with_robots(fake_run(robots=2, steps=20), change))
    assert result["path_rmse_m"] == pytest.approx(np.sqrt((20 * 1 + 5 * 9) / 25))
    assert result["robots"]["robot_1"]["path_rmse_m"] == pytest.approx(1)
    assert result["robots"]["robot_2"]["path_rmse_m"] == pytest.approx(3)


@given(turns=st.integers(-3, 3), error=st.floats(-3.1, 3.1))
def test_heading_error_is_wrapped(turns, error):
    run = fake_run(robots=1)
    shift = (0, 0, error + 2 * np.pi * turns)
    shifted = with_robots(run, lambda _, r: replace(r, path=moved(r.truth, shift)))
    assert evaluate(shifted)["heading_rmse_rad"] == pytest.approx(abs(error), abs=1e-9)


@given(x=st.floats(-50, 50), y=st.floats(-50, 50), yaw=st.floats(-3, 3), scale=st.floats(0.9, 1.1))
def test_odometry_error_does_not_depend_on_its_frame(x, y, yaw, scale):
    def scaled(_, robot):
        return replace(robot, odometry=Trajectory(*_odometry(robot.odometry, scale, 0, 0, 0)))

    def seen_elsewhere(_, robot):
        return replace(robot, odometry=Trajectory(*_odometry(robot.odometry, scale, x, y, yaw)))

    run = fake_run(robots=1)
    expected = evaluate(with_robots(run, scaled))["odometry_path_rmse_m"]
    assert evaluate(with_robots(run, seen_elsewhere))["odometry_path_rmse_m"] == pytest.approx(
        expected, abs=1e-9
    )
    assert expected >= 0.1 * abs(scale - 1)


def _odometry(path, scale, x, y, yaw):
    """Odometry that overrates distances by `scale`, in a frame at x, y, yaw."""
    c, s = np.cos(yaw), np.sin(yaw)
    places = scale * path.poses[:, :2] @ np.array([[c, s], [-s, c]]) + (x, y)
    return path.stamps_ns, np.column_stack([places, path.poses[:, 2] + yaw])


def test_odometry_is_composed_on_the_configured_start_without_truth():
    robot = fake_run(robots=2).robots["robot_2"]
    in_map = robot_errors.odometry_in_map(replace(robot, truth=None))
    np.testing.assert_allclose(in_map.poses[:, :2], robot.truth.poses[:, :2], atol=1e-12)


def test_odometry_starts_where_the_path_starts():
    robot = fake_run(robots=1).robots["robot_1"]
    late = Trajectory(robot.path.stamps_ns[5:], robot.path.poses[5:])
    start = robot.truth.poses[0] + np.array([1, 0, 0])
    in_map = robot_errors.odometry_in_map(replace(robot, path=late, truth=None, start_pose=start))
    expected = robot.truth.poses[5, :2] + [1, 0]
    np.testing.assert_allclose(in_map.poses[5, :2], expected, atol=1e-12)


def test_truth_is_interpolated_with_the_yaw_the_short_way():
    truth = Trajectory(np.array([0, 100]), np.array([[0.0, 0.0, 3.0], [2.0, 4.0, -3.0]]))
    yaw = 3.0 + 0.25 * (2 * np.pi - 6.0)
    estimate = Trajectory(np.array([25]), np.array([[0.5, 1.0, yaw - 2 * np.pi]]))
    np.testing.assert_allclose(trajectory_errors.pose_errors(estimate, truth).errors, 0, atol=1e-12)


def test_poses_outside_the_truth_are_left_out_unless_these_are_all():
    run = fake_run(robots=1, steps=20)
    truth = run.robots["robot_1"].truth
    part = Trajectory(truth.stamps_ns[4:14], truth.poses[4:14])
    errors = trajectory_errors.pose_errors(truth, part)
    np.testing.assert_array_equal(errors.stamps_ns, part.stamps_ns)
    elsewhere = Trajectory(truth.stamps_ns + 21 * PERIOD_NS, truth.poses)
    with pytest.raises(InputError, match="path of robot_1: the ground truth covers none of 20"):
        evaluate(with_robots(run, lambda _, r: replace(r, truth=elsewhere)))


def test_what_the_figures_rest_on_is_told():
    def change(index: int, robot: RobotRun) -> RobotRun:
        known = (
            robot.truth if index else Trajectory(robot.truth.stamps_ns[:4], robot.truth.poses[:4])
        )
        return replace(robot, truth=known, path=moved(robot.path, (1.0 - index, 0, 0)))

    result = evaluate(with_robots(fake_run(robots=2, steps=20), change))
    assert [own["truth_coverage"] for own in result["robots"].values()] == [0.2, 1.0]
    assert result["truth_coverage"] == pytest.approx(24 / 40)
    assert result["path_rmse_m"] == pytest.approx(np.sqrt(4 / 24))


def test_absolute_stamps_lose_no_precision():
    stamps = 1_700_000_000_000_000_000 + np.arange(5)
    truth = Trajectory(stamps, np.column_stack([np.arange(5.0), np.zeros(5), np.zeros(5)]))
    estimate = Trajectory(stamps[1:2], np.zeros((1, 3)))
    assert trajectory_errors.pose_errors(estimate, truth).errors[0, 0] == -1.0


def test_association_of_a_hand_made_run():
    # True landmarks 0, 1, 2; ids 10, 11, 12.
    run = observed_run(
        [
            ("robot_1", 0, [10, 11], [True, True], [0, 1]),
            # a right match, a wrong one (1 taken for 0), and the second robot's first sight of 2
            ("robot_1", 1, [10, 10], [False, False], [0, 1]),
            ("robot_2", 1, [12], [True], [2]),
            # a landmark made twice, a right match
            ("robot_1", 2, [13, 12], [True, False], [1, 2]),
        ],
        landmarks=[10, 11, 12, 13],
    )
    result = evaluate(run)
    assert result["association_precision"] == pytest.approx(2 / 3)  # 10 and 12, not the second 10
    assert result["association_recall"] == pytest.approx(2 / 4)  # 0, 1, then 1 and 2 again
    assert result["landmarks_seen"] == 3
    assert result["duplicates"] == 1
    assert result["misses"] == 0
    alone = result["robots"]
    assert alone["robot_1"]["association_precision"] == pytest.approx(2 / 3)
    assert alone["robot_2"]["association_precision"] is None
    assert alone["robot_1"]["association_recall"] == pytest.approx(2 / 4)


def test_true_landmarks_seen_that_the_map_lost_are_misses():
    frames = [("robot_1", 0, [10, 11, 12], [True] * 3, [0, 1, 2])]
    result = evaluate(observed_run(frames, landmarks=[11]))
    assert (result["landmarks_seen"], result["misses"], result["duplicates"]) == (3, 2, 0)


def test_first_sight_by_two_robots_in_one_step_asks_for_no_match():
    run = observed_run(
        [("robot_1", 0, [10], [True], [0]), ("robot_2", 0, [11], [True], [0])], landmarks=[10, 11]
    )
    assert evaluate(run)["association_recall"] is None


def test_map_error_is_to_the_landmark_of_the_creating_observation():
    run = observed_run(
        [
            ("robot_1", 0, [10], [True], [3]),
            ("robot_1", 1, [10], [False], [0]),
            ("robot_1", 2, [10], [False], [0]),
        ],
        landmarks=[10],
    )
    places = run.true_landmarks.positions
    expected = np.linalg.norm(places[3] - places[0])
    assert evaluate(run)["map_rmse_m"] == pytest.approx(expected)


def with_duplicate(run: Run, off_m: float, observations: int) -> Run:
    """The run with a second landmark of true landmark 0, id 99, that is `off_m` away."""
    first, known = run.steps[0], run.landmarks
    frame = first.frames[0]
    frames = (fake_frame(frame.robot, [*frame.landmarks, 99], [*frame.is_new, True]),)
    key = (frame.robot, first.stamp_ns)
    truth = run.observation_truth | {key: np.append(run.observation_truth[key], np.uint32(0))}
    place = run.true_landmarks.positions[:1] + np.float32([off_m, 0, 0])
    landmarks = LandmarkMap(
        ids=np.append(known.ids, np.uint32(99)),
        positions=np.concatenate([known.positions, place]),
        covariances=np.concatenate([known.covariances, known.covariances[:1] / 100]),
        observations=np.append(known.observations, np.uint32(observations)),
        robots=np.append(known.robots, np.uint32(1)),
        descriptors=np.concatenate([known.descriptors, known.descriptors[:1]]),
    )
    steps = [replace(first, frames=(*frames, *first.frames[1:])), *run.steps[1:]]
    return replace(run, landmarks=landmarks, steps=steps, observation_truth=truth)


def test_a_duplicate_is_counted_and_is_no_part_of_the_map_error():
    run = fake_run()  # its landmarks have been observed three times each
    result = evaluate(with_duplicate(run, 9.0, observations=1))
    assert result["duplicates"] == 1
    assert result["map_rmse_m"] == 0
    assert result["map_aligned_rmse_m"] == pytest.approx(0, abs=1e-6)
    assert result["map_all_rmse_m"] == pytest.approx(9 / np.sqrt(len(run.landmarks.ids) + 1))


@pytest.mark.parametrize("observations", [4, 3])
def test_of_two_the_one_observed_most_often_counts_then_the_more_certain(observations):
    run = fake_run()
    result = evaluate(with_duplicate(run, 9.0, observations))
    assert result["duplicates"] == 1
    assert result["map_rmse_m"] == pytest.approx(9 / np.sqrt(len(run.landmarks.ids)))


def test_map_error_is_that_of_landmarks_which_come_from_a_true_one():
    run = observed_run([("robot_1", 0, [10], [True], [3])], landmarks=[10, 99])
    places = run.true_landmarks.positions
    assert evaluate(run)["map_rmse_m"] == pytest.approx(np.linalg.norm(places[3] - places[0]))


def test_what_made_the_run_is_told():
    run = replace(fake_run(), provenance=provenance.here("calibrated"))
    result = evaluate(run)
    assert (result["version"], result["scenario"]) == (provenance.version(), "calibrated")
    assert result["machine"].keys() == {
        *("platform", "processor", "cores", "python", "numpy", "numba"),
    }
    assert result["machine"]["numpy"] == np.__version__
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_version_of_what_is_not_installed_is_unknown(monkeypatch):
    def missing(name):
        raise provenance.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(provenance.metadata, "version", missing)
    monkeypatch.setattr(provenance, "CPU_INFO", provenance.CPU_INFO / "nowhere")
    assert provenance.version() == "unknown"
    assert provenance.machine()["numba"] == "unknown"
    assert provenance.machine()["processor"]


def test_landmark_created_unseen_counts_for_the_majority_of_its_matches():
    run = observed_run(
        [
            ("robot_1", 0, [10, 20], [True, False], [0, 1]),
            ("robot_1", 1, [20, 20], [False, False], [1, 2]),
        ],
        landmarks=[10, 20, 99],
    )
    origin = associations.origins(associations.associations(run))
    assert origin.landmarks == {10: 0, 20: 1}
    assert origin.by_majority == {20}
    result = evaluate(run)
    assert result["landmarks_by_majority"] == 1
    assert result["landmarks_unattributed"] == 1
    assert result["landmarks"] == 3


def test_truth_of_another_run_is_refused():
    run = fake_run()
    other = {key: rows[:-1] for key, rows in run.observation_truth.items()}
    with pytest.raises(InputError, match="3 observations but truth for 2"):
        evaluate(replace(run, observation_truth=other))


def test_figures_are_null_without_truth():
    run = with_robots(fake_run(), lambda _, r: replace(r, truth=None))
    result = evaluate(replace(run, true_landmarks=None, walls=None, observation_truth={}))
    known = {"landmarks", "steps", "particles", "seed", "namespace"}
    known |= {"step_ms_mean", "step_ms_p99", "step_ms_max"}
    for key in RESULT_KEYS - {"robots", "dropped"}:
        assert (result[key] is not None) == (key in known), key
    assert result["robots"]["robot_1"] == {
        **dict.fromkeys(ROBOT_KEYS | LEVEL_KEYS | PLACE_KEYS),
        "place_known_from_s": 0.0,
    }


def test_robot_that_never_spoke_has_no_figures():
    run = fake_run()
    nothing = Trajectory(np.empty(0, np.int64), np.empty((0, 3)))
    silent = replace(run.robots["robot_2"], odometry=nothing, online=nothing, path=nothing)
    result = evaluate(replace(run, robots={**run.robots, "robot_2": silent}))
    figures = result["robots"]["robot_2"]
    assert {key: figures[key] for key in PATH_KEYS} == dict.fromkeys(PATH_KEYS)
    assert result["path_rmse_m"] == 0


def test_keys_are_fixed_and_values_are_json():
    run = fake_run()
    result = evaluate(run)
    assert result.keys() == RESULT_KEYS
    assert list(result["robots"]) == list(run.robots)
    own = ROBOT_KEYS | LEVEL_KEYS | PLACE_KEYS
    assert all(figures.keys() == own for figures in result["robots"].values())
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_step_times_are_those_of_the_records():
    result = evaluate(fake_run(steps=20))
    assert result["steps"] == 20
    assert result["step_ms_mean"] == pytest.approx(10.5)
    assert 19 < result["step_ms_p99"] < 20
    assert result["dropped"] == {"late": 2}


@pytest.mark.parametrize("by", [(3.0, -2.0, 0.5), (0.0, 0.0, -3.0)])
def test_aligning_undoes_a_motion_of_the_whole_team(by):
    run = with_robots(fake_run(), lambda _, r: replace(r, path=turned(r.truth, by)))
    result = evaluate(replace(run, landmarks=turned_map(run.landmarks, by)))
    assert result["path_rmse_m"] > 1
    assert result["map_rmse_m"] > 1
    for figures in (result, *result["robots"].values()):
        for key in PATH_FIGURES:
            if "aligned" in key or "rte_1m" in key:
                assert figures[key] == pytest.approx(0, abs=1e-9), key
    assert result["map_aligned_rmse_m"] == pytest.approx(0, abs=1e-6)


def test_aligning_the_team_leaves_what_is_wrong_between_the_robots():
    run = with_robots(
        fake_run(), lambda i, r: replace(r, path=turned(r.truth, ((0, 0, 0), (1.0, 0, 0))[i]))
    )
    result = evaluate(run)
    assert result["path_aligned_rmse_m"] == pytest.approx(0, abs=1e-9)
    assert 0.1 < result["path_team_aligned_rmse_m"] < result["path_rmse_m"]


def turned(path: Trajectory, by: tuple[float, float, float]) -> Trajectory:
    """The path seen from a frame that lies elsewhere."""
    x, y, yaw = by
    c, s = np.cos(yaw), np.sin(yaw)
    places = path.poses[:, :2] @ np.array([[c, s], [-s, c]]) + (x, y)
    return Trajectory(path.stamps_ns, np.column_stack([places, path.poses[:, 2] + yaw]))


def turned_map(landmarks: LandmarkMap, by: tuple[float, float, float]) -> LandmarkMap:
    flat = turned(Trajectory(landmarks.ids, landmarks.positions.astype(float)), by).poses
    places = np.column_stack([flat[:, :2], landmarks.positions[:, 2]])
    return replace(landmarks, positions=places.astype(np.float32))


def printed(figures: dict, width: int = 100) -> str:
    console = Console(width=width)
    with console.capture() as capture:
        console.print(evaluation_table.table(figures, width))
    return capture.get()


def shown(run: Run) -> str:
    return printed(evaluate(run))


@pytest.mark.parametrize("width", range(40, 400, 7))
def test_table_of_many_robots_has_the_team_and_whole_columns_and_tells_of_the_rest(width):
    own = evaluate(fake_run())
    robots = {f"robot_{i}": dict(own["robots"]["robot_1"]) for i in range(1, 33)}
    for i, figures in enumerate(robots.values(), 1):
        figures["online_path_rmse_m"] = i / 1000
    figures = own | {"online_path_rmse_m": 9.876, "robots": robots}
    lines = printed(figures, width).splitlines()
    assert max(map(len, lines)) <= width
    row = next(line for line in lines if "9.876" in line)
    values = row.partition("9.876")[2].split()
    assert values == [f"{i / 1000:.3f}" for i in range(1, len(values) + 1)]
    assert any("team" in line for line in lines[:4])
    left_out = [line.strip() for line in lines if "result.json" in line]
    more = len(robots) - len(values)
    assert left_out == ([f"{more} more robots: result.json, figures.csv"] if more else [])
    title = len("  heading [rad]: after the run, aligned as a team")
    assert not more or width < title + 9 * (len(values) + 2)


def test_table_shows_every_robot_the_team_and_units():
    run = with_robots(fake_run(), lambda i, r: replace(r, path=moved(r.truth, (1.25 * i, 0, 0))))
    lines = shown(run).splitlines()
    assert any("team" in line and "robot_1" in line and "robot_2" in line for line in lines)
    row = next(line for line in lines if " after the run " in line)
    assert [float(word) for word in row.split() if word[0].isdigit()] == [0.884, 0, 1.25]
    assert any("path [m]: live" in line for line in lines)
    assert any("heading [rad]: live" in line for line in lines)
    assert "refined" not in shown(run)


def test_table_shows_refined_paths_where_there_are():
    run = with_robots(fake_run(), lambda i, r: replace(r, refined=moved(r.truth, (0.777, 0, 0))))
    lines = shown(run).splitlines()
    assert any("refined" in line and line.count("0.777") == 3 for line in lines)


def test_table_of_a_run_without_truth_leaves_out_errors_and_keeps_the_titles():
    run = with_robots(fake_run(), lambda _, r: replace(r, truth=None))
    bare = shown(replace(run, true_landmarks=None, observation_truth={}))
    assert "landmarks: in the map" in bare
    assert "path" not in bare
