"""`sim_world generate`: a bag of a simulated team without ROS."""

import json
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import recordings

from msg_defs import scenario_file, topics, wire
from multi_robot_slam import runs
from multi_robot_slam.bags import BagReader
from multi_robot_slam.config import SECTION, Config
from sim_world import cli, messages, trajectories
from sim_world.scenario import SECTION as WORLD_SECTION
from sim_world.scenario import Scenario
from sim_world.simulator import Simulation
from sim_world.team import team_scenario

SMALL = """
sim_world: {robots: 2, movements: 40, observations: 5, camera: {mount: {up_m: 0.7}}}
multi_robot_slam: {filter: {particles: 20}}
"""


@pytest.fixture
def generate(program, tmp_path):
    """Make a bag of the small team: `generate(option, ...) -> bag`."""
    (tmp_path / "small.yaml").write_text(SMALL)

    def make(*words, name="bag"):
        options = ("--scenario", tmp_path / "small.yaml", "--out", tmp_path / name, *words)
        code, out, err = program(cli, "generate", *options)
        assert (code, out, err) == (0, f"Now: multi_robot_slam run {tmp_path / name}\n", "")
        return tmp_path / name

    return make


def test_the_bag_is_all_that_a_run_needs(generate, command, tmp_path):
    bag = generate("--seed", "3")
    assert BagReader(bag).warnings == []
    assert command("run", bag, "--out", tmp_path / "out")[0] == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert (result["steps"], result["seed"], result["particles"]) == (21, 3, 20)
    assert result["path_rmse_m"] < 1
    assert result["map_rmse_m"] < 1
    assert result["association_recall"] is not None
    recorded = runs.recorded(bag, ("robot_1", "robot_2"))
    assert len(recorded.walls.segments) > 50


def test_messages_are_those_the_robots_publish_at_their_stamps(generate):
    bag = generate("--seed", "3")
    world = scenario_file.from_yaml(Scenario, SMALL, WORLD_SECTION)
    expected = [
        (f"/{topic.name}", step[0].odometry.stamp_ns, data)
        for step in Simulation(world, 3).steps()
        for topic, data in recordings.messages_of(step)
    ]
    of_world, of_steps = (lambda r: r[:4], lambda r: r[4:])
    written = [(record.topic, record.stamp_ns, record.data) for record in BagReader(bag)]
    assert of_steps(written) == expected
    latched = {
        *(topics.GROUND_TRUTH_LANDMARKS, topics.GROUND_TRUTH_WALLS),
        *(topics.WORLD_CONFIG, topics.FUSION_CONFIG),
    }
    assert {topic for topic, *_ in of_world(written)} == {f"/{topic.name}" for topic in latched}
    summary = BagReader(bag).summary
    assert {t for t in summary.topics if t.qos == topics.LATCHED} == {
        topic._replace(name=f"/{topic.name}") for topic in latched
    }


def configurations(bag):
    """World and fusion, as the bag says they were."""
    texts = {t: wire.decode_text(d) for t, d in BagReader(bag).only(CONFIGURATIONS)}
    return (
        scenario_file.from_yaml(Scenario, texts[topics.WORLD_CONFIG], WORLD_SECTION),
        scenario_file.from_yaml(Config, texts[topics.FUSION_CONFIG], SECTION),
    )


CONFIGURATIONS = (topics.WORLD_CONFIG, topics.FUSION_CONFIG)


def test_options_replace_what_the_scenario_says(generate):
    world, config = configurations(
        generate("--robots", "3", "--seed", "4", "--rate", "8", "--laps", "2")
    )
    given = scenario_file.from_yaml(Scenario, SMALL, WORLD_SECTION)
    changed = {"robots": 3, "laps": 2, "period_s": 0.125, "movements": 160}
    assert world == replace(given, **changed)
    assert config.robots == ("robot_1", "robot_2", "robot_3")
    assert config.start_poses[2] == tuple(Simulation(world, 0).start_poses["robot_3"])
    assert (config.seed, config.filter.particles) == (4, 20)
    assert config.mount.up_m == 0.7


def test_the_robots_of_32_are_all_in_the_bag(generate):
    bag = generate("--robots", "32", "--laps", "2")
    _, config = configurations(bag)
    assert len(config.robots) == 32
    names = {topic.name for topic in BagReader(bag).summary.topics}
    assert {f"/{topics.odometry(robot).name}" for robot in config.robots} < names


def test_a_lap_takes_as_long_at_any_rate_and_goes_the_same_way(generate, tmp_path):
    paths = []
    for rate in (2, 10):
        text = team_scenario(str(tmp_path / "small.yaml"), rate_hz=rate)
        simulation = Simulation(scenario_file.from_yaml(Scenario, text, WORLD_SECTION), 0)
        paths.append(simulation.truth_path("robot_2"))
    slow, fast = paths
    assert fast.stamps_ns[-1] == slow.stamps_ns[-1]
    np.testing.assert_array_equal(fast.stamps_ns[::5], slow.stamps_ns)
    np.testing.assert_allclose(fast.poses[::5], slow.poses, atol=1e-9)


@pytest.fixture(scope="module")
def laps():
    """One lap and five of the same team."""
    return [
        Simulation(Scenario(robots=3, movements=30, observations=3, laps=laps), 1)
        for laps in (1, 5)
    ]


def test_after_a_lap_the_tour_goes_on_where_the_next_robot_began(laps):
    one, five = laps
    for index, name in enumerate(one.scenario.names):
        own, path = one.truth_path(name).poses, five.truth_path(name).poses
        following = one.truth_path(one.scenario.names[(index + 1) % 3]).poses
        assert len(path) == five.instants == 51
        np.testing.assert_array_equal(path[:11], own)
        np.testing.assert_allclose(path[10], following[0], atol=1e-9)
        np.testing.assert_array_equal(path[11:21], following[1:])
        np.testing.assert_array_equal(path[31:], path[1:21])


def test_odometry_goes_on_drifting_from_lap_to_lap(laps):
    one, five = (list(simulation.steps()) for simulation in laps)
    for first, again in zip(one, five[:11], strict=True):
        assert [s.odometry.pose.tolist() for s in first] == [
            s.odometry.pose.tolist() for s in again
        ]
    spread = [step[0].odometry.covariance[2, 2] for step in five]
    assert (np.diff(spread) > 0).all()
    moved = np.diff([step[0].odometry.pose for step in five], axis=0)
    assert not np.allclose(moved[1:11], moved[31:41], atol=1e-6)


def test_a_drive_of_a_year_is_not_made_before_it_is_driven():
    parts = trajectories.poses("ring", 3, 450)
    drive = trajectories.Drive(parts, 1, laps=1_000_000)
    assert len(drive) == 150_000_001
    begin = np.array([*islice(drive, 301)])
    np.testing.assert_array_equal(begin[:151], parts[1])


WITH_PICTURES = SMALL.replace(
    "observations: 5, camera: {", "camera: {width_px: 64, height_px: 48, focal_px: 50, "
).replace("movements: 40", "movements: 6")


def test_images_take_the_place_of_landmarks(generate, tmp_path):
    (tmp_path / "small.yaml").write_text(WITH_PICTURES)
    bag = generate("--images", "--seed", "3")
    world, config = configurations(bag)
    assert world.images.enabled
    simulation = Simulation(world, 3)
    say = messages.teller(simulation, "png")
    expected = [
        (f"/{topic.name}", step.odometry.stamp_ns, data)
        for instant in simulation.steps()
        for step in instant
        for topic, data in say(step)
    ]
    written = [(record.topic, record.stamp_ns, record.data) for record in BagReader(bag)]
    assert written[3:] == expected
    latched = {topics.GROUND_TRUTH_WALLS, topics.WORLD_CONFIG, topics.FUSION_CONFIG}
    assert {topic for topic, *_ in written[:3]} == {f"/{topic.name}" for topic in latched}
    kinds = (topics.odometry, topics.ground_truth)
    names = {f"/{kind(robot).name}" for robot in config.robots for kind in kinds}
    for robot in config.robots:
        for side in messages.SIDES:
            names |= {f"/{robot}/{side}/camera_info", f"/{robot}/{side}/image_rect/compressed"}
    assert {topic for topic, *_ in written[3:]} == names


def test_the_same_seed_writes_the_same_pictures(generate, tmp_path):
    scenario = WITH_PICTURES.replace(
        "sim_world: {", "sim_world: {images: {enabled: true, read_noise: 2.0, people: 2}, "
    )
    (tmp_path / "small.yaml").write_text(scenario)
    bags = [generate("--seed", "3", name=name) for name in ("one", "two")]
    one, two = (list(BagReader(bag)) for bag in bags)
    assert one == two


def test_raw_pictures_are_written_where_the_scenario_says_so(generate, tmp_path):
    scenario = WITH_PICTURES.replace("sim_world: {", "sim_world: {images: {transport: raw}, ")
    (tmp_path / "small.yaml").write_text(scenario)
    types = {topic.type for topic in BagReader(generate("--images")).summary.topics}
    assert "sensor_msgs/msg/Image" in types
    assert "sensor_msgs/msg/CompressedImage" not in types


def test_a_camera_that_cannot_be_rendered_is_refused_and_leaves_nothing(program, tmp_path):
    scenario = tmp_path / "tilted.yaml"
    scenario.write_text("sim_world: {camera: {mount: {roll_rad: 0.1}}}")
    options = ("--images", "--scenario", scenario, "--out", tmp_path / "bag")
    code, _, err = program(cli, "generate", *options)
    assert (code, err.count("\n")) == (2, 1)
    assert "camera.mount.roll_rad = 0.1" in err
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--robots", "33"), "--robots"),
        (("--laps", "0"), "--laps"),
        (("--rate", "0"), "--rate"),
        (("--scenario", "nowhere"), "no scenario 'nowhere'"),
        (("--robots", "32", "--rate", "0.01"), "give at least one movement per robot"),
    ],
)
def test_what_cannot_be_simulated_is_refused_and_leaves_nothing(program, tmp_path, words, told):
    code, _, err = program(cli, "generate", "--out", tmp_path / "bag", *words)
    assert code == 2
    assert told in err
    assert not (tmp_path / "bag").exists()


def test_an_existing_bag_is_kept(program, tmp_path):
    (tmp_path / "bag").mkdir()
    code, _, err = program(cli, "generate", "--out", tmp_path / "bag")
    assert (code, err.count("\n")) == (2, 1)
    assert "exists already" in err
