import signal
import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from multi_robot_slam.config import SECTION as ESTIMATE_SECTION
from multi_robot_slam.config import Config
from sim_world import cli
from sim_world.scenario import SECTION, Scenario
from sim_world.simulator import Simulation

nodes = pytest.importorskip("nodes")
robots = pytest.importorskip("sim_world.robots")

pytestmark = pytest.mark.usefixtures("ros_domain_id")

SCENARIO = Scenario(robots=3, movements=60, observations=5)
PARAMETERS = ("-p", "robots:=3", "-p", "movements:=60", "-p", "observations:=5", "-p", "speed:=0.0")
OF_EACH = (topics.odometry, topics.observations, topics.ground_truth, topics.observation_truth)


def topics_of(*names):
    return [topic(name) for name in names for topic in OF_EACH]


def play(*arguments, listen_to):
    """Everything that is published on the topics `listen_to`, by topic."""
    with nodes.ros(*PARAMETERS, *arguments):
        listener = nodes.Listener(*listen_to)
        world = robots.SimWorld()
        nodes.spin_until(lambda: world.done, world, listener)
        return listener.heard


def test_publishes_exactly_what_the_simulation_makes():
    heard = play("-p", "seed:=4", listen_to=topics_of(*SCENARIO.names))
    steps = list(Simulation(SCENARIO, seed=4).steps())
    assert len(steps) == 21
    for index, name in enumerate(SCENARIO.names):
        of_robot = [step[index] for step in steps]
        odom, base = topics.odom_frame(name), topics.base_frame(name)
        assert heard[topics.odometry(name)] == [
            wire.encode_pose(step.odometry, odom, base) for step in of_robot
        ]
        assert heard[topics.ground_truth(name)] == [
            wire.encode_pose(step.truth, topics.MAP_FRAME, base) for step in of_robot
        ]
        assert heard[topics.observations(name)] == [
            wire.encode_observations(step.observations) for step in of_robot
        ]
        assert heard[topics.observation_truth(name)] == [
            wire.encode_observation_truth(step.observation_truth) for step in of_robot
        ]


def test_a_robot_alone_says_what_it_says_in_the_team():
    alone = play("-p", "only:=robot_2", listen_to=topics_of("robot_2"))
    team = play(listen_to=topics_of(*SCENARIO.names))
    assert len(alone[topics.odometry("robot_2")]) == 21
    assert alone == {topic: team[topic] for topic in alone}


def test_the_world_is_latched():
    world = (topics.GROUND_TRUTH_LANDMARKS, topics.GROUND_TRUTH_WALLS, topics.WORLD_CONFIG)
    with nodes.ros(*PARAMETERS, "-p", "seed:=4"):
        simulated = robots.SimWorld()
        late = nodes.Listener(*world)
        nodes.spin_until(lambda: all(late.heard.values()), late, simulated)
    simulation = Simulation(SCENARIO, seed=4)
    (landmarks,), (walls,), (config,) = late.heard.values()
    positions = wire.decode_map(landmarks).positions
    np.testing.assert_array_equal(positions, simulation.landmarks.positions)
    np.testing.assert_array_equal(wire.decode_walls(walls).segments, simulation.walls.segments)
    text = wire.decode_text(config)
    assert scenario_file.from_yaml(Scenario, text, SECTION) == SCENARIO
    assert "seed: 4" in text


def test_works_under_a_namespace():
    with nodes.ros(*PARAMETERS, "-r", "__ns:=/team"):
        world = robots.SimWorld()
        published = {name for name, _ in world.get_topic_names_and_types()}
    expected = [*topics_of(*SCENARIO.names), topics.WORLD_CONFIG]
    assert {f"/team/{topic.name}" for topic in expected} <= published


def test_waits_until_every_topic_has_its_subscribers():
    inputs, truths = topics_of("robot_1")[:2], topics_of("robot_1")[2:]
    arguments = ("-p", "only:=robot_1", "-p", "truth_subscribers:=1")
    with nodes.ros(*PARAMETERS, *arguments):
        world, first = robots.SimWorld(), nodes.Listener(*inputs)
        nodes.spin_until(first.is_connected, world, first)
        nodes.spin_until(nodes.rounds(50), world, first)
        assert not any(first.heard.values())
        second = nodes.Listener(*truths, name="second")
        nodes.spin_until(lambda: world.done, world, first, second)
        assert {len(messages) for messages in (first.heard | second.heard).values()} == {21}


def test_starts_without_subscribers_when_the_wait_is_over():
    with nodes.ros(*PARAMETERS, "-p", "wait_s:=0.2"):
        world = robots.SimWorld()
        nodes.spin_until(lambda: world.done, world)


def test_pace_follows_the_speed():
    """20 periods of 0.5 s."""
    for speed in (20.0, 0.5):
        with nodes.ros(*PARAMETERS[:-1], f"speed:={speed}", "-p", "subscribers:=0"):
            assert nodes.seconds_taken(robots.SimWorld) == pytest.approx(10 / speed, abs=0.1)


def test_unknown_robot_is_refused():
    with nodes.ros("-p", "only:=robot_9"), pytest.raises(InputError, match="robot_9"):
        robots.SimWorld()


def test_interrupt_ends_the_process(spawn):
    process = spawn(sys.executable, "-m", "sim_world.robots", stderr=subprocess.PIPE, text=True)
    nodes.wait_for_line(process, "waiting for subscribers of /robot_1/odom")
    process.send_signal(signal.SIGINT)
    assert process.wait(nodes.PATIENCE_S) == 0


def test_team_gives_every_node_the_same_team():
    printed = CliRunner().invoke(cli.app, ["team", "--scenario", "paper", "--robots", "2"]).stdout
    world = scenario_file.from_yaml(Scenario, printed, SECTION)
    config = scenario_file.from_yaml(Config, printed, ESTIMATE_SECTION)
    starts = Simulation(world, seed=0).start_poses
    assert config.robots == tuple(starts) == ("robot_1", "robot_2")
    np.testing.assert_array_equal(config.start_poses, list(starts.values()))
    assert config.mount == world.camera.mount
