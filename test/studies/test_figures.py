"""The paper's figures 5 to 9 from a table, and 3 from a run."""

import dataclasses

import numpy as np
import pytest
from helpers import fake_run

from msg_defs.types import CameraMount, ObservationSet
from multi_robot_slam.studies import figures
from multi_robot_slam.studies.experiment_grid import Grid, paper, plan
from multi_robot_slam.studies.experiment_table import RESULTS
from sim_world import stereo

GRID = Grid((1, 50, 500), (6.0, 8.0, 10.0), (0.01, 0.012, 0.014), (0, 5, 15))


def fake_rows(names=("fig5", "fig6", "fig7", "fig8", "fig9"), seeds=range(4)):
    """Every run of a small grid; the path error is 1/K + 0.1 seed, odometry's ten times that."""
    rows = {}
    for figure, trial in plan(names, GRID, seeds, paper()):
        error = 1 / trial.robots + 0.1 * trial.seed
        values = dict.fromkeys(RESULTS, 0.5) | {"path_rmse_m": error}
        values |= {"odometry_path_rmse_m": 10 * error, "batch_path_rmse_m": 0.01}
        values["map_rmse_m"] = error if trial.observations else None
        rows[figure, trial] = values
    return rows


def lines(axes):
    """Marker, line style -> x and y of each line with error bars."""
    drawn = [container.lines[0] for container in axes.containers]
    return {(line.get_marker(), line.get_linestyle()): line.get_xydata().T for line in drawn}


def test_markers_are_the_papers_and_proposals_two_line_styles():
    drawn = lines(figures.draw("fig6", fake_rows()).axes[0])
    assert set(drawn) == {(m, line) for m in "os^" for line in ("-", "--")}
    for number, marker in enumerate("os^", start=1):
        x, y = drawn[marker, "-"]
        np.testing.assert_allclose(y, np.full(3, 1 / number + 0.15))
        np.testing.assert_allclose(x, [6, 8, 10], atol=0.2)


def test_bars_are_two_standard_deviations_of_the_runs():
    axes = figures.draw("fig6", fake_rows()).axes[0]
    expected = 2 * np.std([0, 0.1, 0.2, 0.3], ddof=1)
    for container in axes.containers:
        (bars,) = container.lines[2]
        for bottom, top in (segment[:, 1] for segment in bars.get_segments()):
            assert top - bottom == pytest.approx(2 * expected)


def test_without_observations_the_path_is_odometrys():
    path, map_ = figures.draw("fig8", fake_rows()).axes
    x, y = lines(path)["s", "-"]
    np.testing.assert_allclose(y, [6.5, 0.65, 0.65])
    assert len(x) == 3
    assert len(lines(map_)["s", "-"][0]) == 2


def test_figure_9_tells_b_each_from_the_shared_b():
    rows = fake_rows(["fig9"])
    for (_, trial), result in rows.items():
        result["step_ms_mean"] = float(trial.observations)
    each, shared, errors = figures.draw("fig9", rows).axes
    for number, marker in enumerate("os^", start=1):
        np.testing.assert_allclose(lines(each)[marker, "-"][1], 15)
        np.testing.assert_allclose(lines(shared)[marker, "-"][1], 15 // number)
        np.testing.assert_allclose(lines(errors)[marker, "--"][1], 1 / number + 0.15)


def test_figure_7_shows_precision_and_recall():
    rows = fake_rows(["fig7"])
    for result in rows.values():
        result |= {"association_precision": 0.75, "association_recall": 0.25}
    _, _, precision, recall = figures.draw("fig7", rows).axes
    np.testing.assert_allclose(lines(precision)["o", "-"][1], 0.75)
    np.testing.assert_allclose(lines(recall)["o", "-"][1], 0.25)


def test_references_are_drawn_where_the_table_has_them():
    rows = fake_rows(["fig5"])

    def labels():
        (legend,) = figures.draw("fig5", rows).legends
        return {text.get_text() for text in legend.get_texts()}

    assert {"odometry", "batch"} <= labels()
    for result in rows.values():
        result["batch_path_rmse_m"] = None
    assert "batch" not in labels()


def test_every_figure_in_the_table_is_saved(tmp_path):
    paths = figures.save(fake_rows(["fig5", "fig9"], seeds=[0]), tmp_path)
    assert [path.name for path in paths] == ["fig5.png", "fig9.png"]
    assert all(path.stat().st_size > 10_000 for path in paths)


def test_view_undoes_the_camera():
    rng = np.random.default_rng(1)
    pose, mount = np.array([3.0, -2.0, 2.5]), CameraMount(0.3, 0.1, 1.2)
    points = np.array([*pose[:2], 0]) + rng.normal(size=(6, 3))
    seen = stereo.camera_from_map(points, pose, mount)
    none = np.zeros((6, 6), np.float32)
    eye, measured = figures.view(pose, ObservationSet("", 0, seen, none, none), mount)
    np.testing.assert_allclose(measured, points, atol=1e-9)
    camera = dataclasses.replace(paper().scenario.camera, mount=mount)
    np.testing.assert_allclose(eye, stereo.eyes(pose, camera)[0], atol=1e-9)


def test_world_figure_has_a_sight_for_every_observation():
    run = fake_run(robots=2)
    views = [figures.View(np.zeros(3), np.ones((4, 3))), figures.View(np.ones(3), np.ones((2, 3)))]
    (axes,) = figures.world_figure(run, views).axes
    sights = [c for c in axes.collections if type(c).__name__ == "Line3DCollection"]
    assert [len(c._segments3d) for c in sights] == [4, 2]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == list(run.robots)


def test_map_figure_shows_every_particle():
    run = fake_run(robots=2)
    clouds = {name: np.random.default_rng(0).normal(size=(7, 3)) for name in run.robots}
    (axes,) = figures.map_figure(run, clouds).axes
    drawn = [line.get_xydata() for line in axes.lines[-2:]]
    for cloud, points in zip(clouds.values(), drawn, strict=True):
        np.testing.assert_array_equal(points, cloud[:, :2])
