"""Bags that no command can use, and what each must say of them."""

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from msg_defs import scenario_file, topics, wire
from multi_robot_slam.bags import BagWriter
from multi_robot_slam.config import SECTION, Config

CONFIG = Config()
NOT_ODOMETRY = topics.odometry("robot_1")._replace(type="geometry_msgs/msg/Twist")


def _nothing(folder):
    BagWriter(folder).close()


def _cut_at_once(folder):
    _foreign(folder)
    (file,) = folder.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:100])


def _cut_database(folder):
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        store = get_typestore(Stores.ROS2_JAZZY)
        connection = writer.add_connection("/a", "std_msgs/msg/String", typestore=store)
        for stamp in range(500):
            writer.write(connection, stamp, wire.encode_text("x" * 100))
    (file,) = folder.glob("*.db3")
    file.write_bytes(file.read_bytes()[:20_000])


def _noise(folder):
    folder.mkdir()
    (folder / "x.mcap").write_bytes(b"noise" * 100)


def _foreign(folder):
    with BagWriter(folder) as bag:
        bag.write(topics.Topic("/chatter", "std_msgs/msg/String"), 1, wire.encode_text("hello"))


def _other_type(folder):
    with BagWriter(folder) as bag:
        text = scenario_file.to_yaml(**{SECTION: CONFIG})
        bag.write(topics.FUSION_CONFIG, 1, wire.encode_text(text))
        bag.write(topics.observations("robot_1"), 1, b"\0\1\0\0")
        bag.write(NOT_ODOMETRY, 1, bytes(52))


BAD = {
    "without a message": (_nothing, ["holds no messages"]),
    "cut at once": (_cut_at_once, ["holds no messages"]),
    "cut database": (_cut_database, ["is damaged", "malformed"]),
    "noise": (_noise, ["x.mcap is no MCAP file"]),
    "foreign": (_foreign, ["its topics are /chatter"]),
    "other type": (
        _other_type,
        ["/robot_1/odom", "geometry_msgs/msg/Twist", "nav_msgs/msg/Odometry"],
    ),
}
"""What is wrong -> how to write such a bag, and parts of the one line."""
