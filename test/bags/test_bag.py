"""Bags: what is written is read, by others too; a kill or a cut costs little and is reported."""

import itertools
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import bad_bags
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

from msg_defs import topics, wire
from msg_defs.errors import InputError
from msg_defs.types import LandmarkMap, PoseSample, Trajectory
from multi_robot_slam.bags import BagReader, BagWriter, absolute
from multi_robot_slam.bags import writer as writing

START = 1_700_000_000_000_000_000
ROBOTS = ("robot_1", "robot_2")


def odometry(robot, stamp_ns):
    sample = PoseSample(robot, stamp_ns, np.array([1.0, 2.0, 0.5]))
    return wire.encode_pose(sample, topics.odom_frame(robot), topics.base_frame(robot))


def recording(count=40):
    """(topic, stamp, data) in the order written; robots take turns, the second one is behind."""
    nothing = np.zeros(0, np.uint32)
    empty = LandmarkMap(
        nothing, np.zeros((0, 3)), np.zeros((0, 6)), nothing, nothing, np.zeros((0, 128))
    )
    path = {"robot_1": Trajectory(np.arange(3), np.eye(3))}
    messages = [
        (topics.WORLD_CONFIG, START, wire.encode_text("seed: 1")),
        (topics.MAP_LANDMARKS, START, wire.encode_map(empty, START)),
        (topics.MAP_MARKERS, START, wire.encode_markers(empty, path, START)),
        (topics.particles("robot_1"), START, wire.encode_particles(np.eye(3), START)),
        (topics.TF, START, wire.encode_transform(START, "map", "odom", np.zeros(3))),
    ]
    for i in range(count):
        robot = ROBOTS[i % 2]
        stamp = START + 1000 * i - 5000 * (i % 2)
        messages.append((topics.odometry(robot), stamp, odometry(robot, stamp)))
    return messages


def write(folder, messages):
    with BagWriter(folder) as bag:
        for message in messages:
            bag.write(*message)
    return folder


def as_read(messages):
    """What a reader gives: by time, equal times in the order written."""
    records = [(f"/{t.name.lstrip('/')}", t.type, stamp, data) for t, stamp, data in messages]
    return sorted(records, key=lambda record: record[2])


def mcap_file(folder):
    return folder / f"{folder.name}_0.mcap"


@pytest.fixture
def bag(tmp_path):
    return write(tmp_path / "run", recording())


@pytest.fixture(scope="module")
def sound_file(tmp_path_factory):
    """The bytes of a whole MCAP file."""
    return mcap_file(write(tmp_path_factory.mktemp("sound") / "run", recording())).read_bytes()


class TestRoundTrip:
    @hypothesis_settings(max_examples=30)
    @given(messages=st.lists(st.tuples(st.sampled_from(ROBOTS), st.integers(0, 9), st.binary())))
    def test_identity(self, tmp_path_factory, messages):
        written = [(topics.odometry(robot), stamp, data) for robot, stamp, data in messages]
        folder = write(tmp_path_factory.mktemp("bags") / "run", written)
        reader = BagReader(folder)
        assert list(reader) == as_read(written)
        assert reader.warnings == []

    def test_order_holds_across_chunks(self, tmp_path, monkeypatch):
        """Equal stamps keep the order written, late messages move to their time."""
        monkeypatch.setattr(writing, "CHUNK_BYTES", 2000)
        stamps = [5, 5, 9, 5, 1, 9, 5, 1] * 20
        written = [
            (topics.odometry(ROBOTS[i % 2]), s, bytes([i]) * 300) for i, s in enumerate(stamps)
        ]
        folder = write(tmp_path / "run", written)
        assert list(BagReader(folder)) == as_read(written)

    def test_every_kind_of_topic(self, bag):
        assert list(BagReader(bag)) == as_read(recording())

    def test_a_reader_can_be_read_twice(self, bag):
        reader = BagReader(bag)
        assert list(reader) == list(reader) != []

    def test_a_lone_file(self, bag):
        assert list(BagReader(mcap_file(bag))) == as_read(recording())

    def test_several_files_are_merged_by_time(self, tmp_path, bag):
        other = write(tmp_path / "other", recording(7))
        shutil.copy(mcap_file(other), bag)
        reader = BagReader(bag)
        assert [r.stamp_ns for r in reader] == sorted(m[1] for m in recording() + recording(7))
        assert any("does not list other_0.mcap" in warning for warning in reader.warnings)

    def test_an_empty_bag(self, tmp_path):
        reader = BagReader(write(tmp_path / "run", []))
        assert (list(reader), reader.warnings) == ([], [])

    def test_an_exception_leaves_what_was_written_and_says_that_it_breaks_off(self, tmp_path):
        bag = BagWriter(tmp_path / "run")

        def fail():
            with bag:
                for message in recording():
                    bag.write(*message)
                raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            fail()
        reader = BagReader(tmp_path / "run")
        assert list(reader) == as_read(recording())
        (warning,) = reader.warnings
        assert "breaks off: its recorder was killed or failed" in warning
        bag.close()
        assert BagReader(tmp_path / "run").warnings == [warning]

    def test_close_twice(self, tmp_path):
        writer = BagWriter(tmp_path / "run")
        writer.close()
        before = mcap_file(tmp_path / "run").read_bytes()
        writer.close()
        assert mcap_file(tmp_path / "run").read_bytes() == before


class TestOthersReadIt:
    def test_rosbags_decodes_every_message(self, bag):
        with AnyReader([bag]) as reader:
            found = [
                (c.topic, c.msgtype, stamp, bytes(data)) for c, stamp, data in reader.messages()
            ]
            for connection, _, data in reader.messages():
                assert reader.deserialize(data, connection.msgtype) is not None
        assert sorted(found) == sorted(as_read(recording()))

    def test_rosbags_finds_the_quality_of_service(self, bag):
        with AnyReader([bag]) as reader:
            qos = {c.topic: c.ext.offered_qos_profiles[0] for c in reader.connections}
        latched, stream, sensor = (
            qos[f"/{name}"] for name in ("map/landmarks", "robot_1/odom", "robot_1/particles")
        )
        assert latched.durability is QosDurability.TRANSIENT_LOCAL
        assert stream.durability is QosDurability.VOLATILE
        assert (latched.depth, stream.depth, sensor.depth) == (1, 1000, 1)
        assert stream.reliability is QosReliability.RELIABLE
        assert sensor.reliability is QosReliability.BEST_EFFORT

    def test_mcap_finds_an_index(self, bag):
        with mcap_file(bag).open("rb") as stream:
            reader = make_reader(stream)
            summary = reader.get_summary()
            assert reader.get_header().profile == "ros2"
            only = list(reader.iter_messages(topics="/robot_2/odom"))
        assert summary.statistics.message_count == len(recording())
        assert summary.chunk_indexes
        assert len(only) == 20
        schema, channel, _ = only[0]
        assert (schema.name, schema.encoding) == ("nav_msgs/msg/Odometry", "ros2msg")
        assert channel.message_encoding == "cdr"

    def test_mcap_decodes_every_message_by_its_schema(self, bag):
        with mcap_file(bag).open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            decoded = list(reader.iter_decoded_messages())
        assert len(decoded) == len(recording())
        for schema, channel, _, message in decoded:
            if channel.topic == "/robot_1/odom":
                assert schema.name == "nav_msgs/msg/Odometry"
                assert (message.header.frame_id, message.pose.pose.position.y) == (
                    "robot_1/odom",
                    2.0,
                )

    def test_metadata(self, bag):
        text = (bag / "metadata.yaml").read_text()
        information = yaml.safe_load(text)["rosbag2_bagfile_information"]
        stamps = [stamp for _, stamp, _ in recording()]
        assert information["version"] == 9
        assert information["storage_identifier"] == "mcap"
        assert information["message_count"] == len(stamps)
        assert information["starting_time"]["nanoseconds_since_epoch"] == min(stamps)
        assert information["duration"]["nanoseconds"] == max(stamps) - min(stamps)
        assert information["relative_file_paths"] == ["run_0.mcap"]
        counts = {
            entry["topic_metadata"]["name"]: entry["message_count"]
            for entry in information["topics_with_message_count"]
        }
        assert counts["/robot_1/odom"] == 20
        assert counts["/tf"] == 1
        assert sum(counts.values()) == len(stamps)
        assert "&id" not in text

    def test_type_hashes_are_ros_own(self):
        """ROS 2 Jazzy's `std_msgs/msg/String.json`."""
        _, type_hash = wire.message_schema("std_msgs/msg/String")
        assert type_hash == (
            "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
        )


def write_with_rosbags(folder, messages, storage, compression=None):
    """The bag `folder` of the same messages as another program writes it."""
    writer = RosbagsWriter(folder, version=9, storage_plugin=storage)
    if compression:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    store = get_typestore(Stores.ROS2_JAZZY)
    forever = QosTime(9223372036, 854775807)
    with writer:
        connections = {}
        for topic, stamp, data in messages:
            if topic not in connections:
                qos = Qos(
                    QosHistory.KEEP_LAST,
                    1,
                    QosReliability.RELIABLE,
                    QosDurability.TRANSIENT_LOCAL
                    if topic.qos == topics.LATCHED
                    else QosDurability.VOLATILE,
                    forever,
                    forever,
                    QosLiveliness.AUTOMATIC,
                    forever,
                    False,
                )
                connections[topic] = writer.add_connection(
                    absolute(topic.name),
                    topic.type,
                    typestore=store,
                    offered_qos_profiles=[qos],
                )
            writer.write(connections[topic], stamp, data)
    return folder


def tangled():
    """Few stamps and many topics: the order among equal stamps is that of writing."""
    kinds = [topics.odometry(robot) for robot in ROBOTS] + [topics.FUSION_CONFIG]
    rng = np.random.default_rng(1)
    return [(kinds[rng.integers(3)], int(rng.integers(5)), bytes([i]) * 50) for i in range(200)]


class TestOthersWriteIt:
    @pytest.mark.parametrize(
        ("storage", "compression"),
        [
            *itertools.product(
                StoragePlugin, [None, CompressionMode.FILE, CompressionMode.MESSAGE]
            ),
            (StoragePlugin.MCAP, CompressionMode.STORAGE),
        ],
    )
    def test_all_storages_give_the_same(self, tmp_path, storage, compression):
        reader = BagReader(write_with_rosbags(tmp_path / "run", tangled(), storage, compression))
        assert list(reader) == as_read(tangled())
        assert reader.warnings == []
        assert reader.summary.message_count == 200
        assert reader.summary.span_ns == (0, 4)
        latched = {topic.name for topic in reader.summary.topics if topic.qos == topics.LATCHED}
        assert latched == {"/fusion/config"}

    @pytest.mark.parametrize("storage", StoragePlugin)
    def test_without_metadata(self, tmp_path, storage):
        folder = write_with_rosbags(tmp_path / "run", tangled(), storage)
        (folder / "metadata.yaml").unlink()
        (file,) = folder.iterdir()
        assert list(BagReader(folder)) == list(BagReader(file)) == as_read(tangled())
        assert "is unusable" in BagReader(folder).warnings[0]
        assert BagReader(file).warnings == []

    def test_mcap_without_chunks_index_and_statistics(self, tmp_path):
        """As rosbag2's preset `fastwrite` leaves it."""
        path = tmp_path / "x.mcap"
        with path.open("wb") as stream:
            writer = Writer(
                stream,
                compression=CompressionType.NONE,
                index_types=IndexType.NONE,
                repeat_channels=False,
                repeat_schemas=False,
                use_chunking=False,
                use_statistics=False,
                use_summary_offsets=False,
            )
            writer.start("ros2")
            schema = writer.register_schema("nav_msgs/msg/Odometry", "ros2msg", b"")
            channel = writer.register_channel("/robot_1/odom", "cdr", schema)
            for i in (3, 1, 2):
                writer.add_message(channel, i, bytes([i]), i)
            writer.finish()
        reader = BagReader(path)
        assert [record.stamp_ns for record in reader] == [1, 2, 3]
        assert (reader.summary.message_count, reader.summary.span_ns) == (3, (1, 3))
        assert (reader.warnings, reader.found()) == ([], "/robot_1/odom")


class TestKilled:
    def test_what_was_flushed_survives(self, tmp_path):
        writer = BagWriter(tmp_path / "run")
        for message in recording():
            writer.write(*message)
        writer.flush()
        copy = shutil.copytree(tmp_path / "run", tmp_path / "copy")
        reader = BagReader(copy)
        assert list(reader) == as_read(recording())
        assert len(reader.warnings) == 1
        assert "breaks off" in reader.warnings[0]
        writer.close()

    def test_messages_are_flushed_as_time_passes(self, tmp_path, monkeypatch):
        clock = iter(np.arange(1, 1000) * 2 * writing.FLUSH_PERIOD_S)
        monkeypatch.setattr(writing.time, "monotonic", lambda: next(clock))
        with BagWriter(tmp_path / "run") as writer:
            for count, message in enumerate(recording(), start=1):
                writer.write(*message)
                assert len(list(BagReader(tmp_path / "run"))) == count

    def test_the_first_message_is_flushed_at_once(self, tmp_path):
        with BagWriter(tmp_path / "run") as writer:
            writer.write(*recording()[0])
            assert len(list(BagReader(tmp_path / "run"))) == 1

    def test_a_killed_process(self, tmp_path):
        """It writes, flushes, tells us, writes on, and is killed."""
        program = (
            "import sys, time\n"
            "from msg_defs import topics\n"
            "from multi_robot_slam.bags import BagWriter\n"
            f"bag = BagWriter({str(tmp_path / 'run')!r})\n"
            "for i in range(100):\n"
            "    bag.write(topics.odometry('robot_1'), i, bytes(700))\n"
            "bag.flush()\n"
            "bag.write(topics.odometry('robot_1'), 100, bytes(700))\n"
            "print('written', flush=True)\n"
            "time.sleep(60)\n"
        )
        process = subprocess.Popen(
            [sys.executable, "-c", program], stdout=subprocess.PIPE, cwd=Path(__file__).parents[2]
        )
        with process:
            assert process.stdout.readline() == b"written\n"
            process.send_signal(signal.SIGKILL)
        stamps = [record.stamp_ns for record in BagReader(tmp_path / "run")]
        assert stamps[:100] == list(range(100))

    def test_cut_anywhere(self, tmp_path, monkeypatch):
        """A prefix of the messages is left, the longer the later the cut, and never half a one."""
        monkeypatch.setattr(writing, "CHUNK_BYTES", 1000)
        written = [(topics.odometry("robot_1"), i, bytes([i]) * 600) for i in range(30)]
        data = mcap_file(write(tmp_path / "run", written)).read_bytes()
        cut = tmp_path / "cut.mcap"
        counts = []
        for size in [*range(8, 30), *range(30, len(data), 97), len(data) - 1]:
            cut.write_bytes(data[:size])
            reader = BagReader(cut)
            records = list(reader)
            assert records == as_read(written)[: len(records)]
            assert "breaks off" in reader.warnings[0]
            counts.append(len(records))
        assert counts == sorted(counts)
        assert (counts[0], counts[-1]) == (0, 30)
        assert max(np.diff(counts)) <= 2

    def test_what_is_known_of_the_loss_is_told(self, bag):
        data = mcap_file(bag).read_bytes()
        mcap_file(bag).write_bytes(data[: len(data) // 2])
        torn, count = BagReader(bag).warnings
        left = len(list(BagReader(bag)))
        assert f"{left} messages over 0.0 s are read" in torn
        assert f"promises {len(recording())} messages, the files hold {left}" in count

    def test_late_messages_of_a_cut_file_are_sorted(self, bag):
        data = mcap_file(bag).read_bytes()
        mcap_file(bag).write_bytes(data[:-20])
        assert list(BagReader(bag)) == as_read(recording())


class TestRefused:
    def test_an_existing_folder(self, bag):
        before = mcap_file(bag).read_bytes()
        with pytest.raises(InputError, match="run exists already"):
            BagWriter(bag)
        assert mcap_file(bag).read_bytes() == before

    def test_a_folder_that_cannot_be(self, tmp_path):
        (tmp_path / "file").touch()
        with pytest.raises(InputError, match="cannot write the bag"):
            BagWriter(tmp_path / "file" / "run")

    @pytest.mark.parametrize(
        ("content", "complaint"),
        [
            (None, "no bag .*no such file"),
            (b"", "is empty"),
            (b"\x89MC", "is no MCAP file"),
            (b"#ROSBAG V2.0\n" + bytes(100), "is no MCAP file"),
        ],
    )
    def test_a_file_that_is_no_bag(self, tmp_path, content, complaint):
        path = tmp_path / "x.mcap"
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(InputError, match=complaint) as caught:
            BagReader(path)
        assert "\n" not in str(caught.value)

    def test_an_empty_folder(self, tmp_path):
        with pytest.raises(InputError, match=r"no \.mcap file"):
            BagReader(tmp_path)

    @pytest.mark.parametrize("share", [0, 0.001, 0.5, 0.99])
    def test_a_cut_database(self, tmp_path, share):
        folder = write_with_rosbags(tmp_path / "run", tangled(), StoragePlugin.SQLITE3)
        (file,) = folder.glob("*.db3")
        file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
        with pytest.raises(InputError, match=r"is damaged|is empty") as caught:
            list(BagReader(file))
        assert "\n" not in str(caught.value)

    def test_a_compressed_file_that_is_cut(self, tmp_path):
        messages, storage = tangled(), StoragePlugin.SQLITE3
        folder = write_with_rosbags(tmp_path / "run", messages, storage, CompressionMode.FILE)
        (file,) = folder.glob("*.zstd")
        file.write_bytes(file.read_bytes()[:-100])
        with pytest.raises(InputError, match="is damaged"):
            list(BagReader(folder))

    def test_another_type_on_a_topic(self, bag):
        wanted = topics.odometry("robot_1")._replace(type="geometry_msgs/msg/Twist")
        told = "/robot_1/odom was recorded as nav_msgs/msg/Odometry, expected is geometry_msgs/msg"
        with pytest.raises(InputError, match=told):
            next(BagReader(bag).only([wanted]))

    def test_damage_in_the_middle(self, bag):
        data = bytearray(mcap_file(bag).read_bytes())
        data[len(data) // 3] ^= 0xFF
        mcap_file(bag).write_bytes(data)
        with pytest.raises(InputError, match="is damaged"):
            list(BagReader(bag))

    @hypothesis_settings(max_examples=100)
    @given(patches=st.lists(st.tuples(st.integers(0), st.integers(0, 255)), min_size=1, max_size=4))
    def test_damage_anywhere_never_crashes(self, tmp_path_factory, sound_file, patches):
        data = bytearray(sound_file)
        for position, value in patches:
            data[8 + position % (len(data) - 8)] = value
        path = tmp_path_factory.mktemp("damaged") / "x.mcap"
        path.write_bytes(data)
        problem = ""
        try:
            list(BagReader(path))
        except InputError as error:
            problem = str(error)
        assert "\n" not in problem


def edit_metadata(folder, **changes):
    path = folder / "metadata.yaml"
    document = yaml.safe_load(path.read_text())
    document["rosbag2_bagfile_information"].update(changes)
    path.write_text(yaml.safe_dump(document))


class TestMetadataDisagrees:
    def test_counts(self, bag):
        edit_metadata(bag, message_count=3)
        reader = BagReader(bag)
        assert "promises 3 messages, the files hold 45" in reader.warnings[0]
        assert len(list(reader)) == 45

    def test_a_file_is_missing(self, bag):
        edit_metadata(bag, relative_file_paths=["run_0.mcap", "run_1.mcap"])
        assert "lists run_1.mcap, which is missing" in BagReader(bag).warnings[0]

    @pytest.mark.parametrize("text", [None, "", "a: [", "rosbag2_bagfile_information: 3", "\0"])
    def test_metadata_of_no_use(self, bag, text):
        (bag / "metadata.yaml").unlink()
        if text is not None:
            (bag / "metadata.yaml").write_text(text)
        reader = BagReader(bag)
        assert "is unusable" in reader.warnings[0]
        assert list(reader) == as_read(recording())


@pytest.mark.parametrize("verb", ["run", "evaluate", "report", "export"])
@pytest.mark.parametrize("kind", bad_bags.BAD)
def test_a_useless_bag_is_one_line_and_exit_code_2(command, tmp_path, verb, kind):
    make, told = bad_bags.BAD[kind]
    make(tmp_path / "bag")
    words = ("--out", tmp_path / "out") if verb in ("run", "export") else ()
    words += ("--to", "ply") if verb == "export" else ()
    code, out, err = command(verb, tmp_path / "bag", *words)
    assert (code, out, err.count("\n")) == (2, "", 1), err
    for part in ("error: ", *told):
        assert part in err


def test_run_names_the_topics_it_expected(command, tmp_path):
    make, _ = bad_bags.BAD["foreign"]
    make(tmp_path / "bag")
    words = ("--scenario", "calibrated", "--out", tmp_path / "out")
    code, out, err = command("run", tmp_path / "bag", *words)
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert "expected /robot_1/odom, /robot_1/stereo/landmarks; its topics are /chatter" in err


def test_chunks_that_overlap_are_read_as_the_library_does(tmp_path):
    """In any order of time, many to a chunk, with equal stamps, of chosen topics or all."""
    rng = np.random.default_rng(3)
    path = tmp_path / "x.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=600, compression=CompressionType.NONE)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"")
        channels = [writer.register_channel(f"/{n}", "cdr", schema) for n in range(3)]
        for i in range(500):
            stamp = max(0, i // 4 + int(rng.integers(-30, 30)))
            writer.add_message(channels[rng.integers(3)], stamp, bytes([i % 256]) * 40, stamp)
        writer.finish()
    for names in (None, ["/1"], ["/0", "/2"], []):
        with path.open("rb") as stream:
            expected = [
                (channel.topic, message.log_time, message.data)
                for _, channel, message in make_reader(stream).iter_messages(names)
            ]
        found = [(r.topic, r.stamp_ns, r.data) for r in BagReader(path).records(names)]
        assert found == expected
    counts = BagReader(path).summary.counts
    assert counts == {name: sum(r.topic == name for r in BagReader(path)) for name in counts}
