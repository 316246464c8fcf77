"""Tags in recorded pictures: landmarks by number, robots as sightings, up to the filter."""

from dataclasses import replace

import cv2
import numpy as np
import pictures
import pytest

from msg_defs import topics, wire
from msg_defs.types import Image
from multi_robot_slam.bags import BagReader
from multi_robot_slam.front_end.settings import TagSettings
from multi_robot_slam.front_end.tag_families import descriptors
from multi_robot_slam.pipeline import landmarks, offline

CELL_PX = 5
SIZE_M = 8 * CELL_PX / pictures.PX_PER_M
"""Of a tag as far away as the wall."""
ON_WALL, ON_OTHER, ON_SELF = 7, 5, 6
PLACES = {ON_WALL: (10, 10), ON_OTHER: (150, 20), ON_SELF: (90, 100)}
"""Column and row of each tag's margin in the first left picture."""
CAMERA_LEFT_M = 0.06
STEP_PX = 10


def centre(number):
    """(3,) of a tag in the camera frame [m]."""
    column, row = np.add(PLACES[number], 5 * CELL_PX - 0.5)
    across, up = column - pictures.WIDTH_PX / 2, pictures.HEIGHT_PX / 2 - row
    return np.array([across, up, pictures.FOCAL_PX]) / pictures.PX_PER_M


def with_tags(pixels, side, step):
    """The picture with tags pasted in; the one on the wall drifts to the left."""
    pixels = pixels.copy()
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for number, (column, row) in PLACES.items():
        column -= round(pictures.DISPARITY_PX) * (side == "right")
        column -= step * STEP_PX if number == ON_WALL else 0
        printed = cv2.aruco.generateImageMarker(dictionary, number, 8 * CELL_PX)
        margin = np.pad(printed, CELL_PX, constant_values=255)
        low = max(column, 0)
        if column + len(margin) > 0:
            pixels[row : row + len(margin), low : column + len(margin)] = margin[:, low - column :]
    return pixels


def messages(steps=6):
    """Robot 1 drives along the wall; robot 2 keeps beside it and carries a tag, as robot 1 does."""
    sent = [*pictures.drive(steps=steps)]
    for stamp_ns, topic, data in sent:
        step = (stamp_ns - pictures.START_NS) // 10**8
        if topic.type.endswith("/Image"):
            side = topic.name.split("/")[1]
            image = wire.decode_image(data, "it")
            pixels = with_tags(image.pixels, side, step)
            data = wire.encode_image(Image(stamp_ns, image.frame, "mono8", pixels))
        yield stamp_ns, topic, data
        if topic == topics.odometry("robot_1"):
            moved = pictures.odometry("robot_2", stamp_ns, step * 0.1)
            yield stamp_ns, topics.odometry("robot_2"), moved


@pytest.fixture
def config(tmp_path):
    on_robots = ((ON_OTHER, 1, 0.0, 0.0, 0.0), (ON_SELF, 0, 0.2, 0.0, 0.0))
    tags = TagSettings(family="36h11", size_m=SIZE_M, on_robots=on_robots)
    x, _, z = centre(ON_OTHER)
    team = pictures.team(2, sightings=True, camera=replace(pictures.SETTINGS, tags=tags))
    starts = (0.0, 0.0, 0.0), (float(z), float(CAMERA_LEFT_M - x), 0.0)
    return pictures.record(tmp_path / "bag", replace(team, start_poses=starts), messages())


def estimate(bag, config):
    return offline.estimate(bag, config, [].append)


def test_landmarks_writes_tags_and_sightings_of_others(tmp_path, config):
    landmarks.write(tmp_path / "bag", tmp_path / "out", config, [].append)
    reader = BagReader(tmp_path / "out")
    sightings = [
        wire.decode_sightings(record.data, "robot_1")
        for record in reader.records({"/robot_1/sightings"})
    ]
    clouds = [
        wire.decode_observations(record.data, "robot_1")
        for record in reader.records({"/robot_1/stereo/landmarks"})
    ]
    assert [s.stamp_ns for s in sightings] == [c.stamp_ns for c in clouds]
    assert len(sightings) > 1
    for seen in sightings:
        assert seen.others.tolist() == [1]
        np.testing.assert_allclose(seen.positions, [centre(ON_OTHER)], atol=0.05)
    is_tag = (clouds[0].descriptors == descriptors(np.array([ON_WALL]))).all(axis=1)
    np.testing.assert_allclose(clouds[0].positions[is_tag], [centre(ON_WALL)], atol=0.05)


def test_robots_in_view_reach_the_filter_at_once_as_by_way_of_landmarks(tmp_path, config):
    landmarks.write(tmp_path / "bag", tmp_path / "out", config, [].append)
    at_once, later = (estimate(tmp_path / name, config) for name in ("bag", "out"))
    assert len(at_once.steps) == len(later.steps) > 1
    for one, other in zip(at_once.steps, later.steps, strict=True):
        one, other = (wire.encode_step(replace(s, duration_ms=0.0)) for s in (one, other))
        assert one == other
    frames = [f for step in at_once.steps for f in step.frames if f.robot == "robot_1"]
    assert all(f.others.tolist() == [1] for f in frames)
    assert not any(f.is_other_rejected.any() for f in frames)


def test_a_damaged_picture_costs_its_pair_where_robots_carry_tags(tmp_path, config):
    spoilt = [
        (s, t, d[:-9] if t.type.endswith("/Image") and s == pictures.START_NS else d)
        for s, t, d in messages()
    ]
    pictures.record(tmp_path / "spoilt", config, spoilt)
    run = estimate(tmp_path / "spoilt", config)
    assert run.dropped
    assert len(run.steps) > 0


def test_sightings_of_other_makers_stay_where_no_robot_carries_a_tag(tmp_path, config):
    landmarks.write(tmp_path / "bag", tmp_path / "out", config, [].append, keep_images=True)
    plain = replace(config, camera=pictures.SETTINGS)
    landmarks.write(tmp_path / "out", tmp_path / "again", plain, [].append)
    first, second = (
        [r.data for r in BagReader(tmp_path / name).records({"/robot_1/sightings"})]
        for name in ("out", "again")
    )
    assert first == second != []
