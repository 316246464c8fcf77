"""Tags: where they are, which they are, how exact that is, and what is no tag."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from tag_pictures import RIG, SIZE_M, Tag, backdrop, pair

from msg_defs.errors import InputError
from msg_defs.types import Sightings
from multi_robot_slam.config import Config
from multi_robot_slam.front_end import tag_families, tags
from multi_robot_slam.front_end.front_end import FrontEnd
from multi_robot_slam.front_end.settings import CameraSettings, TagSettings
from multi_robot_slam.front_end.tag_corners import refined
from multi_robot_slam.front_end.tag_families import FAMILIES, descriptors
from multi_robot_slam.front_end.tags import axis_of_robot, find

SETTINGS = TagSettings(family="36h11", size_m=SIZE_M)
SHARP = replace(SETTINGS, sigma_px=1e-3)
"""What the pictures alone tell, as if the calibration were perfect."""
FULL = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
HERE = Tag(17, (0.1, -0.05, 1.5), 0.4, 0.1, 0.1)


def nees(error, covariance):
    return error @ np.linalg.solve(covariance[FULL].astype(float), error)


def some_tag(rng, z):
    x, y = rng.uniform(-0.25, 0.25, 2) * z
    turned, pitched, rolled = rng.uniform(-1, 1, 3) * (0.9, 0.3, 0.3)
    return Tag(int(rng.integers(587)), (x, y, z), turned, pitched, rolled)


def assert_counted(counts, **expected):
    parts = {name: value for name, value in vars(counts).items() if value}
    assert parts == expected


class TestLandmarks:
    @pytest.mark.parametrize("z", [0.7, 1.5, 3.0])
    def test_a_tag_is_where_it_is(self, z):
        rng = np.random.default_rng(int(10 * z))
        for seed in range(5):
            tag = some_tag(rng, z)
            seen = find(*pair([tag], seed=seed), RIG, SETTINGS)
            assert seen.numbers.tolist() == [tag.number]
            assert_counted(seen.counts, seen=1, matched=1)
            error = np.abs(seen.positions[0] - tag.centre)
            assert (error < [0.001 * z, 0.001 * z, 0.002 * z**2]).all()
            np.testing.assert_allclose(RIG.pixel(np.array(tag.centre)), seen.pixels[0], atol=0.15)
            np.testing.assert_array_equal(seen.descriptors, descriptors(np.array([tag.number])))
            assert (seen.positions.dtype, seen.covariances.dtype) == (np.float32, np.float32)

    def test_the_mean_of_the_corners_pixels_would_be_beside_the_centre(self):
        """Why corners go through (14) one by one: near and oblique, their mean pixel is off."""
        tag = Tag(3, (0.0, 0.0, 0.7), 0.8)
        mean_pixel = RIG.pixel(tag.corners()).mean(axis=0)
        seen = find(*pair([tag]), RIG, SETTINGS)
        assert abs(mean_pixel[0] - RIG.centre_px[0]) > 1
        assert abs(seen.pixels[0, 0] - RIG.centre_px[0]) < 0.1

    def test_several_tags_come_in_order_of_their_numbers(self):
        placed = [
            Tag(n, (x, 0.1 * (n % 3), 1.6), 0.2) for n, x in ((8, 0.4), (2, 0.0), (500, -0.4))
        ]
        seen = find(*pair(placed), RIG, SETTINGS)
        assert seen.numbers.tolist() == [2, 8, 500]
        np.testing.assert_allclose(seen.positions[0], placed[1].centre, atol=0.005)

    @pytest.mark.parametrize("family", ["36h11", "25h9", "16h5", "4x4_50", "5x5_1000", "original"])
    def test_every_family(self, family):
        number = FAMILIES[family].numbers - 1
        code = getattr(cv2.aruco, FAMILIES[family].dictionary)
        images = pair([replace_number(HERE, number)], family=code)
        seen = find(*images, RIG, TagSettings(family=family, size_m=SIZE_M))
        assert seen.numbers.tolist() == [number]
        np.testing.assert_allclose(seen.positions[0], HERE.centre, atol=0.006)

    def test_the_same_pictures_give_the_same_bytes(self):
        images = pair([HERE, Tag(4, (-0.3, 0.1, 2.0))])
        first, second = (find(*images, RIG, SETTINGS) for _ in range(2))
        assert first.positions.tobytes() == second.positions.tobytes()
        assert first.covariances.tobytes() == second.covariances.tobytes()

    def test_without_a_family_nothing_is_looked_for(self):
        seen = find(*pair([HERE]), RIG, TagSettings())
        assert_counted(seen.counts)
        assert seen.positions.shape == (0, 3)
        assert seen.covariances.shape == (0, 6)
        assert seen.descriptors.shape == (0, 128)
        assert seen.pixels.shape == (0, 3)


def replace_number(tag, number):
    return tag._replace(number=number)


class TestExactness:
    @pytest.mark.parametrize(("noise", "blur_px"), [(1.0, 0.5), (2.0, 0.6), (5.0, 1.0)])
    def test_a_corner_is_as_exact_as_its_edges_are_straight(self, noise, blur_px):
        """The sigma that is derived from each picture is that of the corners' error in it."""
        rng = np.random.default_rng(7)
        for z in (1.0, 2.2):
            squared = []
            for seed in range(10):
                tag = some_tag(rng, z)
                left, _ = pair([tag], seed=seed, noise=noise, blur_px=blur_px)
                truth = RIG.pixel(tag.corners())[None, :, :2]
                rough = truth + rng.uniform(-1, 1, truth.shape)
                corners, sigma = refined(left, rough, 8)
                squared.append(((corners - truth) / sigma) ** 2)
            assert 0.3 < np.mean(squared) < 2.2

    def test_refinement_forgets_where_it_began(self):
        left, _ = pair([HERE])
        truth = RIG.pixel(HERE.corners())[None, :, :2]
        found = [
            refined(left, truth + np.random.default_rng(seed).uniform(-1, 1, truth.shape), 8)[0]
            for seed in range(5)
        ]
        assert np.ptp(found, axis=0).max() < 0.1
        assert np.abs(found - truth).max() < 0.15

    def test_the_covariance_is_that_of_corners_with_independent_errors(self):
        """Monte Carlo: column and row of four corners in two images, through (14)."""
        rng = np.random.default_rng(0)
        tag, sigma = Tag(0, (0.4, -0.3, 2.0), 0.7), 0.1
        left = RIG.pixel(tag.corners())
        count = 4000
        in_left = left[:, :2] + sigma * rng.normal(size=(count, 4, 2))
        right_column = left[:, 0] - left[:, 2] + sigma * rng.normal(size=(count, 4))
        pixels = np.dstack([in_left.reshape(-1, 2)[None]])[0].reshape(count, 4, 2)
        pixels = np.concatenate([pixels, (pixels[..., 0] - right_column)[..., None]], axis=2)
        drawn = RIG.point(*np.moveaxis(pixels, -1, 0)).mean(axis=1)
        one = tags._in_space(np.zeros(1, int), left[None], np.full(1, sigma), RIG)
        (position,), (covariance,) = one.centres()
        np.testing.assert_allclose(position, tag.centre, atol=1e-12)
        whitened = np.linalg.solve(np.linalg.cholesky(covariance), (drawn - position).T)
        np.testing.assert_allclose(np.cov(whitened), np.eye(3), atol=0.1)

    def test_positions_are_at_least_as_exact_as_told(self):
        """NEES of 3 is what is told; but a pattern errs alike in both images, which is better."""
        rng, found = np.random.default_rng(3), []
        for seed in range(30):
            tag = some_tag(rng, rng.uniform(0.8, 3))
            noise, blur_px = [(1.0, 0.5), (2.0, 0.6), (5.0, 0.9)][seed % 3]
            seen = find(*pair([tag], seed=seed, noise=noise, blur_px=blur_px), RIG, SHARP)
            if len(seen.positions):
                found.append(nees(seen.positions[0] - tag.centre, seen.covariances[0]))
        assert len(found) >= 25
        assert 0.5 < np.mean(found) < 3.5

    def test_the_calibration_s_share_is_a_setting(self):
        images = pair([HERE])
        small, large = (
            find(*images, RIG, replace(SETTINGS, sigma_px=sigma)).covariances[0]
            for sigma in (0.1, 0.3)
        )
        np.testing.assert_allclose(large, 9 * small, rtol=1e-5)


class TestDescriptors:
    EVERY = descriptors(np.arange(2320))

    def test_norm(self):
        np.testing.assert_allclose(np.linalg.norm(self.EVERY, axis=1), 1, atol=1e-6)

    @pytest.mark.parametrize(
        ("numbers", "least"), [(121, 20 / 11), (1331, 18 / 11), (2320, 16 / 11)]
    )
    def test_e_of_two_numbers_is_zero_or_large(self, numbers, least):
        some = self.EVERY[:numbers].astype(np.float64)
        distances = 2 - 2 * some @ some.T
        np.testing.assert_allclose(np.diag(distances), 0, atol=1e-6)
        np.fill_diagonal(distances, np.inf)
        assert distances.min() == pytest.approx(least, abs=1e-6)

    def test_e_of_a_tag_and_what_has_no_negative_element_is_two_at_least(self):
        rng = np.random.default_rng(1)
        sift = rng.gamma(0.3, size=(200, 128)) * (rng.random((200, 128)) < 0.2)
        sift /= np.linalg.norm(sift, axis=1, keepdims=True)
        distances = ((sift[:, None] - self.EVERY[None, :50]) ** 2).sum(axis=2)
        assert distances.min() >= 2 - 1e-6

    def test_every_family_has_as_many_patterns_as_opencv_says(self):
        assert len(FAMILIES) == 22
        for family in FAMILIES.values():
            code = getattr(cv2.aruco, family.dictionary)
            assert len(cv2.aruco.getPredefinedDictionary(code).bytesList) == family.numbers
            assert family.numbers <= tag_families._PRIME**tag_families._DIGITS


class TestNoTags:
    def test_the_same_number_twice_is_neither(self):
        placed = [Tag(5, (-0.3, 0, 1.5)), Tag(5, (0.3, 0, 1.5)), Tag(6, (0, 0.25, 1.5))]
        seen = find(*pair(placed), RIG, SETTINGS)
        assert seen.numbers.tolist() == [6]
        assert_counted(seen.counts, seen=3, ambiguous=2, matched=1)

    def test_twice_in_the_right_image_alone_is_neither(self):
        """The second one is left of what the left image shows."""
        left, right = pair([Tag(5, (0.3, 0, 1.5))])
        right[:, :200] = pair([Tag(5, (-0.5, 0.2, 1.5))])[1][:, :200]
        seen = find(left, right, RIG, SETTINGS)
        assert_counted(seen.counts, seen=1, ambiguous=1)

    def test_a_tag_in_the_left_image_alone_has_no_distance(self):
        left, _ = pair([HERE])
        seen = find(left, backdrop(), RIG, SETTINGS)
        assert_counted(seen.counts, seen=1, one_sided=1)

    def test_what_is_on_other_rows_is_another_tag(self):
        left, right = pair([HERE])
        seen = find(left, np.roll(right, 4, axis=0), RIG, SETTINGS)
        assert_counted(seen.counts, seen=1, one_sided=1)

    @pytest.mark.parametrize("shift", [0, -60])
    def test_right_before_left_is_too_far(self, shift):
        left, right = pair([HERE])
        seen = find(right if shift == 0 else left, left, RIG, SETTINGS)
        assert_counted(seen.counts, seen=1, far=1)

    @pytest.mark.parametrize("size_m", [0.08, 0.13, 0.2, 0.3])
    def test_a_tag_of_another_size_is_told(self, size_m):
        images = pair([HERE._replace(size_m=size_m, number=44)])
        seen = find(*images, RIG, SETTINGS)
        assert_counted(seen.counts, seen=1, other_size=1)
        np.testing.assert_allclose(seen.other_sides_m, [size_m], rtol=0.03)

    @pytest.mark.parametrize("size_m", [0.155, 0.165])
    def test_a_ruler_may_be_off_by_a_little(self, size_m):
        seen = find(*pair([HERE._replace(size_m=size_m)]), RIG, SETTINGS)
        np.testing.assert_allclose(seen.positions, [HERE.centre], atol=0.004)

    def test_corners_that_are_no_square_are_no_tag(self):
        """The right image's tag is stretched: to the left its disparity is larger."""
        left, right = pair([Tag(9, (0, 0, 1.0))])
        stretch = np.array([[1.15, 0, -0.15 * 266], [0, 1, 0]])
        seen = find(left, cv2.warpAffine(right, stretch, right.shape[::-1]), RIG, SETTINGS)
        assert_counted(seen.counts, seen=1, other_size=1)

    def test_noise_does_not_make_a_tag_larger(self):
        """Sides with errors are too long in the mean; what is told of a tag's size is not."""
        rng, count = np.random.default_rng(0), 3000
        corners = Tag(0, (0, 0, 5.0), 0.5).corners() + rng.normal(size=(count, 4, 3)) * 0.03
        noise = np.broadcast_to(0.03**2 * np.eye(3), (count, 4, 3, 3))
        fits, sides = tags._are_squares(tags._Squares(np.arange(count), corners, noise), SIZE_M)
        assert fits.mean() > 0.999
        assert np.sqrt(np.mean(sides**2)) == pytest.approx(SIZE_M, rel=0.02)

    def test_far_tags_are_not_seen_rather_than_misread(self):
        rng = np.random.default_rng(5)
        numbers = set()
        for seed in range(8):
            tag = some_tag(rng, 3.5 + seed / 2)
            seen = find(*pair([tag], seed=seed), RIG, SETTINGS)
            numbers |= {*seen.numbers.tolist()} - {tag.number}
        assert not numbers

    @pytest.mark.parametrize("x", np.linspace(-1.05, -0.8, 6))
    def test_at_the_border_a_tag_is_whole_or_not_there(self, x):
        tag = Tag(12, (float(x), 0.0, 1.3))
        seen = find(*pair([tag]), RIG, SETTINGS)
        for position in seen.positions:
            np.testing.assert_allclose(position, tag.centre, atol=0.006)
        inside = RIG.pixel(tag.corners(1.3))[:, 0] - RIG.pixel(tag.corners())[:, 2]
        if inside.min() > 5:
            assert len(seen.positions) == 1

    @pytest.mark.parametrize("shade", [0, 128, 255])
    def test_blank_pictures_show_none(self, shade):
        blank = np.full((480, 640), shade, np.uint8)
        assert_counted(find(blank, blank, RIG, SETTINGS).counts)

    def test_what_has_no_edges_is_refused(self):
        corners = np.array([[[100, 100], [140, 100], [140, 140], [100, 140.0]]])
        moved, sigma = refined(np.full((480, 640), 90, np.uint8), corners, 8)
        assert np.isnan(moved).all()
        assert np.isnan(sigma).all()

    @pytest.mark.parametrize("half_px", [2, 6, 10, 14])
    def test_a_tag_that_is_partly_covered_is_not_used(self, half_px):
        left, right = pair([HERE])
        corners = RIG.pixel(HERE.corners())[:, :2]
        column, row = corners[[0, 3]].mean(axis=0).astype(int)
        covered = left.copy()
        covered[row - half_px : row + half_px, column - 40 : column + 3] = 200
        seen = find(covered, right, RIG, SETTINGS)
        assert_counted(seen.counts, seen=1, blurred=1)


PLACES = st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-3.1, 3.1))


def carried(centre, heading, place):
    """A tag on a robot with its axis at `centre` (X, Y, Z) and `heading` in the camera's plane.

    Heading 0 is to the camera's right, pi / 2 away from it.
    """
    forward, left, yaw = place
    ahead = np.array([np.cos(heading), 0, np.sin(heading)])
    leftwards = np.array([-np.sin(heading), 0, np.cos(heading)])
    out = np.cos(yaw) * ahead + np.sin(yaw) * leftwards
    # a tag that is not turned faces the camera: out is -Z; turned to the right, it faces right
    turned = np.arctan2(-out[0], -out[2])
    at = np.asarray(centre) + forward * ahead + left * leftwards
    return Tag(30, tuple(at), -turned), out


class TestRobots:
    @given(PLACES, st.floats(-3.1, 3.1))
    def test_the_axis_is_where_the_place_says(self, place, heading):
        centre = np.array([0.3, -0.2, 2.5])
        tag, out = carried(centre, heading, place)
        normal = np.cross(tag.axes()[:, 1], tag.axes()[:, 0])
        np.testing.assert_allclose(normal, out, atol=1e-9)
        position, _ = axis_of_robot(tag.corners(), np.zeros((4, 3, 3)), place, SIZE_M)
        np.testing.assert_allclose(position, centre, atol=1e-9)

    @hypothesis_settings(max_examples=20)
    @given(PLACES, st.floats(-3.1, 3.1), st.integers(0, 9))
    def test_its_covariance_is_that_of_a_linear_map_of_the_corners(self, place, heading, seed):
        """Finite differences of all twelve numbers."""
        tag, _ = carried((0.3, -0.2, 2.5), heading, place)
        root = np.random.default_rng(seed).normal(size=(4, 3, 3)) * 1e-2
        noise = root @ np.swapaxes(root, 1, 2)
        corners = tag.corners()
        _, covariance = axis_of_robot(corners, noise, place, SIZE_M)
        expected = np.zeros((3, 3))
        for i in range(4):
            lever = np.empty((3, 3))
            for k in range(3):
                step = np.zeros((4, 3))
                step[i, k] = 1e-6
                ends = [
                    axis_of_robot(corners + sign * step, noise, place, SIZE_M)[0]
                    for sign in (1, -1)
                ]
                lever[:, k] = (ends[0] - ends[1]) / 2e-6
            expected += lever @ noise[i] @ lever.T
        np.testing.assert_allclose(covariance, expected, rtol=1e-5, atol=1e-9)

    def test_it_is_unbiased_however_far_the_tag(self):
        """Directions are not normalised, so that errors as large as the tag stay centred."""
        place, rng = (0.3, 0.1, 0.4), np.random.default_rng(0)
        tag, _ = carried((0.0, 0.0, 5.0), 2.5, place)
        noise = np.tile(np.diag([0.01, 0.01, 0.08]) ** 2, (4, 1, 1))
        drawn = np.array(
            [
                axis_of_robot(
                    tag.corners() + rng.normal(size=(4, 3)) * (0.01, 0.01, 0.08),
                    noise,
                    place,
                    SIZE_M,
                )[0]
                for _ in range(4000)
            ]
        )
        expected = axis_of_robot(tag.corners(), noise, place, SIZE_M)[1]
        deviations = np.sqrt(np.diag(expected))
        assert (np.abs(drawn.mean(axis=0) - (0, 0, 5)) < 4 * deviations / np.sqrt(4000)).all()
        np.testing.assert_allclose(drawn.std(axis=0), deviations, rtol=0.15)

    def test_a_robot_in_the_picture(self):
        rng, found = np.random.default_rng(2), []
        for seed in range(20):
            place = (*rng.uniform(-0.2, 0.2, 2), rng.uniform(-3, 3))
            centre = np.array([rng.uniform(-0.5, 0.5), 0.1, rng.uniform(1.2, 2.5)])
            # the tag faces the camera, more or less
            heading = -np.pi / 2 - place[2] + rng.uniform(-0.7, 0.7)
            tag, _ = carried(centre, heading, place)
            settings = replace(SHARP, on_robots=((tag.number, 2, *place),))
            seen = find(*pair([tag, Tag(7, (0.2, -0.5, 2.2))], seed=seed), RIG, settings)
            assert tag.number not in seen.numbers
            assert seen.robots.others.tolist() == [2]
            assert seen.robots.others.dtype == np.uint32
            found.append(nees(seen.robots.positions[0] - centre, seen.robots.covariances[0]))
        assert 0.5 < np.mean(found) < 3.5

    def test_of_several_tags_on_a_robot_the_surest_counts(self):
        near, far = Tag(1, (-0.2, 0, 1.2)), Tag(2, (0.2, 0, 1.6))
        both = replace(SETTINGS, on_robots=((1, 0, 0.0, 0.0, 0.0), (2, 0, 0.0, 0.0, 0.0)))
        seen = find(*pair([near, far]), RIG, both)
        assert seen.robots.others.tolist() == [0]
        np.testing.assert_allclose(seen.robots.positions, [near.centre], atol=0.004)
        assert len(seen.positions) == 0

    def test_several_robots_come_in_the_team_s_order(self):
        settings = replace(SETTINGS, on_robots=((1, 4, 0.0, 0.0, 0.0), (2, 0, 0.0, 0.0, 0.0)))
        seen = find(*pair([Tag(1, (-0.2, 0, 1.2)), Tag(2, (0.2, 0, 1.6))]), RIG, settings)
        assert seen.robots.others.tolist() == [0, 4]
        Sightings("robot_1", 0, *seen.robots)


class TestSettings:
    @pytest.mark.parametrize(
        ("values", "told"),
        [
            ({"family": "36h12"}, "tags.family = '36h12': known are 16h5, 25h9, 36h10, 36h11, 4x4"),
            ({"family": "APRILTAG_36h11"}, "known are"),
            ({"size_m": 0.0}, "size_m"),
            ({"sigma_px": -1.0}, "sigma_px"),
            ({"on_robots": ((1, 0, 0.0, 0.0, 0.0),)}, "no tags are looked for; set tags.family"),
            (
                {"family": "36h11", "on_robots": ((587, 0, 0.0, 0.0, 0.0),)},
                "tag 587; .* 36h11 has 0 to 586",
            ),
            ({"family": "36h11", "on_robots": ((-1, 0, 0.0, 0.0, 0.0),)}, "tag -1; give each once"),
            (
                {"family": "36h11", "on_robots": ((3, 0, 0.0, 0.0, 0.0),) * 2},
                "tag 3; give each once",
            ),
            ({"family": "36h11", "on_robots": ((3, -2, 0.0, 0.0, 0.0),)}, "robot -2 of tag 3"),
        ],
    )
    def test_what_means_nothing_is_refused(self, values, told):
        with pytest.raises(InputError, match=told):
            TagSettings(**values)

    def test_robots_with_tags_are_in_the_team_and_are_heard_of(self):
        camera = CameraSettings(tags=replace(SETTINGS, on_robots=((3, 1, 0.0, 0.0, 0.0),)))
        with pytest.raises(InputError, match="robot 1 of tag 3; give its place in robots: 0 to 0"):
            Config(camera=camera)
        team = {"robots": ("a", "b"), "start_poses": ((0.0, 0.0, 0.0),) * 2}
        with pytest.raises(InputError, match="set sightings: true"):
            Config(**team, camera=camera)
        assert Config(**team, sightings=True, camera=camera).camera == camera


class TestFrontEnd:
    def test_tags_are_the_last_of_what_is_seen(self):
        left, right = pair([HERE, Tag(4, (-0.5, 0.3, 2.0))], seed=3)
        with_tags = FrontEnd(RIG, CameraSettings(tags=SETTINGS)).observe(left, right)
        without = FrontEnd(RIG, CameraSettings()).observe(left, right)
        assert with_tags.tags.numbers.tolist() == [4, 17]
        np.testing.assert_array_equal(with_tags.positions[-2:], with_tags.tags.positions)
        np.testing.assert_array_equal(with_tags.descriptors[-2:], with_tags.tags.descriptors)
        lengths = {
            len(values) for values in vars(with_tags).values() if isinstance(values, np.ndarray)
        }
        assert lengths == {with_tags.counts.kept + 2}
        assert without.counts.kept > 5
        assert len(without.positions) == without.counts.kept

    def test_points_on_tags_are_not_points(self):
        """Patterns resemble each other, and what is on a robot moves."""
        tag = HERE._replace(centre=(0.0, 0.0, 0.9))
        robot = replace(SETTINGS, on_robots=((tag.number, 0, 0.0, 0.0, 0.0),))
        seen = FrontEnd(RIG, CameraSettings(tags=robot)).observe(*pair([tag]))
        assert seen.counts.on_tag > 20
        outline = RIG.pixel(tag.corners(1.1))[:, :2].astype(np.float32)
        inside = [cv2.pointPolygonTest(outline, tuple(p), False) > 0 for p in seen.pixels[:, :2]]
        assert not any(inside)
