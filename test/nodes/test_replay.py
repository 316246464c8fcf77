"""What was recorded is said again: the same bytes, on the same topics, at the same pace."""

import itertools
import signal
import subprocess
import sys
import time

import bad_bags
import numpy as np
import pytest
import recordings

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from msg_defs.topics import LATCHED, STREAM, Topic
from multi_robot_slam.bags import BagReader, BagWriter, absolute, playback
from multi_robot_slam.config import SECTION
from multi_robot_slam.pipeline import offline
from multi_robot_slam.pipeline.pipeline import Pipeline
from sim_world.robot import START_NS

nodes = pytest.importorskip("nodes")
replay = pytest.importorskip("multi_robot_slam.nodes.replay")
fusion = pytest.importorskip("multi_robot_slam.nodes.fusion")
SetBool = pytest.importorskip("std_srvs.srv").SetBool
deserialize_message = pytest.importorskip("rclpy.serialization").deserialize_message

pytestmark = pytest.mark.usefixtures("ros_domain_id")

ROBOTS = ("robot_1", "robot_2")
INPUTS = (topics.odometry, topics.observations, topics.ground_truth, topics.observation_truth)
SENT = [kind(name) for name in ROBOTS for kind in INPUTS]
WORLD = [topics.GROUND_TRUTH_LANDMARKS, topics.GROUND_TRUTH_WALLS]
STEPS = 21


@pytest.fixture(autouse=True)
def _signal_handlers():
    """Commands run in this process leave it as they found it."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A bag with a live run in it, and what the fusion was told."""
    folder = tmp_path_factory.mktemp("bags") / "live"
    _, config = recordings.record(folder, is_live=True)
    return folder, config


@pytest.fixture
def bag(recorded):
    return recorded[0]


def by_topic(bag):
    found = {}
    for record in BagReader(bag):
        found.setdefault(record.topic, []).append(record.data)
    return found


def parameters(bag, *given):
    """ROS arguments for a replay; nobody is waited for, unless something else is given."""
    named = f"bag:={bag}", "subscribers:=0", "rate:=0.0", *given
    return [word for parameter in named for word in ("-p", f"replay:{parameter}")]


def play(bag, *given, listen_to, whole=(), clock=time.monotonic):
    """What a replay says on the topics `listen_to`, by topic: of `whole` all that the bag has."""
    with nodes.ros(*parameters(bag, *given)):
        listener = nodes.Listener(*listen_to)
        node = replay.Replay(clock)
        outputs = {p.topic_name: p for p in node._outputs.values()}
        for topic in listen_to:
            if publisher := outputs.get(absolute(topic.name)):
                nodes.wait_until(lambda p=publisher: p.get_subscription_count() > 0)
        replayed = [listener.readers[t] for t in listen_to if absolute(t.name) in outputs]
        nodes.wait_until(lambda: all(reader.is_matched for reader in replayed))
        count = {topic: len(by_topic(bag)[absolute(topic.name)]) for topic in whole}
        no_more_comes = nodes.rounds(200)

        def is_all_heard():
            if not node.done:
                return False
            node.work = lambda: 0.0
            heard = all(len(listener.heard[topic]) >= n for topic, n in count.items())
            return heard and no_more_comes()

        nodes.spin_until(is_all_heard, node, listener)
        return listener.heard


def test_says_what_was_recorded_but_not_what_the_fusion_made_of_it(bag):
    outputs = topics.fusion_outputs(ROBOTS)
    silent = filter(nodes.endpoints.is_available, outputs)
    heard = play(bag, listen_to=[*SENT, *WORLD, *silent], whole=[*SENT, *WORLD])
    expected = by_topic(bag)
    for topic in [*SENT, *WORLD]:
        assert heard[topic] == expected[absolute(topic.name)] != []
    assert not any(heard.get(topic) for topic in outputs)


def test_says_everything_if_asked_to(bag):
    outputs = [t for t in topics.fusion_outputs(ROBOTS) if absolute(t.name) in by_topic(bag)]
    heard = play(bag, "everything:=true", listen_to=[*SENT, *outputs], whole=[*SENT, *outputs])
    assert len(outputs) == 9
    for topic in [*SENT, *outputs]:
        assert heard[topic] == by_topic(bag)[absolute(topic.name)]


def test_offers_the_recorded_quality_of_service(bag):
    with nodes.ros(*parameters(bag, "everything:=true")):
        node = replay.Replay()
        late = nodes.Listener(*WORLD, topics.FUSION_CONFIG)
        nodes.spin_until(lambda: node.done, node)
        nodes.spin_until(lambda: all(late.heard.values()), late, node)
    kinds = {topic.name: topic.qos for topic in BagReader(bag).summary.topics}
    assert kinds["/robot_1/odom"] == STREAM
    assert kinds["/robot_1/path"] == kinds["/map/landmarks"] == LATCHED


def test_clock_goes_through_the_recording(bag):
    (first_ns, last_ns), hz = BagReader(bag).summary.span_ns, 4.0
    passing = itertools.count(0.0, 0.002)  # each time it is asked for
    given = f"clock_hz:={hz}", "rate:=5.0"
    heard = play(bag, *given, listen_to=[replay.CLOCK], clock=lambda: next(passing))[replay.CLOCK]
    clock = wire.message_class(replay.CLOCK.type)
    times = [deserialize_message(data, clock).clock for data in heard]
    stamps = [t.sec * 10**9 + t.nanosec for t in times]
    assert stamps[0] >= first_ns
    assert stamps[-1] <= last_ns
    assert (np.diff(stamps) >= 1e9 / hz).all()
    assert len(stamps) > 0.7 * (last_ns - first_ns) / 1e9 * hz


def test_pace_follows_the_rate(bag):
    """10 s of a recording, and no more than one message's wait too late."""
    for rate in (10.0, 0.5):
        with nodes.ros(*parameters(bag, f"rate:={rate}", "subscribers:=0")):
            taken_s = nodes.seconds_taken(replay.Replay)
        assert taken_s == pytest.approx(10 / rate, abs=0.1)


def test_start_sends_what_was_latched_before_and_the_rest_from_there_on(bag):
    odometry = topics.odometry("robot_1")
    heard = play(bag, "start_s:=4.0", listen_to=[odometry, *WORLD])
    stamps = [wire.decode_pose(data, "robot_1").stamp_ns for data in heard[odometry]]
    assert stamps == [START_NS + 10**9 * i // 2 for i in range(8, STEPS)]
    assert all(len(heard[topic]) == 1 for topic in WORLD)


def test_renamed_robots_are_other_robots_with_the_same_numbers(bag):
    kinds = INPUTS[:2]
    sent = [kind(name) for name in ("alice", "robot_2") for kind in kinds]
    heard = play(bag, "rename:=[robot_1=alice]", listen_to=[*sent, *map(kinds[0], ROBOTS[:1])])
    assert heard[topics.odometry("robot_1")] == []
    before = by_topic(bag)
    odometry = [wire.decode_pose(data, "alice") for data in heard[topics.odometry("alice")]]
    recorded = [wire.decode_pose(data, "robot_1") for data in before["/robot_1/odom"]]
    assert [e.stamp_ns for e in odometry] == [e.stamp_ns for e in recorded]
    np.testing.assert_array_equal([e.pose for e in odometry], [e.pose for e in recorded])
    for data, old in zip(
        heard[topics.observations("alice")], before["/robot_1/stereo/landmarks"], strict=True
    ):
        new, seen = (
            wire.decode_observations(data, "alice"),
            wire.decode_observations(old, "robot_1"),
        )
        np.testing.assert_array_equal(new.positions, seen.positions)
        np.testing.assert_array_equal(new.descriptors, seen.descriptors)
    assert heard[topics.odometry("robot_2")] == before["/robot_2/odom"]


def test_renaming_back_gives_the_same_bytes(bag):
    for record in BagReader(bag):
        there = wire.renamed(record.data, record.type, {"robot_1": "alice"})
        assert wire.renamed(there, record.type, {"alice": "robot_1"}) == record.data


def test_pause_stops_it_and_resume_loses_nothing(bag):
    odometry = topics.odometry("robot_1")
    with nodes.ros(*parameters(bag, "rate:=10.0")):
        clock = nodes.Clock()
        node, listener = replay.Replay(clock), nodes.Listener(odometry)
        client = listener.create_client(SetBool, "/replay/pause")
        heard = listener.heard[odometry]
        nodes.spin_until(client.service_is_ready, listener)
        nodes.spin_until(lambda: len(heard) == 1, node, listener)
        clock.now_s += 0.11
        nodes.spin_until(lambda: len(heard) == 3, node, listener)
        answer = client.call_async(SetBool.Request(data=True))
        nodes.spin_until(answer.done, node, listener)
        assert answer.result().success
        clock.now_s += 100.0
        nodes.spin_until(nodes.rounds(50), node, listener)
        assert len(heard) == 3
        # It goes on where it was, and does not hurry after the time it stood still.
        answer = client.call_async(SetBool.Request(data=False))
        nodes.spin_until(answer.done, node, listener)
        clock.now_s += 0.1
        nodes.spin_until(lambda: len(heard) == 5, node, listener)
        nodes.spin_until(nodes.rounds(50), node, listener)
        assert len(heard) == 5
        clock.now_s += 100.0
        nodes.spin_until(lambda: node.done and len(heard) >= STEPS, node, listener)
    assert len(heard) == STEPS


def test_waits_until_the_inputs_have_their_subscribers(bag):
    inputs = [kind(name) for name in ROBOTS for kind in INPUTS[:2]]
    with nodes.ros(*parameters(bag, "subscribers:=1")):
        node, some = replay.Replay(), nodes.Listener(*inputs[1:])
        nodes.spin_until(some.is_connected, node, some)
        nodes.spin_until(nodes.rounds(50), node, some)
        assert not any(some.heard.values())
        last = nodes.Listener(inputs[0], name="last")
        heard = some.heard | last.heard
        nodes.spin_until(
            lambda: node.done and {len(messages) for messages in heard.values()} == {STEPS},
            *(node, some, last),
        )


def test_it_plays_on_without_a_listener_when_the_wait_is_over(bag, capfd):
    with nodes.ros(*parameters(bag, "subscribers:=1", "wait_s:=0.3")):
        node = replay.Replay()
        nodes.spin_until(lambda: node.done, node)
        assert node._published > STEPS
    assert "starting without subscribers of /robot_1/odom" in capfd.readouterr().err


def test_it_does_not_wait_forever_unless_it_is_told_to():
    assert 0 < replay.Playback().wait_s < 60


@pytest.mark.parametrize("follows_clock", ["true", "false"])
def test_the_fusion_starts_over_when_the_recording_does(recorded, tmp_path, follows_clock):
    bag, config = recorded
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(scenario_file.to_yaml(**{SECTION: config}))
    of_fusion = f"scenario:={scenario}", f"use_sim_time:={follows_clock}"
    words = [word for parameter in of_fusion for word in ("-p", f"fusion:{parameter}")]
    poses = [topics.pose(name) for name in ROBOTS]
    once = live(bag, config)
    with nodes.ros(*words, *parameters(bag, "loop:=true", "subscribers:=1")):
        node, listener = fusion.Fusion(), nodes.Listener(*poses, topics.STEPS)
        player = replay.Replay()

        def at_steps(name):
            return [data for data in listener.heard[topics.pose(name)] if data in once[name]]

        nodes.spin_until(
            lambda: (
                len(listener.heard[topics.STEPS]) >= 3 * STEPS
                and all(len(at_steps(name)) >= 3 * STEPS for name in ROBOTS)
            ),
            *(node, player, listener),
        )
    for name in ROBOTS:
        assert at_steps(name)[: 3 * STEPS] == 3 * once[name]
    steps = [wire.decode_step(data).step for data in listener.heard[topics.STEPS]]
    assert steps[: 3 * STEPS] == 3 * list(range(1, STEPS + 1))


def live(bag, config):
    """What a fusion of the recording publishes as the poses of each robot."""
    pipeline, records = Pipeline(config), []
    for event in offline.events(bag, config):
        records += pipeline.handle(event)
    records += pipeline.finish()
    estimates = [estimate for record in records for estimate in record.estimates]
    return {
        name: [wire.encode_estimate(e) for e in estimates if e.robot == name] for name in ROBOTS
    }


def spawn_replay(spawn, bag, *given):
    words = [sys.executable, "-m", replay.__name__, "--ros-args", *parameters(bag, *given)]
    return spawn(*words, stderr=subprocess.PIPE, text=True)


def test_interrupt_ends_the_process(spawn, bag):
    process = spawn_replay(spawn, bag, "rate:=1.0")
    nodes.wait_for_line(process, "replaying 10.0 s")
    process.send_signal(signal.SIGINT)
    assert process.wait(nodes.PATIENCE_S) == 0


def test_a_recording_that_breaks_off_is_replayed_up_to_there(spawn, bag, tmp_path):
    (file,) = bag.glob("*.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(file.read_bytes()[: 9 * file.stat().st_size // 10])
    whole, left = (len(list(BagReader(path))) for path in (bag, cut))
    process = spawn_replay(spawn, cut, "everything:=true")
    _, said = process.communicate(timeout=nodes.PATIENCE_S)
    assert process.returncode == 0
    assert 10 < left < whole
    assert f"{left} messages over" in said
    assert f"{left} messages published" in said


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("bag:=''", "bag is empty; name the bag"),
        ("start_s:=99.0", "the recording lasts 10.0 s"),
        ("rename:=[robot_9=alice]", "robot_1, robot_2"),
        ("rename:=[robot_1]", "not robot=name"),
        ("rename:=[robot_1=robot_2]", "one name"),
        ("rate:=-1.0", "rate = -1"),
    ],
)
def test_bad_parameter_is_refused_with_the_reason(bag, given, told):
    with nodes.ros(*parameters(bag, given)), pytest.raises(InputError, match=told):
        replay.Replay()


@pytest.mark.parametrize("kind", bad_bags.BAD)
def test_a_useless_bag_is_one_line_and_exit_code_2(command, tmp_path, kind):
    make, told = bad_bags.BAD[kind]
    make(tmp_path / "bag")
    code, out, err = command("replay", "--ros-args", "-p", f"bag:={tmp_path / 'bag'}")
    lines = [line for line in err.splitlines() if not line.startswith("[WARN] ")]
    assert (code, out, len(lines)) == (2, "", 1), err
    for part in ("error: ", *told):
        assert part in lines[0]


def test_gaps_are_reported():
    """Ten messages a second, silent from 2 s to 5 s, and the last at 8 s of 12 s."""
    stream, latched = Topic("/a/odom", "t"), Topic("/b", "t", LATCHED)
    gaps = playback.Gaps({t.name: t for t in (stream, latched)}, start_ns=0)
    stamps = [int(1e8) * i for i in range(81) if not 20 < i < 50]
    said = [gaps.note(stream.name, stamp) for stamp in stamps] + [gaps.note(latched.name, 0)]
    assert [text for text in said if text] == ["gap: nothing on /a/odom for 3.0 s, after 2.0 s"]
    assert gaps.at_end(int(12e9)) == ["gap: nothing on /a/odom for 4.0 s, after 8.0 s"]


def test_topics_that_cannot_be_published_are_left_out(tmp_path, capfd):
    with BagWriter(tmp_path / "bag") as writer:
        for topic in (topics.odometry("a"), topics.observations("a"), topics.TF):
            writer.write(topic, START_NS, b"\0\1\0\0")
    with nodes.ros(*parameters(tmp_path / "bag", "everything:=true")):
        node = replay.Replay()
        nodes.spin_until(lambda: node.done, node)
    if not nodes.endpoints.is_available(topics.TF):
        assert "types are not installed, left out: /tf" in capfd.readouterr().err


def test_pictures_are_replayed_whole_for_a_camera_that_waits_for_them(tmp_path):
    import pictures

    pictures.record(tmp_path / "bag")
    topic = topics.image("robot_1", "left")
    expected = [r.data for r in BagReader(tmp_path / "bag").records({f"/{topic.name}"})]
    with nodes.ros("-p", f"bag:={tmp_path / 'bag'}", "-p", "rate:=0.0"):
        node = replay.Replay()
        assert node._audience.is_missing()
        sides = [topics.image("robot_1", side) for side in ("left", "right")]
        listener = nodes.Listener(*sides, topics.odometry("robot_1"))
        nodes.spin_until(lambda: node.done, node, listener)
        nodes.spin_until(lambda: len(listener.heard[topic]) == len(expected), listener)
    assert [
        data[: len(e)] for data, e in zip(listener.heard[topic], expected, strict=True)
    ] == expected
