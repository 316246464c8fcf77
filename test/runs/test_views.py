"""A run's pictures: chosen, written, and read again."""

import numpy as np
import pictures
import pytest

from msg_defs import topics, wire
from multi_robot_slam import runs
from multi_robot_slam.pipeline import landmarks, offline
from multi_robot_slam.runs import views


@pytest.fixture
def bag(tmp_path):
    pictures.record(tmp_path / "bag")
    return tmp_path / "bag"


@pytest.mark.parametrize("beforehand", [True, False])
def test_a_run_on_pictures_keeps_what_its_keyframes_saw(bag, tmp_path, command, beforehand):
    if beforehand:
        landmarks.write(bag, tmp_path / "seen", pictures.team(), pytest.fail)
        bag = tmp_path / "seen"
    code, _, told = command("run", bag, "--out", tmp_path / "run")
    assert code == 0, told
    run = runs.load(tmp_path / "run")
    seen = run.views["robot_1"]
    assert [view.stamp_ns for view in seen] == [step.stamp_ns for step in run.steps]
    for view, step in zip(seen, run.steps, strict=True):
        assert len(view.points_px("robot_1")) == len(step.frames[0].landmarks)


def test_points_are_where_the_front_end_found_them(bag):
    run = offline.estimate(bag, pictures.team(), pytest.fail)
    (view, *_) = run.views["robot_1"]
    assert view.size_px() == (240, 160)
    points = view.points_px("robot_1")
    cloud = wire.decode_observations(view.observations, "robot_1")
    x, y, z = cloud.positions.T
    expected = np.column_stack([120 + 200 * x / z, 80 - 200 * y / z])
    np.testing.assert_allclose(points, expected, atol=1e-3)
    assert ((points >= 0) & (points < [240, 160])).all()
    assert view.jpeg().startswith(b"\xff\xd8\xff")


def test_of_many_views_every_nth_is_kept(monkeypatch):
    monkeypatch.setattr(views, "MOST_VIEWS", 4)
    choice = runs.ViewChoice()
    for n in range(30):
        choice.add("robot_1", n, [(topic, b"") for topic in views.topics_of("robot_1")])
        choice.add("robot_2", n, [(topics.observations("robot_2"), b"")])
    kept = choice.views()
    assert [view.stamp_ns for view in kept["robot_1"]] == [0, 8, 16, 24]
    assert set(kept) == {"robot_1"}


def test_a_run_without_pictures_has_no_views(tmp_path):
    import recordings

    recordings.record(tmp_path / "bag", is_live=True)
    assert runs.load(tmp_path / "bag").views == {}
