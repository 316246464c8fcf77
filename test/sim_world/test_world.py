"""The building, its landmarks and who sees them."""

from dataclasses import replace

import numpy as np
import pytest

from msg_defs.types import CameraMount, StereoCamera
from sim_world import descriptors, trajectories, world
from sim_world.scenario import Scenario


@pytest.fixture(scope="module")
def built():
    return world.build(Scenario())


def is_free(points):
    """(N,) bool: even-odd rule over all walls, independent of the code under test."""
    x, y = points.T[:, :, None]
    x0, y0, x1, y1 = world.building().segments.T
    spans = (y0 > y) != (y1 > y)
    level = np.where(y0 == y1, 1.0, y1 - y0)
    return (spans & (x < x0 + (y - y0) * (x1 - x0) / level)).sum(1) % 2 == 1


def test_building_is_30_by_30_by_2_m():
    walls = world.building()
    corners = walls.segments.reshape(-1, 2)
    np.testing.assert_array_equal([corners.min(0), corners.max(0)], [[0, 0], [30, 30]])
    assert walls.height_m == 2.0


def test_walls_have_free_space_on_their_left_and_none_on_their_right():
    x0, y0, x1, y1 = world.building().segments.T
    middle = np.column_stack([x0 + x1, y0 + y1]) / 2
    left = np.column_stack([y0 - y1, x1 - x0]) / np.hypot(x1 - x0, y1 - y0)[:, None]
    assert is_free(middle + 0.01 * left).all()
    assert not is_free(middle - 0.01 * left).any()


def test_walls_close_around_one_space_with_two_holes():
    segments = world.building().segments
    next_of = {tuple(s[:2]): tuple(s[2:]) for s in segments}
    assert len(next_of) == len(segments)
    outlines = 0
    while next_of:
        start, corner = next_of.popitem()
        while corner != start:
            corner = next_of.pop(corner)
        outlines += 1
    assert outlines == 3


def test_landmarks_lie_on_their_wall(built):
    x0, y0, x1, y1 = built.walls.segments[built.wall_of].T
    x, y, z = built.landmarks.positions.astype(float).T
    length = np.hypot(x1 - x0, y1 - y0)
    off = ((x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)) / length
    along = ((x1 - x0) * (x - x0) + (y1 - y0) * (y - y0)) / length
    np.testing.assert_allclose(off, 0, atol=1e-5)
    assert ((along >= -1e-5) & (along <= length + 1e-5)).all()
    assert ((z >= 0) & (z <= 2)).all()


def test_longer_walls_bear_more_landmarks():
    built = world.build(Scenario(landmarks=20_000))
    x0, y0, x1, y1 = built.walls.segments.T
    share = np.hypot(x1 - x0, y1 - y0) / np.hypot(x1 - x0, y1 - y0).sum()
    counts = np.bincount(built.wall_of, minlength=len(share))
    assert (np.abs(counts - 20_000 * share) < 5 * np.sqrt(20_000 * share)).all()


def test_true_map_is_certain_and_unobserved(built):
    landmarks = built.landmarks
    np.testing.assert_array_equal(landmarks.ids, np.arange(900))
    assert landmarks.positions.dtype == landmarks.descriptors.dtype == np.float32
    assert not landmarks.covariances.any()
    assert not landmarks.observations.any()
    assert not landmarks.robots.any()


def test_descriptors_are_drawn_without_replacement_while_they_last():
    size = len(descriptors.load())
    for count, least, most in ((size, 1, 1), (2 * size + 5, 2, 3)):
        drawn = world.build(Scenario(landmarks=count)).landmarks.descriptors
        times = np.unique(drawn, axis=0, return_counts=True)[1]
        assert (times.min(), times.max(), len(times)) == (least, most, size)


def test_world_depends_on_the_world_seed_alone(built):
    same = world.build(Scenario(robots=1, movements=10, trajectory="ring", observations=3))
    other = world.build(Scenario(world_seed=1))
    np.testing.assert_array_equal(same.landmarks.positions, built.landmarks.positions)
    np.testing.assert_array_equal(same.landmarks.descriptors, built.landmarks.descriptors)
    assert (other.landmarks.positions != built.landmarks.positions).any()
    assert (other.landmarks.descriptors != built.landmarks.descriptors).any()


def test_no_wall_stands_between_a_camera_and_what_it_sees(built):
    camera = Scenario().camera
    share = np.linspace(0, 0.999, 800)[:, None]
    behind_walls = 0
    for pose in trajectories.poses("figure_eight", 1, 14)[0]:
        seen = built.visible(pose, camera, 10.0)
        for landmark in in_both_images(built, pose, camera, 10.0):
            target = built.landmarks.positions[landmark, :2]
            sights = [eye + share * (target - eye) for eye in eyes(pose, camera)]
            free = all(is_free(sight).all() for sight in sights)
            assert free == (landmark in seen)
            behind_walls += not free
    assert behind_walls > 100


def test_nothing_outside_the_images_is_seen(built):
    camera = StereoCamera(width_px=300, height_px=100)
    for pose in trajectories.poses("hall_first", 1, 25)[0]:
        seen = built.visible(pose, camera, 6.0)
        assert set(seen) <= set(in_both_images(built, pose, camera, 6.0))


@pytest.mark.parametrize("up_m", [1.0, 5.0])
def test_field_of_view_is_vertical_too(built, up_m):
    camera = StereoCamera(mount=CameraMount(up_m=up_m))
    poses = trajectories.poses("ring", 1, 40)[0]
    seen = [built.visible(pose, camera, 4.0) for pose in poses]
    assert any(map(len, seen)) == (up_m == 1.0)


@pytest.mark.parametrize("centre", [14.94, 15.06])
def test_both_cameras_must_see_a_landmark(built, centre):
    """A board right in front of one camera, at x = 15 -+ 0.06, hides everything."""
    pose, camera = np.array([15.0, 10.0, np.pi / 2]), Scenario().camera
    assert len(built.visible(pose, camera, 5.0))
    board = [[centre + 0.05, 10.05, centre - 0.05, 10.05]]
    walls = replace(built.walls, segments=np.vstack([built.walls.segments, board]))
    assert not len(replace(built, walls=walls).visible(pose, camera, 5.0))


@pytest.mark.parametrize("yaw", np.linspace(-3, 3, 9))
def test_walls_show_no_landmarks_from_behind(built, yaw):
    inside_west_block = np.array([9.0, 12.0, yaw])
    assert not len(built.visible(inside_west_block, Scenario().camera, 10.0))


def eyes(pose, camera):
    """Left and right camera on the ground plan."""
    x, y, yaw = pose
    forward, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    eye = [x, y] + camera.mount.forward_m * forward + camera.mount.left_m * left
    return eye, eye - camera.baseline_m * left


def in_both_images(built, pose, camera, d_max_m):
    """Rows of the landmarks in range whose directions fit into both images."""
    rows = []
    half_width, half_height = camera.width_px / 2, camera.height_px / 2
    for row, (x, y, z) in enumerate(built.landmarks.positions.astype(float)):
        inside = True
        for eye in eyes(pose, camera):
            dx, dy = [x, y] - eye
            bearing = np.arctan2(dy, dx) - pose[2]
            depth = np.hypot(dx, dy) * np.cos(bearing)
            inside &= depth > 0 and abs(np.tan(bearing)) <= half_width / camera.focal_px
            inside &= abs(z - camera.mount.up_m) * camera.focal_px <= half_height * depth
        left = np.append(eyes(pose, camera)[0], camera.mount.up_m)
        if inside and np.linalg.norm([x, y, z] - left) <= d_max_m:
            rows.append(row)
    return rows
