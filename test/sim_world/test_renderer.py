"""What rendered pictures show, and where in them."""

import cv2
import numpy as np
import pytest
import slow_renderer
from rendered import (
    PERFECT,
    PILLAR,
    ROOM,
    SMALL,
    at,
    changed,
    checkered,
    grey,
    noisy,
    renderer,
    walls,
)

from msg_defs.errors import InputError
from msg_defs.types import CameraMount, StereoCamera
from sim_world import stereo, world
from sim_world.rendering import kernels
from sim_world.rendering.kernels import Surfaces, View
from sim_world.scenario import Scenario
from sim_world.simulator import Simulation

CAMERA = StereoCamera()
INHABITED = walls(PILLAR, ROOM)


def surfaces(room, painted):
    return Surfaces(
        room.segments,
        np.full(len(room.segments), room.height_m),
        painted.firsts,
        painted.counts,
        painted.texels,
        np.empty((0, painted.texels.shape[1]), np.uint8),
    )


def people_before(eye):
    """Two of different heights, with holes, one before the other."""
    rng = np.random.default_rng(7)
    return Surfaces(
        segments=np.array([[4.6, 3.0, 4.4, 3.6], [3.3, 2.5, 3.2, 3.1]]),
        heights=np.array([1.7, 1.2]),
        firsts=np.array([0, 9]),
        counts=np.array([9, 7]),
        texels=rng.integers(0, 100, (16, 11), dtype=np.uint8),
        opacities=rng.integers(100, 256, (16, 11), dtype=np.uint8),
    )


NOBODY = Surfaces(
    np.empty((0, 4)),
    np.empty(0),
    np.empty(0, np.int64),
    np.empty(0, np.int64),
    np.empty((0, 11), np.uint8),
    np.empty((0, 11), np.uint8),
)
BACKDROP = np.linspace(200, 50, SMALL.height_px).astype(np.float32)


def view_from(x, y, yaw):
    eye, ahead = np.array([x, y, 0.9]), np.array([np.cos(yaw), np.sin(yaw)])
    return View(eye, ahead, SMALL.focal_px, np.array(SMALL.centre_px))


def light(view, room, people):
    result = np.zeros((SMALL.width_px, SMALL.height_px), np.float32)
    kernels.expose(result, 1.0, view, room, people, BACKDROP)
    return result.T


SIZE = SMALL.width_px, SMALL.height_px
VIEWS = [(1, 3, 0.1), (2, 1, 0.9), (7, 5, -2.5), (4.2, 3.75, 0.0), (0.3, 0.2, 0.02), (4, 5.7, -0.4)]


@pytest.mark.parametrize("pose", VIEWS)
@pytest.mark.parametrize("texel_m", [0.02, 0.3])
def test_the_compiled_ray_caster_is_the_slow_one(pose, texel_m):
    room = surfaces(INHABITED, noisy(INHABITED, texel_m))
    view, people = view_from(*pose), people_before(pose)
    slow = slow_renderer.picture(SIZE, view, room, people, BACKDROP)
    np.testing.assert_allclose(light(view, room, people), slow, atol=2e-3)


@pytest.mark.parametrize("pose", VIEWS[:3])
def test_a_pixel_is_the_mean_of_the_rays_through_it(pose):
    """Texels are about as large as pixels; a ray hits or misses one, so their mean is coarse."""
    room = surfaces(INHABITED, noisy(INHABITED, 0.1, least=60, most=180))
    view = view_from(*pose)
    rays = slow_renderer.sampled(SIZE, view, room, BACKDROP, rays=8)
    error = light(view, room, NOBODY) - rays
    assert np.sqrt(np.mean(error**2)) < 3
    assert abs(error.mean()) < 0.3


def corners_on(room, wall, squares_per_m=4):
    """(N, 3) where four squares of a wall meet, but for those at its border."""
    start, end = room.segments[wall, :2], room.segments[wall, 2:]
    length = np.hypot(*(end - start))
    along = np.arange(1, np.ceil(length * squares_per_m)) / squares_per_m
    up = room.height_m - np.arange(1, room.height_m * squares_per_m) / squares_per_m
    ground = end + (start - end) * (along / length)[:, None]
    return np.array([[x, y, z] for x, y in ground for z in up])


def found(picture, predicted):
    """Corners in a picture near where they are predicted, to a fraction of a pixel."""
    guesses = np.ascontiguousarray(predicted[:, None] + 0.6, np.float32)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
    return cv2.cornerSubPix(picture, guesses, (4, 4), (-1, -1), stop)[:, 0]


ROOM_POSES = [(4, 3, 0.0), (3, 3, 0.3), (4, 2, -0.4), (4, 3, 3.0), (2, 3, 1.2)]


@pytest.mark.parametrize("pose", ROOM_POSES)
def test_points_of_walls_are_seen_where_the_camera_model_has_them(pose):
    """Blurred, so that the detector of corners is itself exact to a twentieth of a pixel."""
    room = walls(ROOM)
    pair = renderer(room, checkered(room), changed(blur_px=1.5)).pair(at(*pose))
    corners = np.vstack([corners_on(room, wall) for wall in range(4)])
    points = stereo.camera_from_map(corners, np.array(pose), CAMERA.mount)
    points = points[(points[:, 2] > 0.5) & (points[:, 2] < 6)]
    row, column, disparity = stereo.project(points, CAMERA).T
    inside = (row > 8) & (row < 471) & (column - disparity > 8) & (column < 631)
    row, column, disparity = row[inside], column[inside], disparity[inside]
    left = found(pair.left, np.column_stack([column, row]))
    right = found(pair.right, np.column_stack([column - disparity, row]))
    assert len(left) > 100
    for eye, expected in ((left, column), (right, column - disparity)):
        error = eye - np.column_stack([expected, row])
        assert np.abs(np.median(error, axis=0)).max() < 0.02
        assert np.abs(error).max() < 0.08
    depths = points[inside, 2]
    np.testing.assert_allclose(left[:, 0] - right[:, 0], 500 * 0.12 / depths, atol=0.12)


@pytest.mark.parametrize("pose", [(4, 3, 0.0), (3, 3, 0.3), (4, 2, -0.2), (4, 3, 3.0)])
def test_an_edge_is_seen_to_a_hundredth_of_a_pixel(pose):
    """Of a wall that is dark up to a place, as many columns of pixels are dark, and a share."""
    end = 2.7
    room = walls(((0, 0), (8, 0), (8, end), (8, 6), (0, 6), (0, 6 - end)))
    painted = grey(room, 240)
    painted.of(1)[:] = painted.of(0)[:] = 40
    painted.of(4)[:] = 40
    pair = renderer(room, painted).pair(at(*pose))
    edge = np.array([[8, end, 1.0], [0, 6 - end, 1.0]])
    points = stereo.camera_from_map(edge, np.array(pose), CAMERA.mount)
    _, column, disparity = stereo.project(points[points[:, 2] > 0], CAMERA)[0]
    for eye, expected in zip(pair, (column, column - disparity), strict=True):
        first, last = int(expected) - 20, int(expected) + 20
        light = (eye[240, first : last + 1].astype(float) - 40) / 200
        assert first - 0.5 + light.sum() == pytest.approx(expected, abs=0.01)


def test_whole_numbers_are_the_centres_of_pixels():
    """An edge on the optical axis goes through the middle of column 320, not beside it."""
    room = walls(((0, 0), (8, 0), (8, 3.06), (8, 6), (0, 6)))
    painted = grey(room, 40)
    painted.of(2)[:] = 240
    row = renderer(room, painted).pair(at(3, 3, 0.0)).left[240]
    # The wall beyond y = 3.06, where the left camera looks at, is the one on the left.
    assert row[310:331].tolist() == [240] * 10 + [140] + [40] * 10


def test_both_cameras_see_their_own_side_of_a_near_edge():
    """A column that is seen in one eye is hidden from the other by the pillar."""
    room = walls(ROOM, PILLAR)
    painted = grey(room, 200)
    for wall in range(4, 8):
        painted.of(wall)[:] = 20
    pair = renderer(room, painted).pair(at(3, 3.75, 0.0))
    face = [np.flatnonzero(eye[240] == 20) for eye in pair]
    # Its front is 2 m away, 0.5 m wide, and 0.06 m beside the axis of each camera.
    for columns, middle in zip(face, (320 + 15, 320 - 15), strict=True):
        assert columns[0] == pytest.approx(middle - 62.5, abs=1)
        assert columns[-1] == pytest.approx(middle + 62.5, abs=1)


def test_walls_hide_what_is_behind_them():
    room = walls(ROOM, PILLAR)
    seen, hidden = grey(room, 100), grey(room, 100)
    behind = hidden.of(1)
    behind[:, 240 // 5 :] = 100
    back = int(behind.shape[1] * (6 - 3.75) / 6)
    behind[:, back - 2 : back + 2] = 255
    poses = [at(4.5, 3.75, 0.0), at(4.5, 2.5, 0.0)]
    for pose, is_hidden in zip(poses, (True, False), strict=True):
        pairs = [renderer(room, painted).pair(pose) for painted in (seen, hidden)]
        assert np.array_equal(*pairs_of(pairs)) == is_hidden


def pairs_of(pairs):
    return [np.stack(pair) for pair in pairs]


def test_every_column_of_the_building_shows_a_wall():
    """No ray slips through between two walls, wherever a robot is."""
    room = world.building()
    shot = renderer(room, grey(room, 255))
    for name in ("figure_eight", "ring"):
        for pose in (
            Simulation(Scenario(robots=1, trajectory=name, movements=40), 0)
            .truth_path("robot_1")
            .poses
        ):
            assert (np.stack(shot.pair(at(*pose)))[:, 240] == 255).all()


def test_far_texture_is_averaged_and_near_texture_is_interpolated():
    room = walls(((0, 0), (40, 0), (40, 2), (0, 2)))
    shot = renderer(room, noisy(room, 0.004, least=0, most=255))
    far = shot.pair(at(1, 1, 0.0)).left[236:245, 316:325]
    assert np.ptp(far) < 40
    room = walls(ROOM)
    near = renderer(room, noisy(room, 0.05)).pair(at(7.5, 3, 0.0)).left.astype(float)
    assert np.abs(np.diff(near[:, 200:400])).max() < 255 * 0.5 / (0.05 * 500) * 1.5


def test_the_camera_looks_where_its_mount_says():
    room = walls(ROOM)
    painted = checkered(room)
    turned = StereoCamera(mount=CameraMount(yaw_rad=0.4, left_m=0.0, forward_m=0.0))
    straight = StereoCamera(mount=CameraMount(left_m=0.0))
    one = renderer(room, painted, camera=turned).pair(at(3, 3, 0.0))
    other = renderer(room, painted, camera=straight).pair(at(3, 3, 0.4))
    np.testing.assert_array_equal(np.stack(one), np.stack(other))


@pytest.mark.parametrize(
    ("mount", "told"),
    [
        ({"roll_rad": 0.1}, r"camera\.mount\.roll_rad = 0\.1: .* level; give 0"),
        ({"pitch_rad": -0.2}, r"camera\.mount\.pitch_rad = -0\.2: .* level; give 0"),
        ({"up_m": 2.0}, r"camera\.mount\.up_m = 2\.0: .* give 0 < value < 2\.0"),
        ({"up_m": 0.0}, r"camera\.mount\.up_m = 0\.0: "),
    ],
)
def test_cameras_that_cannot_be_rendered_are_refused(mount, told):
    camera = StereoCamera(mount=CameraMount(**mount))
    with pytest.raises(InputError, match=told):
        Simulation(Scenario(camera=camera, images=PERFECT), 0)
    Simulation(Scenario(camera=camera, images=changed(enabled=False)), 0)
    room = walls(ROOM)
    with pytest.raises(InputError, match=told):
        renderer(room, grey(room, 100), camera=camera)
