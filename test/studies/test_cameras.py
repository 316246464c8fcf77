"""The study of cameras: what is asked for, revisits, the kept clouds, and the table."""

from dataclasses import replace

import numpy as np
import pytest

from msg_defs.errors import InputError
from msg_defs.types import FrameRecord, StepRecord
from multi_robot_slam.datasets.levelling import Cloud
from multi_robot_slam.studies import (
    cameras,
    cameras_library,
    cameras_rendered,
    cameras_table,
    clouds,
)
from multi_robot_slam.studies.cameras_table import Row
from multi_robot_slam.studies.descriptor_gate import Spread
from multi_robot_slam.studies.front_end import Motion
from multi_robot_slam.studies.revisits import revisits


def cloud(count, seed=0):
    rng = np.random.default_rng(seed)
    shapes = ((count, 3), (count, 6), (count, 128))
    return Cloud(*(rng.random(shape, np.float32) for shape in shapes))


def test_clouds_are_made_once(tmp_path):
    made = [cloud(3), cloud(0), cloud(5, seed=1)]
    path = tmp_path / "folder" / "clouds.npz"
    clouds.kept(path, lambda: made)
    again = clouds.kept(path, lambda: pytest.fail("made again"))
    for one, other in zip(made, again, strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_array_equal(a, b)
    path.write_bytes(b"broken")
    with pytest.raises(InputError, match="remove it"):
        clouds.kept(path, lambda: made)


def test_a_plan_names_what_is_not_known(tmp_path):
    assert cameras.plan("euroc", tmp_path, None, 5).setups[1] == "two robots"
    assert cameras.plan("rendered", None, "rendered, people", 5).setups == ("rendered", "people")
    for arguments, hint in (
        (("webcam", None, None, 5), "euroc"),
        (("euroc", None, None, 5), "FOLDER"),
        (("rendered", tmp_path, None, 5), "no folder"),
        (("kitti", tmp_path, "two robots", 5), "one robot"),
    ):
        with pytest.raises(InputError, match=hint):
            cameras.plan(*arguments)


def test_nuisances_come_one_at_a_time_and_all_together():
    plain = cameras_rendered.scenario(cameras_rendered.RENDERED).images
    people = cameras_rendered.scenario("people").images
    assert people == replace(plain, people=people.people)
    assert people.people > 0
    everything = cameras_rendered.scenario(cameras_rendered.EVERYTHING).images
    for name in cameras_rendered.NUISANCES:
        own = cameras_rendered.scenario(name).images
        for field in ("people", "exposure_s", "vignetting", "right_off_px", "photon_noise"):
            if getattr(own, field) != getattr(plain, field):
                assert getattr(everything, field) == getattr(own, field)
    others = cameras_rendered.scenario(cameras_rendered.CALIBRATED).images
    assert others == replace(everything, right_off_px=plain.right_off_px)
    assert (everything.walls.repeated, everything.walls.plain) == (0.2, 0.3)
    assert not cameras_rendered.scenario(cameras_rendered.LANDMARKS).images.enabled


def row(**changes):
    values = dict.fromkeys(cameras_table.NAMES, 0.5)
    texts = {"setup": "one robot", "robot": "robot_1", "seed": 0, "particles": 9, "revisits": 4}
    return Row(**(values | texts | changes))


def test_the_table_survives_a_round_trip_and_ratios_are_of_root_mean_squares(tmp_path):
    rows = [
        row(batch_path_rmse_m=None, online_path_rmse_m=3.0, odometry_path_rmse_m=10.0),
        row(seed=1, online_path_rmse_m=4.0, odometry_path_rmse_m=10.0),
        row(setup="two robots", online_path_rmse_m=1.0),
    ]
    kept = cameras_table.opened(tmp_path / "cameras.csv")
    kept.write()
    kept.append({cameras_table.key_of(r): r for r in rows})
    assert [*cameras_table.opened(tmp_path / "cameras.csv").rows.values()] == rows
    first = cameras_table.markdown(rows, over="two robots").splitlines()[2]
    cells = [cell.strip() for cell in first.split("|")]
    assert cells[-4:-1] == [f"{np.sqrt(12.5) / 10:.2f}", "8.00", f"{np.sqrt(12.5):.2f}"]


class MadeUpRun:
    """Four frames of one robot, 15 s apart; landmark 7 is created of truth 0, 8 of truth 1."""

    def __init__(self, matches, truths):
        ids = ([7, 8], *matches)
        self.robots = {"r": None}
        self.steps = []
        self.observation_truth = {}
        for number, (own, true) in enumerate(zip(ids, ([0, 1], *truths), strict=True)):
            stamp = number * 15_000_000_000
            count, nothing = len(own), np.full(len(own), np.nan, np.float32)
            is_new = np.full(count, number == 0)
            frame = FrameRecord(
                "r", np.array(own, int), is_new, np.zeros(count, bool), nothing, nothing
            )
            self.steps.append(StepRecord(stamp, number, (frame,), (), 1.0, False, 0.0))
            self.observation_truth["r", stamp] = np.array(true, np.uint32)


PLACES = {0: np.zeros(3), 1: np.ones(3), 2: np.array([0.01, 0, 0])}


def test_only_landmarks_that_nobody_saw_for_long_are_revisited():
    followed = MadeUpRun([[7], [7], [7]], [[0], [0], [0]])
    assert revisits(followed, PLACES).seen == 0
    found = revisits(MadeUpRun([[], [7, 8], []], [[], [0, 1], []]), PLACES)
    assert found == (2, 1.0, 1.0)


def test_a_wrong_landmark_costs_recall_and_precision_unless_it_is_the_same_place():
    swapped = MadeUpRun([[], [8], []], [[], [0], []])
    assert revisits(swapped, PLACES) == (1, 0.0, 0.0)
    beside = MadeUpRun([[], [7], []], [[], [2], []])
    assert revisits(beside, PLACES) == (0, None, 1.0)


def test_the_gate_is_as_large_as_wrong_matches_allow():
    right = np.linspace(0, 0.5, 1000)
    spread = Spread(right, right, right, np.linspace(0.3, 1, 100))
    gate = spread.gate(0.01)
    assert 0.3 < gate < 0.5
    assert spread.wrong_within(gate) <= 0.01 < spread.wrong_within(gate + 0.01)
    assert Spread(right, right, np.array([0.5]), np.array([0.1])).gate(0.01) == 0


def test_a_motion_in_space_is_put_into_the_plane():
    """The second camera is 0.3 m ahead and 0.1 m to the right, turned to the left by 0.2 rad."""
    cos, sin = np.cos(0.2), np.sin(0.2)
    axes = np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])  # columns: its X, Y, Z
    centre = np.array([0.1, 0.02, 0.3])
    motion = Motion(axes.T, -axes.T @ centre, 99)
    np.testing.assert_allclose(cameras_library.planar(motion), [0.3, -0.1, 0.2])
    assert cameras_library.planar(None) is None


def test_noise_of_motions_is_what_was_put_into_them():
    rng = np.random.default_rng(0)
    sigma = np.array([0.01, 0.005, 0.002])
    true = np.array([0.1, 0.0, 0.0])
    found = [true + sigma * rng.standard_normal(3) for _ in range(4000)]
    both = [2 * true + sigma * rng.standard_normal(3) for _ in range(3999)]
    noise = cameras_library.noise_of(found, both)
    per_step = np.sqrt(0.1) * np.array(
        [noise.forward_per_sqrt_s, noise.left_per_sqrt_s, noise.yaw_per_sqrt_s]
    )
    np.testing.assert_allclose(per_step, sigma, rtol=0.1)
    lost = [None if k % 4 == 0 else motion for k, motion in enumerate(found)]
    assert cameras_library.noise_of(lost, both).forward_per_sqrt_s > noise.forward_per_sqrt_s


def test_the_rendered_camera_is_where_its_mount_says():
    camera = cameras_rendered.scenario("rendered").camera
    place, rotation = cameras_rendered.camera_pose(np.array([1.0, 2.0, np.pi / 2]), camera.mount)
    left = camera.mount.left_m
    np.testing.assert_allclose(place, [1 - left, 2 + camera.mount.forward_m, camera.mount.up_m])
    np.testing.assert_allclose(rotation[:, 2], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(rotation[:, 1], [0, 0, -1], atol=1e-12)


def test_what_is_seen_in_both_worlds_becomes_a_session():
    """The first instants of the building: clouds that show the same points keep their numbers."""
    simulation = cameras_rendered.Simulation(cameras_rendered.scenario("rendered"), 0)
    config = cameras_rendered.configuration(simulation, "rendered")
    instants = [*simulation.steps()][:2]
    pose = instants[0][0].truth.pose
    seen = [cloud(0) for _ in range(6)]
    seen[0] = seen[3] = Cloud(
        np.array([[0.0, 0.1, 3.0]]), np.array([[1e-4, 0, 0, 1e-4, 0, 1e-3]]), np.eye(1, 128)
    )
    steps = [(step, *rest) for step, *rest in instants]
    steps[1] = (replace(steps[1][0], truth=replace(steps[1][0].truth, pose=pose)), *steps[1][1:])
    session = cameras_rendered.rendered_session(simulation, steps, seen, config)
    first, again = (steps[k][0].odometry for k in (0, 1))
    known = session.recorded.observation_truth
    assert known[first.robot, first.stamp_ns].tolist() == [0]
    assert known[again.robot, again.stamp_ns].tolist() == [0]
    assert len(session.events) == 12
