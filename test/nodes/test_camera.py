"""The camera node: the bytes of `landmarks`, never late, and never silent about why."""

import signal
import subprocess
import sys
import threading
from dataclasses import replace

import numpy as np
import pictures
import pytest

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from multi_robot_slam.bags import BagReader
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.front_end.front_end import FrontEnd
from multi_robot_slam.pipeline import landmarks

nodes = pytest.importorskip("nodes")
camera = pytest.importorskip("multi_robot_slam.nodes.camera")

pytestmark = pytest.mark.usefixtures("ros_domain_id")

OUTPUTS = [
    topics.observations("robot_1"),
    topics.preview("robot_1"),
    topics.preview_info("robot_1"),
]
LEFT, RIGHT = (topics.image("robot_1", side) for side in ("left", "right"))
RELIABLY = [
    f"qos_overrides./{topic.name}.subscription.reliability:=reliable"
    for topic in (LEFT, RIGHT, *(topics.camera_info("robot_1", side) for side in ("left", "right")))
]


@pytest.fixture
def parameters(tmp_path):
    """ROS arguments: one robot, its camera, and pictures that are read reliably."""

    def of(config=None, *more, reliably=True):
        scenario = tmp_path / "scenario.yaml"
        scenario.write_text(scenario_file.to_yaml(**{SECTION: config or pictures.team()}))
        given = [f"scenario:={scenario}", *(RELIABLY if reliably else []), *more]
        return [word for parameter in given for word in ("-p", parameter)]

    return of


def reliable(topic):
    return topic._replace(qos=topics.STREAM)


def sent_to(node, listener, messages):
    """Send messages, and wait until all pairs of them were decided upon and looked at."""
    listener.send([(reliable(topic), data) for _, topic, data in messages])
    count = node.received + len(messages)
    nodes.spin_until(lambda: node.received >= count and is_idle(node), node, listener)


def is_idle(node):
    return node._job is None and not node._waiting


def statuses(listener):
    found = [wire.decode_diagnostics(d)[1] for d in listener.heard[topics.DIAGNOSTICS]]
    return [status for one in found for status in one]


def by_step(messages):
    """The messages of each stamp."""
    steps = {}
    for message in messages:
        steps.setdefault(message[0], []).append(message)
    return list(steps.values())


def test_it_publishes_what_landmarks_writes(parameters, tmp_path):
    config = pictures.record(tmp_path / "bag")
    landmarks.write(tmp_path / "bag", tmp_path / "out", config, pytest.fail)
    expected = BagReader(tmp_path / "out").by_topic(OUTPUTS)
    with nodes.ros(*parameters()):
        node, listener = camera.CameraNode(), nodes.Listener(*OUTPUTS)
        for step in by_step(pictures.drive()):
            sent_to(node, listener, step)
        wanted = len(expected[OUTPUTS[0]])
        nodes.spin_until(lambda: all(len(h) == wanted for h in listener.heard.values()), listener)
        node.close()
    assert wanted == 4
    for topic in OUTPUTS:
        assert [data.rstrip(b"\0") for data in listener.heard[topic]] == [
            data.rstrip(b"\0") for data in expected[topic]
        ]


def test_while_a_pair_is_looked_at_the_newest_waits_and_the_others_are_dropped(
    parameters, monkeypatch
):
    go_on, right = threading.Event(), camera.see

    def slowly(look, config):
        go_on.wait(nodes.PATIENCE_S)
        return right(look, config)

    monkeypatch.setattr(camera, "see", slowly)
    messages = [m for m in pictures.drive(steps=8) if m[1] != topics.odometry("robot_1")]
    with nodes.ros(*parameters()):
        node, listener = camera.CameraNode(), nodes.Listener(*OUTPUTS)
        for some in (messages[:4], messages[4:]):
            count = node.received + len(some)
            listener.send([(reliable(topic), data) for _, topic, data in some])
            nodes.spin_until(lambda c=count: node.received >= c and node._job, node, listener)
        go_on.set()
        clouds = listener.heard[OUTPUTS[0]]
        nodes.spin_until(lambda: len(clouds) == 2 and is_idle(node), node, listener)
        stamps = [wire.decode_observations(data, "robot_1").stamp_ns for data in clouds]
        dropped = node._health["robot_1"].dropped
        node.close()
    assert stamps == [messages[0][0], messages[-1][0]]
    assert dropped == 6


def told(arguments, messages, condition):
    """The first diagnostics of the robot that meet a `condition`, when `messages` were sent."""
    with nodes.ros(*arguments):
        node, listener = camera.CameraNode(), nodes.Listener(topics.DIAGNOSTICS)
        listener.send([(reliable(topic), data) for _, topic, data in messages])
        nodes.spin_until(lambda: any(map(condition, statuses(listener))), node, listener)
        node.close()
    return next(filter(condition, statuses(listener)))


SOON = ("silent_s:=0.5", "unheard_s:=0.5")


def test_all_is_well(parameters):
    messages = next(iter(by_step(pictures.drive())))
    status = told(parameters(), messages, lambda s: s.level == wire.OK)
    assert (status.name, status.message, status.hardware_id) == (
        "camera: robot_1",
        "running",
        "robot_1",
    )
    assert status.values["pairs"] == status.values["looked at"] == "1"
    assert int(status.values["features"]) >= int(status.values["matches"]) > 40
    assert status.values["observations"] == "40"
    assert float(status.values["duration [ms]"]) > 0


@pytest.mark.parametrize(
    ("left_out", "words"),
    [
        ("robot_1/right/camera_info", "nothing heard on /robot_1/right/camera_info"),
        ("robot_1/right/image_rect", "nothing heard on /robot_1/right/image_rect"),
    ],
)
def test_a_topic_that_is_never_heard_is_told(parameters, left_out, words):
    messages = [m for m in pictures.drive(steps=2) if m[1].name != left_out]
    status = told(parameters(None, *SOON), messages, lambda s: s.level == wire.ERROR)
    assert words in status.message


def test_stamps_that_never_agree_are_an_error_with_the_remedy(parameters):
    messages = []
    for stamp, topic, data in pictures.drive(steps=4):
        if topic == RIGHT:
            shown = wire.decode_image(data, "right")
            data = wire.encode_image(replace(shown, stamp_ns=stamp + 3_000_000))
        messages.append((stamp, topic, data))
    ask = parameters(None, "silent_s:=1000.0")

    with nodes.ros(*ask):
        node, listener = camera.CameraNode(), nodes.Listener(topics.DIAGNOSTICS)
        listener.send([(reliable(topic), data) for _, topic, data in messages])
        nodes.spin_until(lambda: node.received >= len(messages), node, listener)
        health = node._health["robot_1"]
        health._silent_s, health._clock = 5.0, lambda: max(health._heard_s.values()) + 4.0
        health._began_s = health._clock() - 100
        status = health.status([])
        line = health.news(status)
        node.close()
    assert status.level == wire.ERROR
    assert "left and right never match: the nearest of the other camera is 3.000 ms off" in line
    assert "camera.approx_sync: true" in line
    assert health.news(status) == ""


def test_stamps_that_nearly_agree_are_pairs_if_that_is_wanted(parameters):
    messages = []
    for stamp, topic, data in pictures.drive(steps=1):
        if topic == RIGHT:
            shown = wire.decode_image(data, "right")
            data = wire.encode_image(replace(shown, stamp_ns=stamp + 3_000_000))
        messages.append((stamp, topic, data))
    with nodes.ros(*parameters(None, "camera.approx_sync:=true")):
        node, listener = camera.CameraNode(), nodes.Listener(*OUTPUTS)
        sent_to(node, listener, messages)
        nodes.spin_until(lambda: listener.heard[OUTPUTS[0]], listener)
        node.close()
    (cloud,) = listener.heard[OUTPUTS[0]]
    assert wire.decode_observations(cloud, "robot_1").stamp_ns == pictures.START_NS


def test_no_baseline_is_an_error_and_a_calibration_that_has_one_is_taken_over(parameters):
    first, second = by_step(pictures.drive(steps=6, step_m=0.5))[:2]
    bad = [
        (stamp, topic, wire.encode_camera_info(pictures.info("right", stamp, baseline_m=0.0)))
        if topic == topics.camera_info("robot_1", "right")
        else (stamp, topic, data)
        for stamp, topic, data in first
    ]
    with nodes.ros(*parameters()):
        node, listener = camera.CameraNode(), nodes.Listener(*OUTPUTS, topics.DIAGNOSTICS)
        sent_to(node, listener, bad)
        nodes.spin_until(lambda: statuses(listener), node, listener)
        assert statuses(listener)[-1].level == wire.ERROR
        assert "baseline" in statuses(listener)[-1].message
        assert listener.heard[OUTPUTS[0]] == []
        sent_to(node, listener, second)
        nodes.spin_until(lambda: statuses(listener)[-1].level == wire.OK, node, listener)
        node.close()
    assert statuses(listener)[-1].values["refused: calibration of robot_1"] == "1"
    assert statuses(listener)[-1].values["changes of calibration"] == "1"


@pytest.mark.parametrize("shade", [0, 255])
def test_pictures_that_show_nothing_are_a_warning_and_an_empty_cloud(parameters, shade):
    messages = [
        (stamp, topic, wire.encode_image(pictures.image(np.full((160, 240), shade, "u1"), stamp)))
        if topic in (LEFT, RIGHT)
        else (stamp, topic, data)
        for stamp, topic, data in pictures.drive(steps=1)
    ]
    status = told(parameters(), messages, lambda s: s.values["looked at"] == "1")
    assert status.level == wire.WARN
    assert "few points: 0 of" in status.message


def test_best_effort_pictures_are_heard(parameters):
    messages = list(pictures.drive(steps=3))
    with nodes.ros(*parameters(reliably=False)):
        node, listener = camera.CameraNode(), nodes.Listener(*OUTPUTS)

        def seen():
            if not listener.heard[OUTPUTS[0]]:
                listener.send([(topic, data) for _, topic, data in messages])
            return listener.heard[OUTPUTS[0]]

        nodes.spin_until(seen, node, listener)
        node.close()


def test_compressed_pictures_under_a_namespace(parameters):
    config = pictures.team(camera=replace(pictures.SETTINGS, image_transport="compressed"))
    arguments = [*parameters(config, reliably=False), "-r", "__ns:=/fleet"]
    with nodes.ros(*arguments):
        node, listener = camera.CameraNode(), nodes.Listener(*OUTPUTS)
        sent_to(node, listener, list(pictures.drive(steps=1, compressed=True)))
        nodes.spin_until(lambda: listener.heard[OUTPUTS[0]], listener)
        node.close()


def test_one_robot_of_the_team_alone(parameters):
    config = pictures.team(3)
    with nodes.ros(*parameters(config, "only:=robot_2", reliably=False)):
        names = {reader.topic_name for reader in camera.CameraNode().subscriptions}
    pictured = {name.split("/")[1] for name in names if "image_rect" in name}
    assert pictured == {"robot_2"}
    stranger = parameters(config, "only:=robot_9", reliably=False)
    with nodes.ros(*stranger), pytest.raises(InputError, match="only: no robot 'robot_9'"):
        camera.CameraNode()


def test_interrupt_ends_the_process(spawn):
    process = spawn(sys.executable, "-m", camera.__name__, stderr=subprocess.PIPE, text=True)
    nodes.wait_for_line(process, "other machines are not heard")
    process.send_signal(signal.SIGINT)
    assert process.wait(nodes.PATIENCE_S) == 0


def test_warming_up_compiles_for_pictures_that_cannot_be_written_as_well(monkeypatch):
    """As they come from the wire; else the first pair waits, and those after it are lost."""
    looked_at = []
    monkeypatch.setattr(FrontEnd, "observe", lambda self, *pair: looked_at.append(writable(pair)))
    camera._warm_up(Config())
    assert looked_at == [{True}, {False}]


def writable(pictures):
    return {bool(picture.flags.writeable) for picture in pictures}
