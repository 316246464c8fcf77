"""What the figures show."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.image import imread

from msg_defs.errors import InputError
from msg_defs.types import Tied, Trajectory
from multi_robot_slam.report import plots
from multi_robot_slam.runs import Run
from test.helpers import fake_landmarks, fake_run, moved


def without_truth(run: Run) -> Run:
    robots = {name: replace(robot, truth=None) for name, robot in run.robots.items()}
    return replace(run, robots=robots, true_landmarks=None, walls=None, observation_truth={})


def lines(axes, style: dict) -> list:
    return [line for line in axes.get_lines() if line.get_label() == style["label"]]


def only(axes, kind: type):
    (found,) = [artist for artist in axes.collections if isinstance(artist, kind)]
    return found


def legend_texts(axes) -> list[str]:
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_map_shows_paths_of_each_robot_in_its_colour():
    run = fake_run(robots=3)
    (axes,) = plots.map_figure(run).axes
    shown = {
        style["label"]: lines(axes, style)
        for style in (plots._TRUE_PATH, plots._ODOMETRY, plots._LIVE, plots._AFTER)
    }
    for index, robot in enumerate(run.robots.values()):
        for drawn in shown.values():
            assert drawn[index].get_color() == plots.ROBOT_COLOURS[index]
            np.testing.assert_allclose(
                drawn[index].get_xydata(), robot.truth.poses[:, :2], atol=1e-9
            )
    assert [line.get_linestyle() for line in shown["true path"]] == ["-"] * 3
    assert [line.get_linestyle() for line in shown["odometry"]] == ["--"] * 3
    assert [line.get_marker() for line in shown["live path"]] == ["s"] * 3


def test_where_and_when_a_place_became_known_is_marked():
    run = fake_run(robots=2, steps=5)
    tied = Tied(("robot_2",), True, np.zeros(3), 9, 7, 2, 1.5)
    steps = [replace(s, tied=tied if row == 3 else None) for row, s in enumerate(run.steps)]
    marked = replace(run, steps=steps)
    (axes,) = plots.map_figure(marked).axes
    star, in_legend = (line for line in lines(axes, plots._PLACED)), legend_texts(axes)
    first = run.robots["robot_2"].online.poses[0, :2]
    np.testing.assert_allclose([line.get_xydata()[0] for line in star], [first])
    assert plots._PLACED["label"] in in_legend
    since_s = (steps[3].stamp_ns - steps[0].stamp_ns) / 1e9
    axes = plots.error_figure(marked).axes[0]
    assert since_s in [line.get_xdata()[0] for line in axes.get_lines()]
    assert [text.get_text() for text in axes.texts] == ["robot_2: place known"]
    assert plots._PLACED["label"] not in legend_texts(plots.map_figure(run).axes[0])
    assert not plots.error_figure(run).axes[0].texts


def test_the_main_line_of_the_map_is_what_was_published():
    run = fake_run(robots=1)
    robot = replace(run.robots["robot_1"], online=moved(run.robots["robot_1"].truth, (1, 2, 0)))
    (axes,) = plots.map_figure(replace(run, robots={"robot_1": robot})).axes
    (live,), (after,) = lines(axes, plots._LIVE), lines(axes, plots._AFTER)
    np.testing.assert_allclose(live.get_xydata(), robot.online.poses[:, :2])
    np.testing.assert_allclose(after.get_xydata(), robot.path.poses[:, :2])
    assert live.get_zorder() > after.get_zorder()


def test_map_shows_world_and_landmarks_in_metres_of_equal_length():
    run = fake_run()
    (axes,) = plots.map_figure(run).axes
    assert axes.get_aspect() == 1
    assert axes.get_xlabel() == "x [m]"
    walls = np.array(only(axes, LineCollection).get_segments())
    np.testing.assert_array_equal(walls.reshape(-1, 4), run.walls.segments)
    (true,) = lines(axes, plots._TRUE_LANDMARK)
    np.testing.assert_allclose(true.get_xydata(), run.true_landmarks.positions[:, :2])
    offsets = only(axes, EllipseCollection).get_offsets()
    np.testing.assert_allclose(offsets, run.landmarks.positions[:, :2])


def test_ellipses_hold_95_percent():
    half_deg, sigmas_m = np.radians(30), np.array([0.5, 0.2])
    axis = np.array([np.cos(half_deg), np.sin(half_deg)])
    across = np.array([-axis[1], axis[0]])
    matrix = sigmas_m[0] ** 2 * np.outer(axis, axis) + sigmas_m[1] ** 2 * np.outer(across, across)
    six = np.array([[matrix[0, 0], matrix[0, 1], 0.7, matrix[1, 1], 0.7, 9.0]])
    (width,), (height,), (angle,) = plots.ellipses(six)
    assert angle == pytest.approx(30)
    assert height / width == pytest.approx(0.2 / 0.5)
    normal = np.random.default_rng(0).multivariate_normal([0, 0], matrix, 20_000)
    inside = (normal @ axis / (width / 2)) ** 2 + (normal @ across / (height / 2)) ** 2 < 1
    assert inside.mean() == pytest.approx(0.95, abs=0.01)


def test_legend_names_what_is_there():
    run = fake_run(robots=2)
    everything = legend_texts(plots.map_figure(run).axes[0])
    assert everything[:2] == ["robot_1", "robot_2"]
    assert {"true path", "odometry", "live path", "path after the run", "wall"} <= {*everything}
    bare = legend_texts(plots.map_figure(without_truth(run)).axes[0])
    assert not {"true path", "wall", "true landmark"} & {*bare}


def test_more_robots_than_colours_and_an_empty_map_are_drawn():
    run = replace(fake_run(robots=8), landmarks=fake_landmarks(0))
    (axes,) = plots.map_figure(run).axes
    assert len(lines(axes, plots._LIVE)) == 8


def test_error_figure_shows_both_series_over_time():
    run = fake_run(robots=3)
    robots = {
        name: replace(
            robot,
            online=moved(robot.truth, (0.1, 0.2, 0.3)),
            path=moved(robot.truth, (0.01, 0.02, 0.03)),
        )
        for name, robot in run.robots.items()
    }
    figure = plots.error_figure(replace(run, robots=robots))
    live, after, odometry = np.array(figure.axes, object).reshape(3, 3).T
    both = [(*live, *after), (0.1, 0.2, 0.3, 0.01, 0.02, 0.03)]
    for axes, error in zip(*both, strict=True):
        drawn = [line for line in axes.get_lines() if line.get_label() in run.robots]
        assert [line.get_linestyle() for line in drawn] == ["-", "--", "-."]
        for line in drawn:
            np.testing.assert_allclose(line.get_ydata(), error)
            np.testing.assert_allclose(line.get_xdata(), 0.1 * np.arange(20), atol=1e-9)
    for axes in odometry:
        for line in axes.get_lines():
            np.testing.assert_allclose(line.get_ydata(), 0, atol=1e-9)
    assert [axes.get_ylabel() for axes in live] == ["x [m]", "y [m]", "θ [rad]"]
    titles = [column[0].get_title(loc="left") for column in (live, after, odometry)]
    assert [title.split(" − ")[0] for title in titles] == [
        "(a) live",
        "(b) after the run",
        "(c) odometry",
    ]
    assert "0.224 m" in titles[0]
    assert "0.022 m" in titles[1]


def test_robot_keeps_its_look_when_another_has_no_truth():
    run = fake_run(robots=2)
    robots = {**run.robots, "robot_1": replace(run.robots["robot_1"], truth=None)}
    axes = plots.error_figure(replace(run, robots=robots)).axes[0]
    (line,) = [line for line in axes.get_lines() if line.get_label() in run.robots]
    assert line.get_label() == "robot_2"
    assert line.get_color() == plots.ROBOT_COLOURS[1]


def test_silent_robot_is_drawn_as_nothing():
    run = fake_run(robots=2)
    nothing = Trajectory(np.empty(0, np.int64), np.empty((0, 3)))
    silent = replace(run.robots["robot_1"], odometry=nothing, online=nothing, path=nothing)
    quiet = replace(run, robots={**run.robots, "robot_1": silent})
    plots.map_figure(quiet).draw_without_rendering()
    plots.error_figure(quiet).draw_without_rendering()


def test_errors_without_truth_are_refused():
    with pytest.raises(InputError, match="no ground truth"):
        plots.error_figure(without_truth(fake_run()))


def test_pictures_are_saved(tmp_path):
    paths = plots.save(fake_run(), tmp_path / "new")
    assert [path.name for path in paths] == ["map.png", "errors.png"]
    for path in paths:
        assert imread(path).std() > 0.01
    bare = plots.save(without_truth(fake_run()), tmp_path / "bare")
    assert [path.name for path in bare] == ["map.png"]
