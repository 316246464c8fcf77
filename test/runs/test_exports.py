"""What is exported reads back as what was written, with the readers of others."""

from dataclasses import replace

import gtsam
import numpy as np
import plyfile
import pytest
from evo.tools import file_interface

from msg_defs.errors import InputError
from msg_defs.types import Trajectory
from multi_robot_slam import runs
from multi_robot_slam.models.motion import increment, spread
from multi_robot_slam.runs import exports
from test.helpers import fake_landmarks, fake_run, moved


@pytest.fixture(params=[False, True], ids=["best particle", "refined"])
def run(request):
    run = fake_run(robots=2)
    if not request.param:
        return run
    refined = {name: moved(robot.path, (1, 2, 0)) for name, robot in run.robots.items()}
    return replace(
        run.with_paths(refined=refined), refined_landmarks=fake_run(landmarks=5).landmarks
    )


def expected(run):
    """The paths and the map that an export of the run holds."""
    if run.refined_landmarks is None:
        return [robot.path for robot in run.robots.values()], run.landmarks
    return [robot.refined for robot in run.robots.values()], run.refined_landmarks


def test_tum_files_read_back(run, tmp_path):
    exports.export(run, "tum", tmp_path / "paths")
    kinds = {"trajectory", "truth", "online", "odometry"}
    kinds |= {"refined"} if run.refined_landmarks else set()
    assert {file.name for file in (tmp_path / "paths").iterdir()} == {
        f"{kind}_{name}.tum" for kind in kinds for name in run.robots
    }
    for name, robot in run.robots.items():
        read = file_interface.read_tum_trajectory_file(tmp_path / f"paths/online_{name}.tum")
        np.testing.assert_allclose(read.positions_xyz[:, :2], robot.online.poses[:, :2], atol=1e-8)
        np.testing.assert_allclose(read.timestamps, robot.online.stamps_ns / 1e9)


def test_pose_graph_reads_back_with_gtsam(run, tmp_path):
    exports.export(run, "g2o", tmp_path / "run.g2o")
    graph, values = gtsam.readG2o(str(tmp_path / "run.g2o"), False)
    paths, landmarks = expected(run)
    poses = np.concatenate([path.poses for path in paths])
    for row, pose in enumerate(poses):
        read = values.atPose2(row)
        np.testing.assert_allclose([read.x(), read.y()], pose[:2], rtol=0, atol=1e-12)
        assert np.cos(read.theta() - pose[2]) == pytest.approx(1, abs=1e-12)
    places = [values.atPoint2(gtsam.symbol("l", len(poses) + n)) for n in range(len(landmarks.ids))]
    np.testing.assert_array_equal(np.float32(places), landmarks.positions[:, :2])
    assert values.size() == len(poses) + len(places)
    assert graph.size() == sum(len(path.poses) - 1 for path in paths)


def test_edges_are_the_increments_of_the_odometry_with_the_noise_the_filter_was_told(tmp_path):
    run = fake_run(robots=2)
    exports.export(run, "g2o", tmp_path / "run.g2o")
    graph, values = gtsam.readG2o(str(tmp_path / "run.g2o"), False)
    assert graph.error(values) == pytest.approx(0, abs=1e-12)  # odometry is right in a fake run
    robot = run.robots["robot_2"]
    poses = robot.odometry.poses
    for row in range(len(poses) - 1):
        factor = graph.at(len(run.robots["robot_1"].path.poses) - 1 + row)
        assert [key - len(poses) for key in factor.keys()] == [row, row + 1]  # noqa: SIM118
        motion = increment(poses[row], poses[row + 1])
        xx, xy, yy, yaw = spread(motion, 0.1, run.config.filter.motion)
        covariance = factor.noiseModel().covariance()
        told = [[xx, xy, 0], [xy, yy, 0], [0, 0, yaw]]
        np.testing.assert_allclose(covariance, told, rtol=1e-3, atol=1e-9)


def test_robot_that_stood_still_or_has_no_odometry_gives_a_readable_graph(tmp_path):
    run = fake_run(robots=2)
    one, two = run.robots.values()
    still = Trajectory(one.path.stamps_ns, np.zeros((len(one.path.poses), 3)))
    robots = {"robot_1": replace(one, odometry=still), "robot_2": replace(two, odometry=runs.EMPTY)}
    exports.export(replace(run, robots=robots), "g2o", tmp_path / "run.g2o")
    graph, values = gtsam.readG2o(str(tmp_path / "run.g2o"), False)
    assert graph.size() == len(one.path.poses) - 1
    assert np.isfinite(graph.error(values))


def test_cloud_reads_back_with_plyfile(run, tmp_path):
    exports.export(run, "ply", tmp_path / "run.ply")
    points = plyfile.PlyData.read(tmp_path / "run.ply")["vertex"].data
    paths, landmarks = expected(run)
    of_map = points[points["robot"] == -1]
    assert of_map["landmark"].tolist() == landmarks.ids.tolist()
    places = np.column_stack([of_map[axis] for axis in "xyz"])
    np.testing.assert_array_equal(places, landmarks.positions)
    sigmas = np.sqrt(landmarks.covariances[:, 0])  # the fake landmarks' are spheres
    np.testing.assert_allclose(of_map["sigma"], sigmas, rtol=1e-6)
    for index, path in enumerate(paths):
        own = points[points["robot"] == index]
        np.testing.assert_array_equal(own["x"], path.poses[:, 0].astype(np.float32))
        np.testing.assert_array_equal(own["y"], path.poses[:, 1].astype(np.float32))
        assert set(own["landmark"].tolist()) == {-1}
    assert len(points) == len(landmarks.ids) + sum(len(path.poses) for path in paths)
    colours = {tuple(point) for point in points[["red", "green", "blue"]].tolist()}
    assert len(colours) == 1 + len(paths)


def test_run_without_landmarks_or_truth_is_exported(tmp_path):
    run = fake_run(robots=1)
    run = replace(run, landmarks=fake_landmarks(0), true_landmarks=None)
    run = replace(run, robots={n: replace(r, truth=None) for n, r in run.robots.items()})
    for name in exports.FORMATS:
        assert exports.export(run, name, tmp_path / name)


@pytest.mark.parametrize(
    ("name", "place", "told"),
    [
        ("png", "out", "unknown format 'png'"),
        ("ply", "file/out", "cannot write"),
        ("ply", "file", "exists; remove it or choose another"),
        ("g2o", "file", "exists; remove it or choose another"),
        ("tum", "folder", "exists; remove it or choose another"),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path, name, place, told):
    (tmp_path / "file").write_text("precious")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=told):
        exports.export(fake_run(), name, tmp_path / place)
    assert (tmp_path / "file").read_text() == "precious"
    assert not list((tmp_path / "folder").iterdir())
