"""Pictures in a bag: looked at beforehand or while the filter runs, with the same result."""

from dataclasses import replace

import cv2
import numpy as np
import pictures
import pytest

from msg_defs import topics, wire
from msg_defs.errors import InputError
from multi_robot_slam.bags import BagReader
from multi_robot_slam.front_end.front_end import FrontEnd
from multi_robot_slam.front_end.settings import DESCRIPTOR_GATE
from multi_robot_slam.pipeline import cameras, landmarks, offline, sights

LEFT = topics.image("robot_1", "left")


def run(bag, config, told=None):
    return offline.estimate(bag, config, (told if told is not None else []).append)


def made(tmp_path, config, **options):
    """The bag that `landmarks` makes of `tmp_path/bag`."""
    told = []
    result = landmarks.write(tmp_path / "bag", tmp_path / "out", config, told.append, **options)
    return BagReader(tmp_path / "out"), result, told


def of_topic(reader, topic):
    return [record.data for record in reader.records({f"/{topic.name}"})]


def same(one, other):
    """Two runs have the same estimates, bit for bit."""
    assert len(one.steps) == len(other.steps) > 1
    for a, b in zip(one.steps, other.steps, strict=True):
        a, b = (wire.encode_step(replace(step, duration_ms=0.0)) for step in (a, b))
        assert a == b
    assert wire.encode_map(one.landmarks, 0) == wire.encode_map(other.landmarks, 0)
    for a, b in zip(one.robots.values(), other.robots.values(), strict=True):
        assert a.online.poses.tobytes() == b.online.poses.tobytes()
        assert a.path.poses.tobytes() == b.path.poses.tobytes()
    return True


@pytest.mark.parametrize("namespace", ["", "/fleet"])
def test_run_on_pictures_is_landmarks_and_then_run(tmp_path, namespace):
    config = pictures.record(tmp_path / "bag", pictures.team(2), namespace=namespace)
    made(tmp_path, config)
    at_once, later = (run(tmp_path / name, config) for name in ("bag", "out"))
    assert same(at_once, later)
    assert at_once.frames == later.frames
    matched = sum(np.count_nonzero(~f.is_new) for s in at_once.steps for f in s.frames)
    assert matched > 100
    assert at_once.dropped == later.dropped == {}


def test_the_estimate_is_right(tmp_path):
    config = pictures.record(tmp_path / "bag")
    path = run(tmp_path / "bag", config).robots["robot_1"].path.poses
    assert np.abs(path[-1] - [0, -0.9, 0]).max() < 0.03


def test_the_bag_has_everything_but_the_pictures_and_runs_without_a_scenario(tmp_path, command):
    pictures.record(tmp_path / "bag")
    assert command("landmarks", tmp_path / "bag", "--out", tmp_path / "out")[0] == 0
    reader = BagReader(tmp_path / "out")
    names = {topic.name for topic in reader.summary.topics}
    assert {"/robot_1/odom", "/robot_1/stereo/landmarks", "/robot_1/left/camera_info"} <= names
    assert not any(name.endswith("image_rect") for name in names)
    assert reader.summary.counts["/fusion/config"] == 1
    code, shown, told = command("run", tmp_path / "out", "--out", tmp_path / "run")
    assert code == 0, told
    assert "robot_1" in shown


def test_pictures_are_copied_if_that_is_wanted(tmp_path):
    config = pictures.record(tmp_path / "bag")
    reader, _, _ = made(tmp_path, config, keep_images=True)
    before = BagReader(tmp_path / "bag")
    assert of_topic(reader, LEFT) == of_topic(before, LEFT) != []
    assert same(run(tmp_path / "out", config), run(tmp_path / "bag", config))


def test_compressed_pictures_are_found_without_being_told(tmp_path):
    config = pictures.team()
    pictures.record(tmp_path / "bag", config, pictures.drive(compressed=True))
    pictures.record(tmp_path / "raw", config)
    assert same(run(tmp_path / "bag", config), run(tmp_path / "raw", config))


def test_the_preview_shows_the_observations_where_they_are(tmp_path):
    config = pictures.record(tmp_path / "bag")
    reader, result, _ = made(tmp_path, config)
    clouds = of_topic(reader, topics.observations("robot_1"))
    previews = of_topic(reader, topics.preview("robot_1"))
    infos = of_topic(reader, topics.preview_info("robot_1"))
    assert len(clouds) == len(previews) == len(infos) == result.robots["robot_1"].pairs
    cloud = wire.decode_observations(clouds[0], "robot_1")
    picture = wire.decode_compressed(previews[0], "preview")
    info = wire.decode_camera_info(infos[0], "preview")
    assert picture.stamp_ns == info.stamp_ns == cloud.stamp_ns == pictures.START_NS
    assert picture.pixels.shape == (info.height_px, info.width_px) == (160, 240)
    camera = pictures.info("left")
    np.testing.assert_allclose(info.projection, camera.projection, atol=1e-9)
    small = replace(config, camera=replace(config.camera, preview_px=60))
    reader, _, _ = made_again(tmp_path, small)
    info = wire.decode_camera_info(of_topic(reader, topics.preview_info("robot_1"))[0], "preview")
    # The middle of the first pixel of four is 1.5 pixels from the first one's.
    u = np.arange(240)
    z_ratio = (u - camera.projection[0, 2]) / camera.projection[0, 0]
    shown = info.projection[0, 0] * z_ratio + info.projection[0, 2]
    np.testing.assert_allclose(shown, (u + 0.5) / 4 - 0.5, atol=1e-9)
    none = replace(config, camera=replace(config.camera, preview_px=0))
    reader, _, _ = made_again(tmp_path, none)
    assert of_topic(reader, topics.preview("robot_1")) == []


def made_again(tmp_path, config):
    import shutil

    shutil.rmtree(tmp_path / "out")
    return made(tmp_path, config)


# ---- what is wrong with a bag costs that alone, and is told


def without(messages, *topic_names):
    return [message for message in messages if message[1].name not in topic_names]


def refusals(tmp_path, messages, config=None):
    """What `landmarks` says of a bag, and what it made."""
    config = config or pictures.team()
    pictures.record(tmp_path / "bag", config, messages)
    _, result, told = made(tmp_path, config)
    return result, told


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda d: d[: len(d) // 2], "left image of robot_1"),
        (lambda d: d[:6], "left image of robot_1"),
        (lambda d: d.replace(b"mono8", b"mono9"), "encoding 'mono9'"),
    ],
)
def test_a_damaged_picture_costs_its_pair(tmp_path, change, told):
    messages = list(pictures.drive())
    first = next(n for n, (stamp, topic, _) in enumerate(messages) if topic == LEFT)
    stamp, topic, data = messages[first]
    messages[first] = stamp, topic, change(data)
    result, said = refusals(tmp_path, messages)
    assert sum(result.dropped.values()) >= 1
    assert any(told in line for line in said)
    assert result.robots["robot_1"].pairs >= 3


def test_no_calibration_is_told(tmp_path):
    messages = without(pictures.drive(), "robot_1/right/camera_info")
    result, (told,) = refusals(tmp_path, messages)
    assert result.robots["robot_1"].pairs == 0
    assert "no robot_1/right/camera_info" in told


def test_a_calibration_that_comes_later_than_the_first_pair_costs_nothing(tmp_path):
    def late(messages):
        return sorted(messages, key=lambda m: m[0] + 3 * 10**8 * m[1].name.endswith("info"))

    result, told = refusals(tmp_path, late(pictures.drive()))
    assert result.robots["robot_1"].pairs >= 4
    assert told == []


@pytest.mark.parametrize(
    ("calibration", "told"),
    [
        ({"baseline_m": 0.0}, "baseline"),
        ({"baseline_m": -0.1}, "swap"),
        ({"focal_px": 0.0}, "calibrat"),
    ],
)
def test_a_calibration_that_means_nothing_is_told_once_and_counted(tmp_path, calibration, told):
    messages = [
        (stamp, topic, wire.encode_camera_info(pictures.info("right", stamp, **calibration)))
        if topic == topics.camera_info("robot_1", "right")
        else (stamp, topic, data)
        for stamp, topic, data in pictures.drive()
    ]
    result, (line,) = refusals(tmp_path, messages)
    assert told in line
    assert result.dropped == {"calibration of robot_1": 4}
    given = replace(pictures.SETTINGS, baseline_m=pictures.BASELINE_M)
    if calibration == {"baseline_m": 0.0}:
        pictures.record(tmp_path / "given", messages=messages)
        config = pictures.team(camera=given)
        pairs = landmarks.write(tmp_path / "given", tmp_path / "there", config, print)
        assert pairs.robots["robot_1"].pairs == 4


def test_stamps_that_never_agree_are_told_with_the_difference_and_the_remedy(tmp_path):
    messages = [
        (
            stamp,
            topic,
            shifted(data, 2_000_000) if topic.name.endswith("right/image_rect") else data,
        )
        for stamp, topic, data in pictures.drive()
    ]
    result, (line,) = refusals(tmp_path, messages)
    assert result.robots["robot_1"].pairs == 0
    assert "2.000 ms off" in line
    assert "camera.approx_sync: true" in line
    nearly = pictures.team(camera=replace(pictures.SETTINGS, approx_sync=True))
    _, result, told = made_again(tmp_path, nearly)
    assert result.robots["robot_1"].pairs == 4
    assert told == []


def shifted(data, by_ns):
    shown = wire.decode_image(data, "image")
    return wire.encode_image(replace(shown, stamp_ns=shown.stamp_ns + by_ns))


def test_a_calibration_that_changes_is_taken_over():
    config = pictures.team()
    camera = cameras.Camera(config, "robot_1", print)

    def depths(start, baseline_m):
        found = []
        for stamp, topic, data in pictures.drive(steps=1):
            if "camera_info" in topic.name:
                side = topic.name.split("/")[1]
                info = pictures.info(side, stamp, baseline_m=baseline_m)
                data = wire.encode_camera_info(info)
            if topic in camera.inputs:
                found += camera.take(topic, restamped(topic, data, start))
        (look,) = found
        seen = sights.see(look, config).seen
        return np.median(seen.positions[:, 2])

    near, far = depths(1, 0.12), depths(2, 0.24)
    assert near == pytest.approx(2.0, abs=0.02)
    assert far == pytest.approx(4.0, abs=0.04)
    assert camera.calibration.changes == 1


def restamped(topic, data, seconds):
    if topic.type.endswith("CameraInfo"):
        info = wire.decode_camera_info(data, "info")
        return wire.encode_camera_info(replace(info, stamp_ns=seconds * 10**9))
    shown = wire.decode_image(data, "image")
    return wire.encode_image(replace(shown, stamp_ns=seconds * 10**9))


def test_black_pictures_show_nothing_and_the_run_goes_on(tmp_path):
    messages = []
    for stamp, topic, data in pictures.drive():
        if topic.name.endswith("image_rect") and stamp < pictures.START_NS + 5 * 10**8:
            data = wire.encode_image(pictures.image(np.zeros((160, 240), np.uint8), stamp))
        messages.append((stamp, topic, data))
    config = pictures.record(tmp_path / "bag", messages=messages)
    told = []
    done = run(tmp_path / "bag", config, told)
    assert told == []
    assert [len(f.landmarks) for s in done.steps for f in s.frames][:1] == [0]
    assert sum(len(f.landmarks) for s in done.steps for f in s.frames) > 50


def test_bad_pairs_are_counted_as_other_messages_are(tmp_path):
    messages = list(pictures.drive())
    for n, (stamp, topic, data) in enumerate(messages):
        if topic == LEFT and stamp == pictures.START_NS:
            messages[n] = stamp, topic, data[:-1000]
    config = pictures.record(tmp_path / "bag", messages=messages)
    told = []
    assert run(tmp_path / "bag", config, told).dropped == {"bad left image of robot_1": 1}
    assert len(told) == 1


def test_a_bag_without_pictures_is_refused(tmp_path, command):
    import recordings

    recordings.record(tmp_path / "bag", steps=2)
    code, _, told = command("landmarks", tmp_path / "bag", "--out", tmp_path / "out")
    assert (code, told.count("\n")) == (2, 1)
    assert "has no pictures" in told
    with pytest.raises(InputError, match="has no pictures"):
        landmarks.write(tmp_path / "bag", tmp_path / "out", pictures.team(), print)


def test_pictures_without_a_configuration_are_told_what_is_missing(tmp_path, command):
    pictures.record(tmp_path / "bag", with_config=False)
    code, _, told = command("run", tmp_path / "bag", "--out", tmp_path / "out")
    assert (code, told.count("\n")) == (2, 1)
    assert "robots: [robot_1], start_poses: [[x, y, yaw]]" in told
    scenario = tmp_path / "mine.yaml"
    scenario.write_text("multi_robot_slam: {robots: [robot_1], start_poses: [[0, 0, 0]]}")
    words = ("--scenario", scenario, "--particles", 20, "--out", tmp_path / "out")
    code, _, told = command("run", tmp_path / "bag", *words)
    assert code == 0, told
    assert f"descriptor_gate: {DESCRIPTOR_GATE}" in (tmp_path / "out" / "config.yaml").read_text()


def test_a_pair_that_opencv_cannot_look_at_is_one_that_is_refused(monkeypatch):
    def fails(self, left, right):
        raise cv2.error("on\npurpose")

    config = pictures.team()
    camera = cameras.Camera(config, "robot_1", print)
    found = []
    for _, topic, data in pictures.drive(steps=1):
        if topic in camera.inputs:
            found += camera.take(topic, data)
    monkeypatch.setattr(FrontEnd, "observe", fails)
    with pytest.raises(InputError, match=r"robot_1.*on purpose.*camera_info"):
        sights.see(found[0], config)
