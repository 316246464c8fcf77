"""`multi_robot_slam convert mrclam`: a made-up recording in full, and the real one."""

import json
import re
import shutil
from dataclasses import replace

import mrclam_recording
import numpy as np
import pytest
from mrclam_recording import LANDMARKS, START, lines, true_pose
from scipy.stats import chi2

from multi_robot_slam import runs
from multi_robot_slam.datasets import mrclam
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.pipeline import offline


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    mrclam_recording.write(folder)
    return folder


@pytest.fixture
def recording(original, tmp_path):
    return shutil.copytree(original, tmp_path / "recording")


@pytest.fixture(scope="module")
def bag(original, tmp_path_factory):
    from multi_robot_slam.datasets import bag

    folder = tmp_path_factory.mktemp("bags") / "bag"
    bag.write(mrclam.read(original), folder, 2.0)
    return folder


def refused(result):
    code, _, err = result
    assert (code, err.count("\n")) == (2, 1), err
    return err


def test_run_finds_everything_in_the_bag_and_drops_nothing(command, recording, tmp_path):
    bag, out = tmp_path / "bag", tmp_path / "out"
    code, printed, _ = command("convert", "mrclam", recording, "--out", bag, "--rate", "2")
    assert code == 0
    assert str(bag) in printed
    assert command("run", bag, "--out", out, "--particles", "50")[0] == 0
    result = json.loads((out / "result.json").read_text())
    assert (result["dropped"], result["duplicates"]) == ({}, 0)
    assert result["landmarks"] == result["landmarks_seen"] > 2
    assert result["odometry_path_rmse_m"] < 1e-3
    assert result["path_rmse_m"] < 0.2
    assert result["association_recall"] == 1


def test_every_frame_of_all_robots_comes_with_sightings_before_observations(bag):
    config = offline.recorded_config(bag)
    assert config.sightings
    kinds, order = {}, []
    for event in offline.events(bag, config):
        if not hasattr(event, "pose"):
            kinds.setdefault(event.stamp_ns, []).append((event.robot, type(event).__name__))
            order.append(event.stamp_ns)
    assert order == sorted(order)
    stamps = np.array(sorted(kinds))
    assert set(np.diff(stamps)) == {500_000_000}
    expected = [
        (r, k) for r in ("robot_1", "robot_2") for k in ("Sightings", "EncodedObservations")
    ]
    assert all(sorted(frame) == sorted(expected) for frame in kinds.values())
    for frame in kinds.values():
        assert next(kind for robot, kind in frame if robot == "robot_1") == "Sightings"


def test_sightings_are_where_the_other_robot_is(bag):
    seen = [
        event
        for event in offline.events(bag, offline.recorded_config(bag))
        if hasattr(event, "others") and len(event.others)
    ]
    assert seen
    for event in seen:
        seconds = event.stamp_ns / 1e9 - START
        observer, other = int(event.robot[-1]), int(event.others[0]) + 1
        assert other != observer
        pose = true_pose(observer, seconds)
        forward, left = event.positions[0, 2], -event.positions[0, 0]
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        seen_at = np.array([cos * forward - sin * left, sin * forward + cos * left])
        np.testing.assert_allclose(pose[:2] + seen_at, true_pose(other, seconds)[:2], atol=0.02)


def test_truth_start_and_map_are_those_of_the_files(bag):
    config = offline.recorded_config(bag)
    recorded = runs.recorded(bag, config.robots)
    np.testing.assert_allclose(recorded.true_landmarks.positions[:, :2], LANDMARKS, atol=1e-6)
    assert recorded.true_landmarks.ids.tolist() == [3, 4, 5, 6]
    for number, name in enumerate(config.robots, start=1):
        truth = recorded.truth[name]
        np.testing.assert_allclose(truth.poses[0], config.start_poses[number - 1], atol=1e-9)
        seconds = truth.stamps_ns[-1] / 1e9 - START
        np.testing.assert_allclose(truth.poses[-1], true_pose(number, seconds), atol=1e-4)


ENDS = {(1, "Groundtruth"): 18.05, (2, "Odometry"): 20.0}
"""Robot 1's truth ends first, then robot 2's odometry; robot 1 drives on to 30 s."""


@pytest.fixture
def uneven(tmp_path):
    folder = tmp_path / "uneven"
    folder.mkdir()
    mrclam_recording.write(folder, ENDS)
    return folder


def test_every_robot_is_kept_as_long_as_its_odometry_and_truth_where_there_is_one(uneven, tmp_path):
    from multi_robot_slam.datasets import bag

    counts = bag.write(mrclam.read(uneven), tmp_path / "bag", 2.0)
    config = offline.recorded_config(tmp_path / "bag")
    frames = {"robot_1": [], "robot_2": []}
    for event in offline.events(tmp_path / "bag", config):
        if type(event).__name__ == "EncodedObservations":
            frames[event.robot].append(event.stamp_ns / 1e9 - START)
    assert [own[0] for own in frames.values()] == pytest.approx([0, 0])
    assert [own[-1] for own in frames.values()] == pytest.approx([29.5, 20])
    recorded = runs.recorded(tmp_path / "bag", config.robots)
    seconds = {name: path.stamps_ns / 1e9 - START for name, path in recorded.truth.items()}
    assert [own[-1] for own in seconds.values()] == pytest.approx([18.0, 20.0])
    assert len(recorded.observation_truth) == sum(map(len, frames.values()))
    assert [counts[name].frames for name in frames] == [60, 41]
    assert [counts[name].without_truth for name in frames] == [23, 0]
    assert counts["robot_2"].spare > 0


def test_what_has_no_truth_is_told_and_the_rest_is_judged(command, uneven, tmp_path):
    bag, out = tmp_path / "bag", tmp_path / "out"
    code, printed, _ = command("convert", "mrclam", uneven, "--out", bag, "--rate", "2")
    assert code == 0
    assert "no truth" in printed
    assert re.search(r"robot_1 .* 60 +23 *\n", printed)
    assert "Frames without truth are estimated" in " ".join(printed.split())
    assert command("run", bag, "--out", out, "--particles", "50")[0] == 0
    assert command("evaluate", out)[0] == 0
    result = json.loads((out / "result.json").read_text())
    assert result["dropped"] == {}
    assert result["odometry_path_rmse_m"] < 1e-3
    assert result["path_rmse_m"] < 0.2
    assert result["batch_path_rmse_m"] < 0.2
    truth, path = (
        [line.split()[0] for line in (out / f"{kind}_robot_1.tum").read_text().splitlines()]
        for kind in ("truth", "trajectory")
    )
    assert truth == path[: len(truth)]
    assert (len(truth), len(path)) == (37, 60)
    assert result["robots"]["robot_1"]["truth_coverage"] == pytest.approx(37 / 60)


def test_a_robot_whose_truth_ends_soon_is_estimated_and_judged_where_it_can_be(command, tmp_path):
    source, bag, out = (tmp_path / name for name in ("source", "bag", "out"))
    source.mkdir()
    mrclam_recording.write(source, {(1, "Groundtruth"): 5.05})
    assert command("convert", "mrclam", source, "--out", bag, "--rate", "2")[0] == 0
    assert command("run", bag, "--out", out, "--particles", "20")[0] == 0
    result = json.loads((out / "result.json").read_text())
    coverage = [own["truth_coverage"] for own in result["robots"].values()]
    assert coverage == pytest.approx([11 / 60, 1.0])
    assert result["path_rmse_m"] < 0.2


def test_the_filter_is_told_nothing_that_was_found_by_looking_at_the_truth(bag):
    """Noise and cost aside, settings are the defaults; the gate lets all right matches pass."""
    config = offline.recorded_config(bag)
    own, default = config.filter, FilterSettings()
    free = {"gate": own.gate, "motion": own.motion, "rejuvenation": own.rejuvenation}
    assert own == replace(default, **free)
    assert own.rejuvenation.ancestors_below == default.rejuvenation.ancestors_below
    count = sum(map(len, runs.recorded(bag, config.robots).observation_truth.values()))
    assert count > 50
    assert chi2.cdf(own.gate, 3) ** count == pytest.approx(chi2.cdf(default.gate, 3), abs=1e-3)


def test_unknown_barcodes_are_counted_and_left_out(original):
    recording = mrclam.read(original)
    assert [log.unknown for log in recording.robots.values()] == [4, 4]
    assert {len(log.landmarks) > 0 for log in recording.robots.values()} == {True}


def test_a_bad_line_is_named_with_its_file_and_number(command, recording, tmp_path):
    path = recording / "Robot2_Measurement.dat"
    text = path.read_text().splitlines()
    text[6] = "1248446182.1 41 oops 0.1"
    path.write_text("\n".join(text))
    err = refused(command("convert", "mrclam", recording, "--out", tmp_path / "bag"))
    assert "Robot2_Measurement.dat, line 7: '1248446182.1 41 oops 0.1'" in err


@pytest.mark.parametrize(
    "name", ["Barcodes.dat", "Landmark_Groundtruth.dat", "Robot1_Groundtruth.dat"]
)
def test_a_missing_file_is_named(command, recording, tmp_path, name):
    (recording / name).unlink()
    assert name in refused(command("convert", "mrclam", recording, "--out", tmp_path / "bag"))


def test_a_folder_without_robots_is_refused(command, recording, tmp_path):
    for path in recording.glob("Robot*"):
        path.unlink()
    assert "Robot<n>_Odometry.dat" in refused(
        command("convert", "mrclam", recording, "--out", tmp_path / "bag")
    )


def test_logs_without_common_time_are_refused(command, recording, tmp_path):
    path = recording / "Robot1_Groundtruth.dat"
    path.write_text(lines([(START + 50 + t, 0, 0, 0) for t in range(3)]))
    assert "common" in refused(command("convert", "mrclam", recording, "--out", tmp_path / "bag"))


def test_a_bag_that_exists_is_not_touched(command, recording, tmp_path):
    (tmp_path / "bag").mkdir()
    assert "exists" in refused(command("convert", "mrclam", recording, "--out", tmp_path / "bag"))


def test_the_real_recording_is_read_whole(shared_data):
    """Counts and sensor facts as stated with the data."""
    recording = mrclam.read(shared_data / "mrclam" / "Dataset7")
    logs = list(recording.robots.values())
    assert len(logs) == 5
    assert len(recording.landmarks) == 15
    assert 0 <= min(log.unknown for log in logs) <= max(log.unknown for log in logs) <= 9
    errors = np.concatenate([_range_errors(log, recording.landmarks) for log in logs])
    assert np.median(np.abs(errors)) * 1.4826 == pytest.approx(0.13, abs=0.02)


def _range_errors(log, landmarks):
    times = log.landmarks.stamps_ns - log.truth.stamps_ns[0]
    known = log.truth.stamps_ns - log.truth.stamps_ns[0]
    x, y = (np.interp(times, known, log.truth.poses[:, axis]) for axis in (0, 1))
    places = landmarks[log.landmarks.targets]
    return log.landmarks.ranges - np.hypot(places[:, 0] - x, places[:, 1] - y)
