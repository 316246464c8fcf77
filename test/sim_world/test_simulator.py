"""The scenario and the simulation as a whole."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from msg_defs import scenario_file
from msg_defs.errors import InputError
from msg_defs.types import StereoCamera
from sim_world.rendering.settings import ImageSettings
from sim_world.scenario import SECTION, Scenario
from sim_world.simulator import Simulation

CONFIG = Path(__file__).parents[2] / "config"
SHORT = Scenario(movements=30)


def content(step):
    """Everything a robot's step holds, as bytes."""
    odometry, seen, truth, landmarks = vars(step).values()
    arrays = [odometry.pose, odometry.twist, odometry.covariance, truth.pose, truth.twist]
    arrays += [seen.positions, seen.covariances, seen.descriptors, landmarks.landmarks]
    names = [(record.robot, record.stamp_ns) for record in vars(step).values()]
    return names, [array.tobytes() for array in arrays]


def run(scenario, seed, only=None):
    """Name of each robot -> the content of its steps."""
    columns = zip(*Simulation(scenario, seed, only).steps(), strict=True)
    return {column[0].odometry.robot: [content(step) for step in column] for column in columns}


def odometry(scenario, seed=0):
    return [step.odometry.pose for (step,) in Simulation(scenario, seed).steps()]


def test_same_seed_same_bytes():
    assert run(SHORT, 3) == run(SHORT, 3)


def test_steps_can_be_had_again():
    simulation = Simulation(SHORT, 3)
    first, again = ([content(s[0]) for s in simulation.steps()] for _ in range(2))
    assert first == again


def test_another_seed_changes_what_robots_report_but_not_the_world():
    one, two = Simulation(SHORT, 1), Simulation(SHORT, 2)
    np.testing.assert_array_equal(one.landmarks.positions, two.landmarks.positions)
    for a, b in zip(one.steps(), two.steps(), strict=True):
        np.testing.assert_array_equal(a[0].truth.pose, b[0].truth.pose)
        assert (a[0].observations.positions[:3] != b[0].observations.positions[:3]).all()
    assert (a[0].odometry.pose != b[0].odometry.pose).all()


@pytest.mark.parametrize("name", SHORT.names)
def test_a_robot_alone_reports_what_it_does_in_the_team(name):
    assert run(SHORT, 5, only=name) == {name: run(SHORT, 5)[name]}


def test_robots_have_different_noise():
    """Shifted by half the tour, robot 1 drives robot 2's part."""
    first = Simulation(replace(SHORT, robots=2), 0, "robot_2")
    second = Simulation(replace(SHORT, robots=2, start_offset=0.5), 0, "robot_1")
    *_, (one,) = first.steps()
    *_, (two,) = second.steps()
    np.testing.assert_allclose(one.truth.pose, two.truth.pose, atol=1e-9)
    assert (np.abs(one.odometry.pose - two.odometry.pose) > 1e-6).all()


def test_pictures_change_nothing_else():
    seen = replace(SHORT, images=ImageSettings(enabled=True, people=4, read_noise=1.0))
    simulation = Simulation(seen, 3)
    steps = list(simulation.steps())
    assert simulation.renderer.pair(steps[0][0].truth).left.any()
    assert run(seen, 3) == run(SHORT, 3)


def test_a_robot_alone_sees_what_it_does_in_the_team():
    images = ImageSettings(enabled=True, people=3, photon_noise=2.0, gain_difference=0.1)
    seen = replace(SHORT, images=images)
    alone, team = Simulation(seen, 5, only="robot_2"), Simulation(seen, 5)
    (own,), of_team = next(alone.steps()), next(team.steps())
    pairs = [alone.renderer.pair(own.truth), team.renderer.pair(of_team[1].truth)]
    np.testing.assert_array_equal(*map(np.stack, pairs))


def test_without_images_nothing_is_rendered():
    assert Simulation(SHORT, 0).renderer is None


@pytest.mark.parametrize(
    "change", [{"observations": 0}, {"d_max_m": 3.0}, {"descriptor_noise": 0.1}]
)
def test_the_camera_does_not_disturb_the_odometry(change):
    alone = replace(SHORT, robots=1)
    np.testing.assert_array_equal(odometry(alone), odometry(replace(alone, **change)))


@pytest.mark.parametrize("robots", [1, 2, 3])
def test_each_robot_makes_its_share_of_the_movements(robots):
    steps = list(Simulation(replace(SHORT, robots=robots), 0).steps())
    assert len(steps) == 30 // robots + 1
    assert all(len(step) == robots for step in steps)


def test_stamps_start_at_one_second_and_advance_by_the_period():
    stamps = [
        {record.stamp_ns for robot_step in step for record in vars(robot_step).values()}
        for step in Simulation(replace(SHORT, period_s=0.1), 0).steps()
    ]
    assert stamps == [{1_000_000_000 + 100_000_000 * i} for i in range(11)]


def test_the_first_step_is_the_start_and_already_observes():
    simulation = Simulation(SHORT, 0)
    for step, (name, start) in zip(
        next(simulation.steps()), simulation.start_poses.items(), strict=True
    ):
        assert step.odometry.robot == name
        assert not step.odometry.pose.any()
        assert not step.odometry.covariance.any()
        np.testing.assert_array_equal(step.truth.pose, start)
        assert len(step.observations.positions)


def test_the_truth_is_the_true_path():
    simulation = Simulation(SHORT, 0)
    steps = list(simulation.steps())
    for i, name in enumerate(simulation.start_poses):
        path = simulation.truth_path(name)
        np.testing.assert_array_equal([s[i].truth.pose for s in steps], path.poses)
        np.testing.assert_array_equal([s[i].truth.stamp_ns for s in steps], path.stamps_ns)


def test_measured_points_lie_at_the_true_landmarks():
    """Camera frame, mount, pose and map agree: without noise the map is met exactly."""
    sharp = StereoCamera(sigma_rc_px=1e-6, sigma_disparity_px=1e-6)
    simulation = Simulation(replace(SHORT, camera=sharp, descriptor_noise=0.0), 0)
    for step in simulation.steps():
        for robot_step in step:
            seen, rows = robot_step.observations, robot_step.observation_truth.landmarks
            x, y, yaw = robot_step.truth.pose
            right, up, ahead = seen.positions.astype(float).T
            left, up = sharp.mount.left_m - right, sharp.mount.up_m + up
            ahead = ahead + sharp.mount.forward_m
            c, s = np.cos(yaw), np.sin(yaw)
            places = np.column_stack([x + c * ahead - s * left, y + s * ahead + c * left, up])
            true = simulation.landmarks
            np.testing.assert_allclose(places, true.positions[rows], atol=1e-4)
            np.testing.assert_allclose(seen.descriptors, true.descriptors[rows], atol=1e-6)


def test_an_unknown_robot_is_refused():
    with pytest.raises(InputError, match=r"no robot 'robot_4'; the team is robot_1, robot_2"):
        Simulation(SHORT, 0, only="robot_4")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *[("robots", v) for v in (0, 33, 1.5)],
        *[("trajectory", v) for v in ("spiral", 3)],
        *[("start_offset", v) for v in (-0.1, 1.0)],
        *[("movements", v) for v in (0, -5)],
        *[("period_s", v) for v in (0, float("nan"))],
        *[("d_max_m", v) for v in (0, float("inf"))],
        ("observations", -1),
        ("descriptor_noise", -0.01),
        ("landmarks", 0),
        ("world_seed", -1),
        ("speed", 1),
    ],
)
def test_a_bad_value_is_named(key, value):
    with pytest.raises(InputError, match=key):
        scenario_file.from_mapping(Scenario, {key: value})


def test_a_bad_nested_value_is_named():
    with pytest.raises(InputError, match=r"odometry\.yaw_per_sqrt_m = -1"):
        scenario_file.from_mapping(Scenario, {"odometry": {"yaw_per_sqrt_m": -1}})


def test_a_scenario_survives_its_file():
    scenario = Scenario(robots=2, trajectory="ring", camera=StereoCamera(sigma_rc_px=2.0))
    text = scenario_file.to_yaml(sim_world=scenario)
    assert scenario_file.from_yaml(Scenario, text, SECTION) == scenario


@pytest.mark.parametrize(("name", "sigma_rc_px"), [("paper", 10.0), ("calibrated", 1.0)])
def test_scenario_files_have_the_values_of_table_2(name, sigma_rc_px):
    scenario = scenario_file.from_file(Scenario, CONFIG / f"{name}.yaml", SECTION)
    camera = scenario.camera
    assert (camera.sigma_rc_px, camera.sigma_disparity_px) == (sigma_rc_px, 0.1)
    assert (scenario.d_max_m, scenario.observations, scenario.descriptor_noise) == (10, 15, 0.01)
