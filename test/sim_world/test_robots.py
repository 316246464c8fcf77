import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from msg_defs.types import StereoCamera
from multi_robot_slam.config import SECTION as ESTIMATE_SECTION
from multi_robot_slam.config import Config
from sim_world import cli, messages
from sim_world.messages import SIDES
from sim_world.rendering.settings import ImageSettings
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


def play(*arguments, listen_to, count=0):
    """Everything that is published on the topics `listen_to`, by topic; at least `count` of each.

    What the last message is nobody knows when the world is done: it may still be on its way.
    """
    with nodes.ros(*PARAMETERS, *arguments):
        listener = nodes.Listener(*listen_to)
        world = robots.SimWorld()

        def has_all():
            return world.done and all(len(listener.heard[t]) >= count for t in listen_to)

        nodes.spin_until(has_all, world, listener)
        return listener.heard


def test_publishes_exactly_what_the_simulation_makes():
    heard = play("-p", "seed:=4", listen_to=topics_of(*SCENARIO.names), count=21)
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
    alone = play("-p", "only:=robot_2", listen_to=topics_of("robot_2"), count=21)
    team = play(listen_to=topics_of(*SCENARIO.names), count=21)
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


PICTURES = {
    "images.enabled": "true",
    "images.people": "3",
    "images.read_noise": "2.0",
    "camera.width_px": "64",
    "camera.height_px": "48",
    "camera.focal_px": "50.0",
}
WITH_PICTURES = [word for item in PICTURES.items() for word in ("-p", ":=".join(item))]


def play_pictures(*arguments, listen_to):
    """As `play`, with room for all, since a test must not lose any."""
    heard = play(*WITH_PICTURES, *arguments, listen_to=[_roomy(topic) for topic in listen_to])
    return {topic: heard[_roomy(topic)] for topic in listen_to}


def _roomy(topic):
    return topic._replace(qos=topics.STREAM)


def picture_scenario(transport="auto"):
    images = ImageSettings(enabled=True, people=3, read_noise=2.0, transport=transport)
    camera = StereoCamera(focal_px=50.0, width_px=64, height_px=48)
    return replace(SCENARIO, images=images, camera=camera)


def test_pictures_take_the_place_of_landmarks():
    name = "robot_2"
    pictures = [of(name, side) for of in (topics.camera_info, topics.image) for side in SIDES]
    inputs = [topics.odometry(name), topics.ground_truth(name), *pictures]
    heard = play_pictures("-p", "seed:=4", "-p", f"only:={name}", listen_to=inputs)
    simulation = Simulation(picture_scenario(), 4, name)
    say = messages.teller(simulation, "raw")
    said = [dict(say(step)) for (step,) in simulation.steps()]
    assert len(said) == 21
    assert heard == {topic: [one[topic] for one in said] for topic in inputs}
    assert {*said[0]} == {*inputs}


def test_the_pictures_in_messages_are_the_rendered_ones():
    name = "robot_1"
    simulation = Simulation(picture_scenario(), 4, name)
    steps = [step for (step,) in simulation.steps()][:3]
    for transport, topic, decode in (
        ("raw", topics.image, wire.decode_image),
        ("png", topics.compressed_image, wire.decode_compressed),
    ):
        for step in steps:
            said = dict(messages.with_pictures(step, simulation.renderer, transport))
            pair = simulation.renderer.pair(step.truth)
            for side, eye in zip(SIDES, pair, strict=True):
                image = decode(said[topic(name, side)], "picture")
                np.testing.assert_array_equal(image.pixels, eye)
                assert image.encoding == "mono8"
                assert image.stamp_ns == step.truth.stamp_ns
                assert image.frame == topics.camera_frame(name)


def test_the_chosen_transport_is_published():
    compressed = [topics.compressed_image("robot_1", side) for side in SIDES]
    arguments = ("-p", "images.transport:=jpeg", "-p", "only:=robot_1")
    heard = play_pictures(*arguments, listen_to=[*compressed, topics.odometry("robot_1"), *INFOS])
    for topic in compressed:
        pictures = [wire.decode_compressed(data, "picture") for data in heard[topic]]
        assert [picture.pixels.shape for picture in pictures] == [(48, 64)] * 21


INFOS = [topics.camera_info("robot_1", side) for side in SIDES]


def test_waits_for_subscribers_of_pictures():
    """A camera's subscriber takes what it can get: that it is there is enough."""
    odometry = [topics.odometry("robot_1")]
    pictures = [topics.image("robot_1", side) for side in SIDES]
    with nodes.ros(*PARAMETERS, *WITH_PICTURES, "-p", "only:=robot_1"):
        world, first = robots.SimWorld(), nodes.Listener(*odometry)
        nodes.spin_until(first.is_connected, world, first)
        nodes.spin_until(nodes.rounds(50), world, first)
        assert not any(first.heard.values())
        second = nodes.Listener(*pictures, *INFOS, name="second")
        nodes.spin_until(lambda: world.done, world, first, second)
        assert len(first.heard[odometry[0]]) == 21
    with nodes.ros(*PARAMETERS, *WITH_PICTURES, "-p", "image_subscribers:=0"):
        world, alone = robots.SimWorld(), nodes.Listener(*map(topics.odometry, SCENARIO.names))
        nodes.spin_until(lambda: world.done, world, alone)


def best_effort(topic):
    return "-p", f"qos_overrides./{topic.name}.subscription.reliability:=best_effort"


def test_pictures_of_a_whole_team_at_once_reach_who_reads_with_best_effort(spawn):
    """They go through memory that processes share: it must hold them until they are read."""
    pictures = [topics.image(name, side) for name in SCENARIO.names for side in SIDES]
    infos = [topics.camera_info(name, side) for name in SCENARIO.names for side in SIDES]
    parameters = ("images.enabled:=true", "movements:=9", "speed:=0.0")
    words = [word for parameter in parameters for word in ("-p", parameter)]
    spawn(sys.executable, "-m", "sim_world.robots", "--ros-args", *words)
    with nodes.ros(*(word for topic in pictures + infos for word in best_effort(topic))):
        camera = nodes.Listener(*pictures, *infos)
        nodes.spin_until(camera.is_connected, camera)
        fusion = nodes.Listener(*map(topics.odometry, SCENARIO.names), name="fusion")
        heard = [*camera.heard.values(), *fusion.heard.values()]
        nodes.spin_until(lambda: all(len(one) == 4 for one in heard), camera, fusion)


def test_true_landmarks_are_not_published_beside_pictures():
    with nodes.ros(*PARAMETERS, *WITH_PICTURES):
        world = robots.SimWorld()
        nodes.spin_until(nodes.rounds(20), world)
        published = {name for name, _ in world.get_topic_names_and_types()}
    absent = [topics.GROUND_TRUTH_LANDMARKS, topics.observations("robot_1")]
    absent.append(topics.observation_truth("robot_1"))
    assert not {f"/{topic.name}" for topic in absent} & published
    assert f"/{topics.GROUND_TRUTH_WALLS.name}" in published


def test_cameras_that_cannot_be_rendered_end_the_node():
    arguments = ("-p", "images.enabled:=true", "-p", "camera.mount.pitch_rad:=0.2")
    with nodes.ros(*PARAMETERS, *arguments), pytest.raises(InputError, match=r"pitch_rad = 0\.2"):
        robots.SimWorld()


class Said:
    """In place of a publisher whose type is not installed: what it was given."""

    def __init__(self):
        self.data = []
        self.publish = self.data.append

    def get_subscription_count(self):
        return 0

    def wait_for_all_acked(self, _):
        return True


@pytest.mark.parametrize("wanted", [True, False])
def test_transforms_go_with_the_odometry(monkeypatch, wanted):
    """As where tf2_msgs is installed."""
    said = {}

    def publisher(node, topic):
        if topic.type == topics.TF.type:
            return said.setdefault((node.get_name(), topic), Said())
        return actual(node, topic)

    actual = robots.publisher
    monkeypatch.setattr(robots, "publisher", publisher)
    monkeypatch.setattr(robots, "is_available", lambda topic: True)
    given = ("-p", "subscribers:=0", "-p", f"publish_tf:={str(wanted).lower()}")
    with nodes.ros(*PARAMETERS, *given):
        world = robots.SimWorld()
        nodes.spin_until(lambda: world.done, world)
    if not wanted:
        assert said == {}
        return
    simulation = Simulation(SCENARIO, 0)
    for place, name in enumerate(SCENARIO.names):
        frames = topics.odom_frame(name), topics.base_frame(name)
        expected = [
            wire.encode_transform(s[place].odometry.stamp_ns, *frames, s[place].odometry.pose)
            for s in Simulation(SCENARIO, 0).steps()
        ]
        assert said[name, topics.TF].data == expected
    (static,) = said["sim_world", topics.TF_STATIC].data
    assert static == messages.camera_transforms(simulation)[1]
    assert len(said) == len(SCENARIO.names) + 1


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
