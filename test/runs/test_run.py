"""What a run leaves behind: read back from a bag, written for other programs."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from msg_defs.types import ObservationTruth, PoseSample, Trajectory
from multi_robot_slam import runs
from multi_robot_slam.bags import BagWriter, absolute
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.runs import Run
from multi_robot_slam.runs.evaluation import evaluate
from test.helpers import fake_run, moved

MAP_COLUMNS = "id,x,y,z,cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz,observations,robots"


def truth_messages(run: Run) -> list:
    """(topic, data) of the simulator's truth."""
    messages = [
        (topics.GROUND_TRUTH_LANDMARKS, wire.encode_map(run.true_landmarks, 0)),
        (topics.GROUND_TRUTH_WALLS, wire.encode_walls(run.walls, 0)),
    ]
    for (robot, stamp), landmarks in run.observation_truth.items():
        data = wire.encode_observation_truth(ObservationTruth(robot, stamp, landmarks))
        messages.append((topics.observation_truth(robot), data))
    for name, robot in run.robots.items():
        messages += pose_messages(name, robot.truth, topics.ground_truth(name), topics.MAP_FRAME)
    return messages


def pose_messages(robot: str, path: Trajectory, topic: topics.Topic, frame_id: str) -> list:
    samples = map(PoseSample, [robot] * len(path.poses), path.stamps_ns.tolist(), path.poses)
    return [(topic, wire.encode_pose(s, frame_id, topics.base_frame(robot))) for s in samples]


def odometry_messages(run: Run) -> list:
    return [
        message
        for name, robot in run.robots.items()
        for message in pose_messages(
            name, robot.odometry, topics.odometry(name), topics.odom_frame(name)
        )
    ]


def estimate_messages(run: Run) -> list:
    """(topic, data) of what the fusion publishes; an older path and map come first."""
    text = scenario_file.to_yaml(**{SECTION: run.config})
    early, late = ({"dropped: late": n, "rate": "9.5"} for n in ("1", "2"))
    messages = [
        (topics.FUSION_CONFIG, wire.encode_text(text)),
        (topics.MAP_LANDMARKS, wire.encode_map(fake_run(landmarks=2).landmarks, 0)),
        *((topics.STEPS, wire.encode_step(step)) for step in run.steps),
        (topics.MAP_LANDMARKS, wire.encode_map(run.landmarks, 0)),
        (topics.DIAGNOSTICS, wire.encode_diagnostics(0, [wire.Status("fusion", early)])),
        (topics.DIAGNOSTICS, wire.encode_diagnostics(0, [wire.Status("fusion", late)])),
        (topics.DIAGNOSTICS, wire.encode_diagnostics(0, [wire.Status("robot_1", early)])),
    ]
    for name, robot in run.robots.items():
        beginning = Trajectory(robot.path.stamps_ns[:3], robot.path.poses[:3])
        messages += [(topics.path(name), wire.encode_path(p, 0)) for p in (beginning, robot.path)]
    for step in run.steps:
        messages += [(topics.pose(e.robot), wire.encode_estimate(e)) for e in step.estimates]
        messages += [
            (topics.mean_pose(e.robot), wire.encode_mean(e))
            for e in step.estimates
            if e.mean is not None
        ]
    return messages


def write_bag(folder, messages):
    with BagWriter(folder) as bag:
        for stamp_ns, (topic, data) in enumerate(messages):
            bag.write(topic, stamp_ns, data)
    return folder


def assert_same_path(read: Trajectory, written: Trajectory):
    np.testing.assert_array_equal(read.stamps_ns, written.stamps_ns)
    np.testing.assert_allclose(read.poses, written.poses, atol=1e-12)


def without(messages: list, *excluded: topics.Topic) -> list:
    return [message for message in messages if message[0] not in excluded]


@pytest.fixture(scope="module")
def run():
    return fake_run(robots=2)


@pytest.fixture(scope="module")
def bag(run, tmp_path_factory):
    messages = odometry_messages(run) + truth_messages(run) + estimate_messages(run)
    return write_bag(tmp_path_factory.mktemp("bags") / "live", messages)


def test_recorded_run_comes_back_from_its_bag(run, bag):
    read = runs.from_bag(bag)
    assert read.config == run.config
    assert list(read.robots) == list(run.robots)
    for name, robot in run.robots.items():
        for field in ("odometry", "online", "path", "truth"):
            assert_same_path(getattr(read.robots[name], field), getattr(robot, field))
        np.testing.assert_array_equal(read.robots[name].start_pose, robot.start_pose)
    for field in ("ids", "positions", "covariances", "observations", "robots"):
        np.testing.assert_array_equal(getattr(read.landmarks, field), getattr(run.landmarks, field))
    np.testing.assert_array_equal(read.true_landmarks.positions, run.true_landmarks.positions)
    np.testing.assert_array_equal(read.walls.segments, run.walls.segments)
    assert read.observation_truth.keys() == run.observation_truth.keys()
    assert read.dropped == {"late": 2}
    assert [step.stamp_ns for step in read.steps] == [step.stamp_ns for step in run.steps]
    assert [len(step.estimates) for step in read.steps] == [2] * len(run.steps)


def moved_all(paths: dict[str, Trajectory], by_m: float) -> dict[str, Trajectory]:
    return {name: moved(path, (by_m, 0, 0)) for name, path in paths.items()}


def later_known(run: Run) -> Run:
    """With everything that is known at the end of an offline run alone."""
    paths = {name: robot.path for name, robot in run.robots.items()}
    kinds = {kind: moved_all(paths, 0.1 * i) for i, kind in enumerate(runs.LATER_PATHS)}
    return replace(run.with_paths(**kinds), refined_landmarks=fake_run(landmarks=3).landmarks)


def written_offline(run: Run, folder, bag) -> Run:
    run = replace(later_known(run), bag=bag, provenance=runs.here("paper"))
    runs.write_estimates(run, folder)
    runs.write(run, evaluate(run), folder)
    return run


def test_offline_run_comes_back_from_its_folder(run, tmp_path):
    bag = write_bag(tmp_path / "recorded", odometry_messages(run) + truth_messages(run))
    written = written_offline(with_means(run), tmp_path / "out", bag)
    read = runs.load(tmp_path / "out")
    assert read.config == written.config
    for name, robot in written.robots.items():
        for path in ("odometry", "online", "path", "truth", *runs.LATER_PATHS):
            assert_same_path(getattr(read.robots[name], path), getattr(robot, path))
    np.testing.assert_array_equal(read.refined_landmarks.ids, written.refined_landmarks.ids)
    assert read.provenance == written.provenance
    figures, again = evaluate(written), evaluate(read)
    assert again["bag"] == str(bag)
    for key, value in figures.items():
        if key not in ("robots", "machine"):
            assert again[key] == pytest.approx(value, abs=1e-9), key


def test_offline_run_whose_bag_is_gone_says_where_it_was(run, tmp_path):
    written_offline(run, tmp_path / "out", tmp_path / "gone")
    with pytest.raises(InputError, match=r"is not at .*gone; correct `bag`"):
        runs.load(tmp_path / "out")


@pytest.mark.parametrize(
    ("text", "told"), [(None, "cannot read"), ("[1", "is not JSON"), ("[1]", "holds no figures")]
)
def test_figures_that_cannot_be_read_are_refused(tmp_path, text, told):
    if text is not None:
        (tmp_path / "result.json").write_text(text)
    with pytest.raises(InputError, match=told):
        runs.figures_in(tmp_path)


def test_run_and_its_bag_evaluate_alike(run, bag):
    expected, read = evaluate(run), evaluate(runs.from_bag(bag))
    assert read.keys() == expected.keys()
    for key in ("landmarks_seen", "association_precision", "association_recall", "dropped"):
        assert read[key] == expected[key]
    assert read["map_rmse_m"] == pytest.approx(expected["map_rmse_m"], abs=1e-9)


def with_means(run: Run) -> Run:
    """Every particle mean lies one metre beside the best particle."""
    beside = np.array([1.0, 0.0, 0.0])
    steps = [
        replace(step, estimates=tuple(replace(e, mean=e.pose + beside) for e in step.estimates))
        for step in run.steps
    ]
    robots = {
        name: replace(robot, online_mean=moved(robot.online, beside))
        for name, robot in run.robots.items()
    }
    return replace(run, steps=steps, robots=robots)


def test_means_come_back_from_the_bag(run, tmp_path):
    written = with_means(run)
    read = runs.from_bag(write_bag(tmp_path / "bag", estimate_messages(written)))
    for name, robot in run.robots.items():
        assert_same_path(read.robots[name].online_mean, moved(robot.online, (1, 0, 0)))
        assert_same_path(read.robots[name].online, robot.online)


def test_bag_without_means_has_none(run, bag):
    read = runs.from_bag(bag)
    assert all(len(robot.online_mean.stamps_ns) == 0 for robot in read.robots.values())
    assert evaluate(read)["pose_nees"] is None


FOREIGN = [
    ("another node's status", [wire.Status("camera: fps", {"rate": "fast"})]),
    ("a namesake without counts", [wire.Status("fusion", {"core temperature": "41 K"})]),
    ("a namesake whose values are none", [wire.Status("fusion", {"dropped: pixels": "a few"})]),
    ("a namesake that says nothing", [wire.Status("fusion", {})]),
    ("a negative count", [wire.Status("fusion", {"dropped: late": "-3"})]),
]


@pytest.mark.parametrize("statuses", [s for _, s in FOREIGN], ids=[name for name, _ in FOREIGN])
def test_other_nodes_diagnostics_are_passed_over(run, tmp_path, statuses):
    """`/diagnostics` belongs to everybody."""
    foreign = (topics.DIAGNOSTICS, wire.encode_diagnostics(0, statuses))
    bag = write_bag(tmp_path / "bag", [*estimate_messages(run), foreign])
    assert runs.from_bag(bag).dropped == {"late": 2}


def test_diagnostics_that_cannot_be_read_are_passed_over(run, tmp_path):
    broken = (topics.DIAGNOSTICS, b"\0\1\0\0\7")
    bag = write_bag(tmp_path / "bag", [*estimate_messages(run), broken])
    assert runs.from_bag(bag).dropped == {"late": 2}


def test_a_live_fusion_that_dropped_nothing_more_is_heard(run, tmp_path):
    nothing = wire.encode_diagnostics(0, [wire.Status("fusion", {"steps": "7"})])
    bag = write_bag(tmp_path / "bag", [*estimate_messages(run), (topics.DIAGNOSTICS, nothing)])
    assert runs.from_bag(bag).dropped == {}


def in_namespace(messages: list, namespace: str) -> list:
    return [(topic._replace(name=absolute(topic.name, namespace)), d) for topic, d in messages]


@pytest.mark.parametrize("namespace", ["/fleet", "/site_1/fleet"])
def test_a_live_run_in_a_namespace_comes_back(run, tmp_path, namespace):
    messages = odometry_messages(run) + truth_messages(run) + estimate_messages(run)
    read = runs.load(write_bag(tmp_path / "bag", in_namespace(messages, namespace)))
    assert read.namespace == namespace
    expected = evaluate(run)
    result = evaluate(read)
    assert result["namespace"] == namespace
    for key in ("path_rmse_m", "odometry_path_rmse_m", "map_rmse_m", "landmarks_seen"):
        assert result[key] == pytest.approx(expected[key], abs=1e-9), key


def test_of_several_namespaces_one_must_be_chosen(run, tmp_path):
    shorter = fake_run(robots=2, steps=7)
    both = [
        (absolute_in, message)
        for absolute_in, own in (("/a", run), ("/b", shorter))
        for message in odometry_messages(own) + truth_messages(own) + estimate_messages(own)
    ]
    messages = [in_namespace([message], namespace)[0] for namespace, message in both]
    bag = write_bag(tmp_path / "bag", messages)
    with pytest.raises(InputError, match=r"namespaces /a, /b; choose one: --namespace"):
        runs.load(bag)
    for chosen, own in (("/a", run), ("b", shorter)):
        assert len(runs.load(bag, chosen).steps) == len(own.steps)
        assert len(runs.recorded(bag, run.robots, chosen).observation_truth) == len(
            own.observation_truth
        )
    with pytest.raises(InputError, match="/c/fusion/config not in it"):
        runs.load(bag, "/c")


def test_offline_run_of_a_recording_in_a_namespace_comes_back(run, tmp_path):
    messages = odometry_messages(run) + truth_messages(run)
    elsewhere = in_namespace(odometry_messages(run), "/other")
    bag = write_bag(tmp_path / "bag", in_namespace(messages, "/fleet") + elsewhere)
    written = replace(run, namespace="/fleet")
    written_offline(written, tmp_path / "out", bag)
    read = runs.load(tmp_path / "out")
    assert read.namespace == "/fleet"
    assert_same_path(read.robots["robot_1"].truth, run.robots["robot_1"].truth)


def test_a_live_runs_result_tells_what_made_it(run, bag, tmp_path):
    folder = tmp_path / "live"
    folder.mkdir()
    (folder / "bag").symlink_to(bag)
    assert runs.load(folder).provenance is None
    made = replace(runs.load(folder), provenance=runs.here("calibrated"))
    runs.write(made, evaluate(made), folder)
    assert runs.load(folder).provenance == made.provenance
    (folder / "result.json").write_text("{half")
    assert runs.load(folder).provenance is None


def test_a_folder_that_is_no_run_is_told_what_one_is(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(InputError, match="is no run's folder") as error:
        runs.load(tmp_path)
    for word in ("estimates/", "bag/", "*.mcap", "`run`", "`demo`"):
        assert word in str(error.value)
    with pytest.raises(InputError, match="no such folder"):
        runs.load(tmp_path / "nowhere")


def test_bag_without_truth_gives_none_there(run, tmp_path):
    read = runs.from_bag(write_bag(tmp_path / "bag", estimate_messages(run)))
    assert read.true_landmarks is None
    assert read.walls is None
    assert read.observation_truth == {}
    assert all(robot.truth is None for robot in read.robots.values())


@pytest.mark.parametrize(
    "missing",
    [
        [topics.FUSION_CONFIG],
        [topics.STEPS],
        [topics.MAP_LANDMARKS],
        [topics.path("robot_1"), topics.path("robot_2")],
    ],
    ids=lambda missing: missing[0].name,
)
def test_bag_without_estimates_is_refused_naming_what_is_missing(run, tmp_path, missing):
    bag = write_bag(tmp_path / "bag", without(estimate_messages(run), *missing))
    with pytest.raises(InputError, match="multi_robot_slam run") as error:
        runs.from_bag(bag)
    for topic in missing:
        assert f"/{topic.name}" in str(error.value)


def test_silent_robot_has_empty_trajectories(run, tmp_path):
    silent = (topics.path("robot_2"), topics.pose("robot_2"))
    bag = write_bag(tmp_path / "bag", without(estimate_messages(run), *silent))
    robot = runs.from_bag(bag).robots["robot_2"]
    assert robot.path.poses.shape == (0, 3)
    assert robot.online.poses.shape == (0, 3)


def test_recording_without_estimates_still_gives_odometry_and_truth(run, tmp_path):
    bag = write_bag(tmp_path / "bag", odometry_messages(run) + truth_messages(run))
    recorded = runs.recorded(bag, run.robots)
    for name, robot in run.robots.items():
        assert_same_path(recorded.odometry[name], robot.odometry)
        assert_same_path(recorded.truth[name], robot.truth)


def test_assembled_run_has_the_poses_published_at_each_step(run):
    late = [
        replace(step, estimates=tuple(replace(e, pose=e.pose + 1.0) for e in step.estimates))
        for step in run.steps
    ]
    paths = {name: robot.path for name, robot in run.robots.items()}
    recording = runs.Recorded(odometry={})
    assembled = runs.assemble(run.config, recording, late, paths, run.landmarks, {})
    for name, robot in run.robots.items():
        assert_same_path(assembled.robots[name].online, moved(robot.truth, (1.0, 1.0, 1.0)))
        assert len(assembled.robots[name].odometry.stamps_ns) == 0


def test_trajectory_is_by_stamp_and_has_each_once():
    stamps = [30, 10, 20, 10]
    samples = [PoseSample("r", s, np.full(3, row)) for row, s in enumerate(stamps)]
    path = runs.trajectory(samples)
    assert path.stamps_ns.tolist() == [10, 20, 30]
    assert path.poses[:, 0].tolist() == [1, 2, 0]


def test_folder_holds_what_other_programs_read(run, tmp_path):
    figures = evaluate(run)
    runs.write(run, figures, tmp_path)
    assert json.loads((tmp_path / "result.json").read_text()) == figures
    text = (tmp_path / "config.yaml").read_text()
    assert scenario_file.from_yaml(Config, text, SECTION) == run.config
    assert {path.name for path in tmp_path.glob("*.tum")} == {
        "trajectory_robot_1.tum",
        "trajectory_robot_2.tum",
        "truth_robot_1.tum",
        "truth_robot_2.tum",
    }


def test_table_of_figures_holds_every_figure_of_team_and_robots(run, tmp_path):
    run = replace(run, provenance=runs.here("paper"))
    figures = evaluate(run)
    runs.write(run, figures, tmp_path)
    rows = list(csv.DictReader((tmp_path / "figures.csv").read_text().splitlines()))
    read = {(row["robot"], row["figure"]): row["value"] for row in rows}
    assert len(read) == len(rows)
    for who, own in {"team": figures, **figures["robots"]}.items():
        for name in own.keys() - {"robots", "dropped", "machine"}:
            expected = "" if own[name] is None else str(own[name])
            assert read.pop((who, name)) == expected
    machine = {f"machine: {name}": str(value) for name, value in figures["machine"].items()}
    assert read == {
        ("team", name): value for name, value in {"dropped: late": "2", **machine}.items()
    }


def test_written_truth_is_at_the_stamps_of_the_path(run, tmp_path):
    robot = run.robots["robot_1"]
    late = Trajectory(robot.path.stamps_ns[3:] + 11, robot.path.poses[3:])
    changed = replace(run, robots={"robot_1": replace(robot, path=late)})
    runs.write(changed, {}, tmp_path)
    stamps = [
        [line.split()[0] for line in (tmp_path / f"{kind}_robot_1.tum").read_text().splitlines()]
        for kind in ("truth", "trajectory")
    ]
    assert stamps[0] == stamps[1][:-1]  # the last pose is later than the truth


def test_refined_run_leaves_its_paths_and_map(run, tmp_path):
    refined = {"robot_2": moved(run.robots["robot_2"].path, (1, 0, 0))}
    changed = replace(run.with_paths(refined=refined), refined_landmarks=fake_run().landmarks)
    runs.write(changed, {}, tmp_path)
    assert {path.name for path in tmp_path.glob("refined_*")} == {
        "refined_robot_2.tum",
        "refined_map.csv",
    }
    expected = runs.to_tum(refined["robot_2"])
    assert (tmp_path / "refined_robot_2.tum").read_text() == expected


def test_tum_file_parses_back_to_the_nanosecond(run):
    path = run.robots["robot_2"].path
    path = Trajectory(path.stamps_ns + 7, path.poses)
    lines = [line.split() for line in runs.to_tum(path).splitlines()]
    stamps = [int(line[0].replace(".", "")) for line in lines]
    assert all(len(line[0].split(".")[1]) == 9 for line in lines)
    assert stamps == path.stamps_ns.tolist()
    x, y, z, qx, qy, qz, qw = np.array([line[1:] for line in lines], float).T
    np.testing.assert_allclose(np.column_stack([x, y]), path.poses[:, :2], atol=1e-8)
    np.testing.assert_array_equal([z, qx, qy], 0)
    np.testing.assert_allclose(np.exp(2j * np.arctan2(qz, qw)), np.exp(1j * path.poses[:, 2]))


def test_map_file_parses_back_exactly(run, tmp_path):
    runs.write(run, {}, tmp_path)
    text = (tmp_path / "map.csv").read_text()
    assert text.splitlines()[0] == MAP_COLUMNS
    rows = list(csv.DictReader(text.splitlines()))
    landmarks = run.landmarks
    assert [int(row["id"]) for row in rows] == landmarks.ids.tolist()
    places = np.array([[row[axis] for axis in "xyz"] for row in rows], float)
    np.testing.assert_array_equal(places.astype(np.float32), landmarks.positions)
    variances = np.array([row["cov_zz"] for row in rows], float)
    np.testing.assert_array_equal(variances.astype(np.float32), landmarks.covariances[:, 5])
    assert [int(row["observations"]) for row in rows] == landmarks.observations.tolist()


def test_a_script_finds_the_public_names_in_one_place():
    """Each is what its room exports, and a name that is none is refused."""
    import multi_robot_slam

    public = {name: getattr(multi_robot_slam, name) for name in multi_robot_slam.__all__}
    assert public["load_run"] is runs.load
    assert public["evaluate"] is evaluate
    assert public["Run"] is Run
    assert public["estimate"].__module__ == "multi_robot_slam.pipeline.offline"
    with pytest.raises(AttributeError, match="'nothing'"):
        _ = multi_robot_slam.nothing
