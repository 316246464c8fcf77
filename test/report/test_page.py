"""What the report shows: its figures as data, and the page in a real browser."""

import base64
import json
import re
from dataclasses import replace

import browsing
import numpy as np
import pytest
import recordings
from hypothesis import given
from hypothesis import strategies as st

from msg_defs import wire
from msg_defs.types import CameraInfo, Estimate, Image, ObservationSet, Tied, Verdict
from multi_robot_slam import runs
from multi_robot_slam.report import (
    charts,
    innovations,
    levels,
    page,
    scene,
    sights,
    size,
    slider,
    timeline,
)
from multi_robot_slam.runs import evaluation
from multi_robot_slam.runs.colours import ROBOT_COLOURS
from test.helpers import fake_frame, fake_landmarks, fake_run, moved

DTYPES = {"f4": np.float32, "i4": np.int32}


def unpacked(value):
    return np.frombuffer(base64.b64decode(value["bdata"]), DTYPES[value["dtype"]])


def bare(robots=2, **changes):
    """A run of real robots: no truth, no walls."""
    run = fake_run(robots=robots)
    own = {name: replace(robot, truth=None) for name, robot in run.robots.items()}
    nothing = {"true_landmarks": None, "walls": None, "observation_truth": {}}
    return replace(run, robots=own, **nothing, **changes)


def page_of(run):
    return page.page(run, evaluation.evaluate(run), "a run")


def traces(run, layer):
    figure = scene.figure(run, timeline.timeline(run))
    return [trace for trace in figure.data if trace.meta["layer"] == layer]


# ---- time


@given(count=st.integers(0, 500), most=st.integers(1, 50))
def test_thinned_rows_are_few_and_evenly_spread_and_hold_both_ends(count, most):
    rows = timeline.thinned(count, most)
    assert len(rows) <= min(count, most + 1)
    if count:
        assert (rows[0], rows[-1]) == (0, count - 1)
        gaps = np.diff(rows)
        assert (gaps[:-1] == gaps[:1]).all()
        assert gaps.size == 0 or 0 < gaps[-1] <= gaps[0]


@given(values=st.lists(st.integers(0, 99)), most=st.integers(1, 20))
def test_grouping_loses_nothing(values, most):
    sums = timeline.grouped(np.add, values, most)
    assert len(sums) <= most
    assert sums.sum() == sum(values)
    if values:
        assert timeline.grouped(np.maximum, values, most).max() == max(values)


def test_a_long_run_has_few_instants_each_the_last_of_its_steps(monkeypatch):
    monkeypatch.setattr(timeline, "MOST_SAMPLES", 6)
    run = fake_run(steps=20)
    times = timeline.timeline(run)
    assert times.every == 4
    assert times.steps.tolist() == [3, 7, 11, 15, 19]
    assert times.seconds(times.stamps_ns) == pytest.approx([0.3, 0.7, 1.1, 1.5, 1.9])
    assert "stands for 4 steps" in page_of(run)
    assert "stands for" not in page_of(fake_run(steps=5))


def test_hours_of_a_team_stay_below_15_megabytes():
    run = fake_run(robots=3, steps=2000, landmarks=8000)
    hours = replace(run, steps=[step for _ in range(20) for step in run.steps])
    assert len(page_of(hours)) < 15e6


# ---- the scene


def test_roots_are_square_roots_also_of_singular_covariances():
    factors = np.random.default_rng(0).normal(size=(20, 3, 3))
    factors[:5, :, 2] = 0.0
    covariances = factors @ factors.transpose(0, 2, 1)
    roots = size.roots(covariances)
    np.testing.assert_allclose(roots @ roots, 4 * covariances, atol=1e-12)
    np.testing.assert_allclose(roots, roots.transpose(0, 2, 1), atol=1e-12)


def test_every_robot_has_its_paths_in_its_colour():
    run = fake_run(robots=3)
    robots = {name: replace(robot, refined=robot.path) for name, robot in run.robots.items()}
    run = replace(run, robots=robots)
    for layer in ("truth", "odometry", "live", "after", "refined"):
        drawn = traces(run, layer)
        assert [trace.meta["robot"] for trace in drawn] == list(run.robots)
        assert [trace.line.color for trace in drawn] == list(ROBOT_COLOURS[:3])
        for trace, robot in zip(drawn, run.robots.values(), strict=True):
            np.testing.assert_allclose([trace.x, trace.y], robot.path.poses[:, :2].T, atol=1e-9)


def test_walls_stand_on_the_ground_and_close():
    run = fake_run()
    faces, outline = traces(run, "walls")
    corners = np.column_stack([faces.x, faces.y, faces.z]).reshape(-1, 4, 3)
    np.testing.assert_array_equal(corners[:, [0, 1], :2].reshape(-1, 4), run.walls.segments)
    assert set(corners[:, :, 2].ravel()) == {0.0, run.walls.height_m}
    triangles = np.column_stack([faces.x, faces.y, faces.z])[
        np.column_stack([faces.i, faces.j, faces.k])
    ]
    sides = np.diff(triangles, axis=1)
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum() / 2
    lengths = np.hypot(*(run.walls.segments[:, 2:] - run.walls.segments[:, :2]).T)
    assert area == pytest.approx(run.walls.height_m * lengths.sum())
    assert len(outline.x) == 6 * len(run.walls.segments)


def test_frames_hold_what_was_published_and_seen():
    run = fake_run(robots=2, steps=12, landmarks=8)
    frames = slider.frames(run, timeline.timeline(run))
    ids = unpacked(frames["landmarks"]["ids"])
    assert sorted(ids.tolist()) == run.landmarks.ids.tolist()
    first = unpacked(frames["landmarks"]["first"])
    assert (np.diff(first) >= 0).all()
    for step, record in enumerate(run.steps):
        for frame, estimate in zip(record.frames, record.estimates, strict=True):
            shown = frames["robots"][frame.robot]
            start, end = unpacked(shown["seen_starts"])[step : step + 2]
            seen = unpacked(shown["seen"])[start:end]
            assert ids[seen].tolist() == frame.landmarks.tolist()
            assert (first[seen] <= step).all()
            pose = unpacked(shown["poses"]).reshape(-1, 3)[step]
            np.testing.assert_allclose(pose, estimate.pose, atol=1e-6)
            root = unpacked(shown["roots"]).reshape(-1, 3)[step]
            np.testing.assert_allclose(root, [0.02, 0, 0.02], atol=1e-7)
    assert len(np.unique(first)) > 1


@pytest.mark.parametrize(("sigma_m", "scale"), [(5.0, 1), (0.02, 5), (1e-4, 30)])
def test_ellipsoids_are_drawn_large_enough_to_see_and_no_larger(sigma_m, scale):
    run = replace(fake_run(), landmarks=fake_landmarks(8, first_id=100, sigma_m=sigma_m))
    assert np.ptp(size.extent(run), axis=0)[0] == pytest.approx(10.6)
    assert size.first_scale(run) == scale
    assert f'value="{scale}" selected' in page_of(run)


def test_sightings_are_shown_unless_rejected():
    run = fake_run(robots=3, steps=4)
    met = {"others": np.array([1, 2]), "is_other_rejected": np.array([False, True])}
    step = run.steps[2]
    steps = [*run.steps[:2], replace(step, frames=(replace(step.frames[0], **met),))]
    run = replace(run, steps=steps)
    frames = slider.frames(run, timeline.timeline(run))
    shown = frames["robots"]["robot_1"]
    assert unpacked(shown["met_starts"]).tolist()[:4] == [0, 0, 0, 1]
    assert unpacked(shown["met"]).tolist()[:1] == [1]


def test_a_robot_is_shown_from_its_first_pose_and_stays_at_its_last():
    run = fake_run(robots=2, steps=9)
    silent = {*range(3), 8}
    steps = [
        replace(s, frames=s.frames[:1], estimates=s.estimates[:1]) if n in silent else s
        for n, s in enumerate(run.steps)
    ]
    frames = slider.frames(replace(run, steps=steps), timeline.timeline(run))
    poses = unpacked(frames["robots"]["robot_2"]["poses"]).reshape(-1, 3)
    assert np.isnan(poses[:3]).all()
    np.testing.assert_array_equal(poses[8], poses[7])


# ---- the charts


def test_bounds_are_two_sigma_and_errors_are_of_the_mean():
    run = fake_run(robots=1)

    def off(estimate: Estimate) -> Estimate:
        mean = estimate.pose + np.array([0.03, -0.01, 0.0])
        return replace(estimate, mean=mean, covariance=np.diag([1e-4, 1e-4, 1e-4]))

    steps = [replace(s, estimates=tuple(map(off, s.estimates))) for s in run.steps]
    run = replace(run, steps=steps)
    figure = charts.charts(run, timeline.timeline(run))["robot robot_1"]
    drawn = [trace for trace in figure.data if trace.name == "live"]
    for trace, error in zip(drawn, (0.03, -0.01, 0.0), strict=True):
        np.testing.assert_allclose(trace.y, error, atol=1e-9)
    for trace in figure.data:
        if trace.name == "2 σ":
            np.testing.assert_allclose(np.abs(trace.y), 0.02)
    assert charts.inside(run, "robot_1").tolist() == [0.0, 1.0, 1.0]


def test_associations_add_up_to_the_observations():
    run = fake_run(robots=2, steps=15)
    for name in run.robots:
        figure = charts.charts(run, timeline.timeline(run))[f"robot {name}"]
        stacked = [np.array(trace.y) for trace in figure.data if trace.stackgroup]
        observed = [len(f.landmarks) for s in run.steps for f in s.frames if f.robot == name]
        np.testing.assert_allclose(np.sum(stacked, axis=0), observed)
        new = [np.sum(f.is_new) for s in run.steps for f in s.frames if f.robot == name]
        np.testing.assert_allclose(stacked[1], new)


def test_resampled_steps_are_marked():
    run = fake_run(steps=10)
    steps = [replace(step, resampled=n in (2, 7)) for n, step in enumerate(run.steps)]
    figure = charts.charts(replace(run, steps=steps), timeline.timeline(run))["effective"]
    assert figure.data[1].x == pytest.approx([0.2, 0.7])


def test_distance_from_the_truth_is_the_error_in_the_plane():
    run = fake_run(robots=1)
    robot = run.robots["robot_1"]
    run = replace(run, robots={"robot_1": replace(robot, online=moved(robot.truth, (0.3, 0.4, 0)))})
    figure = charts.charts(run, timeline.timeline(run))["distances"]
    np.testing.assert_allclose(figure.data[0].y, 0.5)


# ---- what the monitor said


def judged(said, robots=2):
    """A run in which the monitor says so of robot_1, step by step, and no ill of others."""
    run = fake_run(robots=robots, steps=len(said))
    steps = []
    for step, level in zip(run.steps, said, strict=True):
        fine = [Verdict(name, "consistent") for name in list(run.robots)[1:]]
        own = Verdict("robot_1", level, f"cause at {step.step}", f"remedy at {step.step}")
        steps.append(replace(step, verdicts=(own, *fine)))
    return replace(run, steps=steps)


FINE, NOISY, WRONG = "consistent", "noisier than told", "start wrong"


@given(st.lists(st.sampled_from([FINE, NOISY, WRONG, "lost"]), min_size=1, max_size=12))
def test_levels_change_where_they_differ_and_the_worst_is_told(said):
    run = judged(said)
    changes = levels.changes(run)
    assert changes["robot_2"] == []
    told = [(change.stamp_ns, change.told) for change in changes["robot_1"]]
    stamps = [step.stamp_ns for step in run.steps]
    before = [FINE, *said[:-1]]
    rows = [n for n, level in enumerate(said) if level != before[n]]
    assert told == [(stamps[n], said[n]) for n in rows]
    worst = levels.worst(run)["robot_1"]
    order = [FINE, NOISY, WRONG, "lost"]
    level = max(said, key=order.index)
    assert worst.verdict.level == level
    assert worst.since_ns == stamps[said.index(level)]
    assert worst.is_last == (said[-1] == level)
    last = len(said) - 1 - said[::-1].index(level)
    assert worst.verdict.cause == f"cause at {last}"


def test_the_page_says_first_which_robot_is_wrong_since_when_and_what_to_do():
    shown = page_of(judged([FINE, FINE, WRONG, NOISY, FINE]))
    banner = shown[shown.index("What the monitor says") : shown.index('aria-label="Figures"')]
    assert "robot_1: start wrong" in banner
    assert "from 0.2 s on, though no longer at the end" in banner
    assert "cause at 2" in banner
    assert "Remedy: remedy at 2" in banner
    assert "robot_2" not in banner
    assert "consistent with what" not in banner


def test_the_page_of_a_run_that_is_consistent_alarms_nobody():
    shown = page_of(judged([FINE, FINE]))
    assert "All robots were consistent" in shown
    assert 'class="verdict"' not in shown
    assert "What the monitor says" not in page_of(fake_run())


def test_changes_of_level_are_marked_in_the_charts_of_errors():
    run = judged([FINE, NOISY, NOISY, WRONG])
    found = charts.charts(run, timeline.timeline(run))
    marks = [
        (shape.x0, shape.x1, shape.label.text) for shape in found["robot robot_1"].layout.shapes
    ]
    assert marks == [(0.1, 0.1, NOISY), (0.3, 0.3, WRONG)]
    assert [shape.label.text for shape in found["distances"].layout.shapes] == [
        f"robot_1: {NOISY}",
        f"robot_1: {WRONG}",
    ]
    assert not found["robot robot_2"].layout.shapes
    assert len(found["effective"].layout.shapes) == 1


def tied_in(said, at):
    """A run of two robots, the first in a place that is unknown until step `at`."""
    run = judged(said)
    tied = Tied(("robot_1",), True, np.zeros(3), 9, 7, 2, 1.5)
    steps = [replace(s, tied=tied if row == at else None) for row, s in enumerate(run.steps)]
    return replace(run, steps=steps)


def test_until_when_a_place_was_unknown_is_told_and_marked_and_nobody_is_alarmed():
    run = tied_in(["place unknown", "place unknown", FINE, NOISY], 2)
    found = charts.charts(run, timeline.timeline(run))
    marks = [shape.label.text for shape in found["robot robot_1"].layout.shapes]
    assert marks == ["place unknown", "place known", NOISY]
    run = tied_in(["place unknown", "place unknown", FINE], 2)
    shown = page_of(run)
    banner = shown[shown.index("What the monitor says") : shown.index('aria-label="Figures"')]
    assert 'class="verdict known"' in banner
    assert "until 0.2 s, then known" in banner
    assert "by 9 landmarks of 7 places that agree, where 2 do" in banner
    assert "Remedy" not in banner
    assert "Remedy: remedy at 2" in page_of(judged(["place unknown"] * 3))


def matched(values, others=()):
    """A run whose one robot matched observations and saw robots at these D."""
    run = fake_run(robots=1, steps=1)
    frame = replace(
        fake_frame("robot_1", range(len(values) + 1), [True] + [False] * len(values)),
        mahalanobis=np.append(np.nan, values).astype(np.float32),
        others=np.zeros(len(others) + 1, np.int64),
        other_mahalanobis=np.append(50.0, others).astype(np.float32),
        is_other_rejected=np.array([True] + [False] * len(others)),
    )
    step = replace(run.steps[0], frames=(frame,))
    return replace(run, steps=[step], observation_truth={})


def below(rng, freedom, gate, count):
    values = rng.chisquare(freedom, 2 * count)
    return values[values < gate][:count]


def test_matches_that_follow_the_law_lie_on_it():
    rng, settings = np.random.default_rng(0), fake_run().config.filter
    run = matched(below(rng, 3, settings.gate, 40_000), below(rng, 2, settings.sighting_gate, 9000))
    (observed, seen) = innovations.distances(run)["robot_1"]
    assert (len(observed.values), len(seen.values)) == (40_000, 9000)
    for kind in (observed, seen):
        assert kind.mean == pytest.approx(kind.lawful_mean, rel=0.03)
        assert "as they should be" in kind.told()
    bars, law, *_ = innovations.figure(run, "robot_1", [observed]).data
    np.testing.assert_allclose(bars.y, law.y, atol=0.01)
    for drawn in (bars, law):
        assert np.sum(drawn.y) * settings.gate / innovations.BINS == pytest.approx(1)


@pytest.mark.parametrize(("factor", "word"), [(2.0, "larger"), (0.5, "smaller")])
def test_matches_that_are_off_the_law_are_told_to_be(factor, word):
    gate = fake_run().config.filter.gate
    values = factor**2 * np.random.default_rng(1).chisquare(3, 4000)
    run = matched(values[values < gate])
    (kind,) = innovations.distances(run)["robot_1"]
    assert f"{word} than they should be" in kind.told()
    shown = page_of(run)
    assert f'role="img" aria-label="{kind.told()} "' in shown
    assert f"by the law {kind.lawful_mean:.2f}" in shown


def test_a_run_without_matches_has_no_law():
    assert innovations.distances(fake_run()) == {}
    assert "their law" not in page_of(fake_run())


# ---- the page


def test_page_shows_figures_configuration_and_what_was_dropped():
    run = replace(fake_run(), warnings=("the bag breaks off",))
    shown = page_of(run)
    assert "particles: 500" in shown
    assert re.search(r'scope="row">late</th><td>2<', shown)
    assert "the bag breaks off" in shown
    assert "RMS errors against the truth" in shown
    assert "no truth to be compared" in page_of(bare())


def test_page_says_first_what_was_published_and_then_what_hindsight_makes_of_it():
    run = fake_run(robots=1)
    robot = run.robots["robot_1"]
    apart = replace(robot, online=moved(robot.truth, (0.25, 0, 0)), path=robot.truth)
    shown = page_of(replace(run, robots={"robot_1": apart}))
    heads = re.findall(r'scope="col">([^<]+)<small>path', shown)
    assert heads == ["live", "after the run", "odometry"]
    row = shown[shown.index("<tbody>") : shown.index("</tbody>")]
    assert re.findall(r"<td>([^<]*)</td>", row)[:2] == ["0.250", "0.000"]
    figure = charts.charts(replace(run, robots={"robot_1": apart}), timeline.timeline(run))
    kinds = [trace.name for trace in figure["distances"].data]
    later = [kind for k in ("after the run", "odometry") for kind in (f"robot_1, {k}", k)]
    assert kinds == ["robot_1", "live", *later]


def test_page_names_what_made_the_run():
    run = fake_run()
    assert "seed 0" in page_of(run)
    made = runs.Provenance("1.2.3", "calibrated", {"processor": "a chip", "cores": 2})
    shown = page_of(replace(run, provenance=made))
    for words in ("multi_robot_slam 1.2.3", "scenario calibrated", "seed 0", "a chip, 2 cores"):
        assert words in shown


def test_the_path_after_the_run_is_a_layer_of_its_own_that_can_be_shown():
    run = fake_run(robots=1)
    robot = run.robots["robot_1"]
    robot = replace(robot, online=moved(robot.truth, (1, 0, 0)))
    run = replace(run, robots={"robot_1": robot})
    (live,), (after,) = traces(run, "live"), traces(run, "after")
    np.testing.assert_allclose([live.x, live.y], robot.online.poses[:, :2].T)
    np.testing.assert_allclose([after.x, after.y], robot.path.poses[:, :2].T)
    shown = page_of(run)
    assert 'value="live" checked' in shown
    assert 'value="after" >' in shown


def test_page_is_the_same_for_the_same_run():
    assert page_of(fake_run()) == page_of(fake_run())


def test_names_and_warnings_are_text_not_markup():
    shown = page_of(replace(bare(), dropped={"<script>alert(1)</script>": 1}))
    assert "<script>alert" not in shown
    named = runs.here(scenario="</script><b>")
    assert "</script><b>" not in page_of(replace(bare(), provenance=named))


def test_unwritable_folder_is_named(tmp_path):
    from msg_defs.errors import InputError

    (tmp_path / "file").write_text("")
    run = bare()
    with pytest.raises(InputError, match=r"cannot write .*report\.html"):
        page.write(run, evaluation.evaluate(run), tmp_path / "file")


# ---- the command


@pytest.mark.parametrize("is_live", [True, False])
def test_report_of_a_live_and_of_an_offline_run(command, tmp_path, is_live):
    recordings.record(tmp_path / "live" / "bag", is_live=is_live)
    folder = tmp_path / "live"
    if not is_live:
        folder = tmp_path / "again"
        assert command("run", tmp_path / "live" / "bag", "--refine", "--out", folder)[0] == 0
    code, printed, _ = command("report", folder)
    assert (code, printed) == (0, f"{folder / page.FILE}\n")
    shown = (folder / page.FILE).read_text()
    assert ("refined paths" in shown) != is_live


def test_report_of_no_run_is_one_line_and_exit_code_2(command, tmp_path):
    code, printed, told = command("report", tmp_path / "nowhere")
    assert (code, printed, told.count("\n")) == (2, "", 1)
    assert "nowhere" in told


# ---- what the cameras saw


def seeing(robots=2, size_px=(32, 24), per_view=3, **changes):
    """A run whose robots have a picture at every other step, with points along its diagonal."""
    run = fake_run(robots=robots, **changes)
    width_px, height_px = size_px
    own = {}
    for number, name in enumerate(run.robots):
        kept = []
        for step in run.steps[::2]:
            pixels = np.full((height_px, width_px), 40 * number + step.step, np.uint8)
            image = Image(step.stamp_ns, "camera", "mono8", pixels)
            kept.append(_view(name, image, per_view))
        own[name] = tuple(kept)
    return replace(run, views=own)


def _view(name, image, count):
    height_px, width_px = image.pixels.shape
    projection = np.array([[10.0, 0, width_px / 2, 0], [0, 10.0, height_px / 2, 0], [0, 0, 1, 0]])
    lens = "plumb_bob", np.zeros(5), projection[:, :3], np.eye(3), projection
    info = CameraInfo(image.stamp_ns, "camera", width_px, height_px, *lens)
    offsets = np.arange(count) - 1.0
    positions = np.column_stack([offsets, -offsets, np.full(count, 10.0)]).astype("f4")
    covariances = np.tile(np.float32([1, 0, 0, 1, 0, 1]), (count, 1))
    cloud = ObservationSet(
        name, image.stamp_ns, positions, covariances, np.ones((count, 128), "f4")
    )
    parts = wire.encode_observations(cloud), wire.encode_compressed(image)
    return runs.View(image.stamp_ns, *parts, wire.encode_camera_info(info))


def test_pictures_are_shown_with_their_points_from_their_time_on():
    run = seeing(steps=6)
    times = timeline.timeline(run)
    shown = sights.sights(run, times)
    assert list(shown) == list(run.robots)
    for name, own in shown.items():
        assert unpacked(own["instants"]).tolist() == [0, 2, 4]
        np.testing.assert_allclose(unpacked(own["taken"]), [0, 0.2, 0.4], atol=1e-6)
        starts = unpacked(own["starts"])
        assert np.diff(starts).tolist() == [3, 3, 3]
        points = unpacked(own["points"]).reshape(-1, 2)[:3]
        np.testing.assert_allclose(points, [[15, 11], [16, 12], [17, 13]], atol=1e-5)
        frames = [f for s in run.steps[::2] for f in s.frames if f.robot == name]
        new = np.concatenate([f.is_new for f in frames])
        np.testing.assert_array_equal(unpacked(own["kinds"]) == sights.NEW, new)
        assert base64.b64decode(own["pictures"][0]).startswith(b"\xff\xd8\xff")


def test_rejected_observations_are_marked_as_such():
    run = seeing(robots=1, steps=1)
    (step,), rejected = run.steps, np.array([True, False, False])
    frame = replace(step.frames[0], is_new=rejected, is_rejected=rejected)
    run = replace(run, steps=[replace(step, frames=(frame,))])
    shown = sights.sights(run, timeline.timeline(run))["robot_1"]
    expected = [sights.REJECTED, sights.MATCHED, sights.MATCHED]
    assert unpacked(shown["kinds"]).tolist() == expected


def test_pictures_that_are_damaged_or_of_no_frame_are_left_out():
    run = seeing(robots=1, steps=6)
    first, second, third = run.views["robot_1"]
    broken = replace(first, picture=first.picture[:-9]), replace(second, stamp_ns=5), third
    run = replace(run, views={"robot_1": broken})
    shown = sights.sights(run, timeline.timeline(run))["robot_1"]
    assert unpacked(shown["instants"]).tolist() == [4]
    assert 'data-sight="' not in page_of(fake_run())


def test_the_pictures_of_a_team_are_bounded(monkeypatch):
    run = seeing(robots=3, steps=20)
    most = sum(len(view.jpeg()) for own in run.views.values() for view in own) // 3
    monkeypatch.setattr(sights, "MOST_BYTES", most)
    shown = sights.sights(run, timeline.timeline(run))
    pictures = [base64.b64decode(one) for own in shown.values() for one in own["pictures"]]
    assert 0 < sum(map(len, pictures)) <= most
    assert all(unpacked(own["instants"])[0] == 0 for own in shown.values())


# ---- in a browser

HARMLESS = ("willReadFrequently", "GL Driver Message")
TEAM = fake_run(robots=3, steps=20, landmarks=8)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Chromium, which records what it asks the network for."""
    with browsing.chromium(tmp_path_factory.mktemp("profile"), 1280, 800) as browser:
        yield browser


def show(browser, run, folder):
    """Write a run's report and open it; the browser, once everything is drawn."""
    from selenium.webdriver.support.ui import WebDriverWait

    path = page.write(run, evaluation.evaluate(run), folder)
    browser.get_log("browser"), browser.get_log("performance")
    browser.get(path.as_uri())
    is_ready = "return document.documentElement.dataset.ready !== undefined"
    WebDriverWait(browser, 60).until(lambda b: b.execute_script(is_ready))
    after_drawing(browser)
    return browser


@pytest.fixture(scope="module")
def opened(browser, tmp_path_factory):
    """The report of `TEAM`."""
    return show(browser, TEAM, tmp_path_factory.mktemp("team"))


def complaints(browser):
    said = [entry["message"] for entry in browser.get_log("browser")]
    return [text for text in said if not any(harmless in text for harmless in HARMLESS)]


def requested(browser):
    """Addresses the page asked for."""
    events = (json.loads(e["message"])["message"] for e in browser.get_log("performance"))
    sent = (e["params"] for e in events if e["method"] == "Network.requestWillBeSent")
    return {event["request"]["url"] for event in sent}


def centres(browser):
    """Robot -> middle of its arrow-head in the scene, as drawn."""
    return browser.execute_script("""
        const drawn = document.querySelector("[data-figure=scene]").data;
        const middle = values => values.reduce((a, b) => a + b, 0) / values.length;
        return Object.fromEntries(drawn.filter(trace => trace.meta.layer === "body")
            .map(trace => [trace.meta.robot, [middle(trace.x), middle(trace.y)]]));
    """)


def after_drawing(browser):
    from selenium.webdriver.support.ui import WebDriverWait

    WebDriverWait(browser, 30).until(lambda b: b.execute_script("return !isDrawing"))


def test_slider_moves_every_robot_by_keyboard(opened):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    slider = opened.find_element(By.ID, "time-slider")
    for key, step in ((Keys.END, 19), (Keys.HOME, 0), (Keys.ARROW_RIGHT, 1)):
        slider.send_keys(key)
        after_drawing(opened)
        drawn = centres(opened)
        assert list(drawn) == list(TEAM.robots)
        for place, estimate in zip(drawn.values(), TEAM.steps[step].estimates, strict=True):
            assert np.hypot(*(place - estimate.pose[:2])) < 0.1
    assert opened.find_element(By.ID, "time-shown").text == "0.1 s, step 1"


def test_ellipsoids_are_two_sigma_and_grow_with_the_chosen_scale(opened):
    read = """
        show(19); readControls();
        const {x, y, z} = ellipsoids(), {positions} = frames.landmarks, each = x.length / 8;
        return Array.from(x, (_, n) => {
            const [a, b, c] = positions.subarray(3 * Math.floor(n / each));
            return Math.hypot(x[n] - a, y[n] - b, z[n] - c);
        });
    """
    for scale in (1, 10):
        opened.execute_script(f"controls.elements.scale.value = '{scale}'")
        np.testing.assert_allclose(opened.execute_script(read), 0.2 * scale, rtol=1e-4)


def test_paths_can_be_cut_to_the_last_seconds(opened):
    drawn = """
        controls.elements.trail.add(new Option("half a second", "0.55"));
        controls.elements.trail.value = arguments[0];
        readControls(); state.step = arguments[1]; drawScene();
        return figures.scene.data.filter(trace => trace.meta.layer === "live")
            .map(trace => [Array.from(trace.x), Array.from(trace.y)]);
    """
    for trail, step, rows in (
        ("0.55", 12, slice(7, 13)),
        ("0.55", 2, slice(3)),
        ("Infinity", 2, slice(None)),
    ):
        for points, robot in zip(
            opened.execute_script(drawn, trail, step), TEAM.robots.values(), strict=True
        ):
            np.testing.assert_allclose(points, robot.online.poses[rows, :2].T, atol=1e-9)


def test_a_robot_and_a_layer_can_be_hidden(opened):
    opened.execute_script("""
        document.querySelector("input[value=robot_2]").click();
        document.querySelector("input[value=walls]").click();
    """)
    after_drawing(opened)
    shown = opened.execute_script("""
        return document.querySelector("[data-figure=scene]").data
            .filter(trace => trace.visible).map(trace => [trace.meta.layer, trace.meta.robot]);
    """)
    assert ["live", "robot_1"] in shown
    assert not any(robot == "robot_2" or layer == "walls" for layer, robot in shown)


def test_the_slider_changes_the_pictures_and_their_points(browser, tmp_path):
    run = seeing(robots=2, steps=6)
    shown = show(browser, run, tmp_path)
    read = """
        return [...document.querySelectorAll("[data-sight]")].map(figure => [
            figure.dataset.sight, figure.querySelector("img").naturalWidth,
            figure.querySelectorAll("svg > *").length, figure.querySelector("output").textContent,
            figure.querySelector("img").src]);
    """
    sources = set()
    for step, newest in ((0, 0), (3, 2)):
        shown.execute_script(f"show({step})")
        after_drawing(shown)
        found = shown.execute_script(read)
        assert [name for name, *_ in found] == list(run.robots)
        assert [(width, points) for _, width, points, *_ in found] == [(32, 3)] * 2
        new = [np.count_nonzero(frame.is_new) for frame in run.steps[newest].frames]
        assert [text for *_, text, _ in found] == [
            f"{newest / 10:.1f} s: {3 - count} matched, {count} new, 0 rejected" for count in new
        ]
        sources |= {source for *_, source in found}
    assert len(sources) == 4
    shown.execute_script("document.querySelector('input[value=robot_2]').click()")
    after_drawing(shown)
    hidden = "return document.querySelector('[data-sight=robot_2]').hidden"
    assert shown.execute_script(hidden)
    assert complaints(shown) == []


@pytest.mark.parametrize("width_px", [400, 1280])
def test_page_is_no_wider_than_the_window(opened, width_px):
    from selenium.webdriver.support.ui import WebDriverWait

    size = {"width": width_px, "height": 800, "deviceScaleFactor": 1, "mobile": False}
    opened.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    fits = f"document.documentElement.scrollWidth <= innerWidth && innerWidth === {width_px}"
    WebDriverWait(opened, 10).until(lambda b: b.execute_script(f"return {fits}"))
    opened.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@pytest.mark.parametrize(
    "run",
    [
        TEAM,
        bare(robots=1, landmarks=fake_landmarks(0)),
        bare(steps=[]),
        fake_run(8, steps=1),
        judged([FINE, WRONG]),
        matched([0.5, 2.0, 3.0], [1.0]),
    ],
    ids=[
        "a team",
        "one real robot without landmarks",
        "no steps",
        "many robots, one step",
        "a wrong start",
        "matches and sightings",
    ],
)
def test_every_robot_appears_without_an_error_or_a_request(browser, tmp_path, run):
    shown = show(browser, run, tmp_path)
    assert list(centres(shown)) == list(run.robots)
    assert shown.execute_script("return document.querySelectorAll('canvas').length") > 0
    assert complaints(shown) == []
    asked = requested(shown)
    assert any(url.endswith(page.FILE) for url in asked)
    assert all(url.startswith(("file:", "data:", "blob:")) for url in asked)
