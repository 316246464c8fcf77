"""Which robots a bag holds, and what they are called after renaming, in namespaces too."""

import numpy as np
import pytest

from msg_defs import topics, wire
from msg_defs.errors import InputError
from msg_defs.types import PoseSample
from multi_robot_slam.bags import Record
from multi_robot_slam.bags.playback import Names, robots_of

TEAM = ("fleet/robot_1", "fleet/robot_2")


def odometry_of(path):
    name = path.rpartition("/")[2]
    sample = PoseSample(name, 5, np.array([1.0, 2.0, 0.5]))
    data = wire.encode_pose(sample, topics.odom_frame(name), topics.base_frame(name))
    return Record(f"/{path}/odom", topics.odometry(name).type, 5, data)


def test_robots_keep_their_namespace():
    recorded = [topics.odometry(path)._replace(name=f"/{path}/odom") for path in TEAM]
    assert robots_of(recorded) == TEAM


@pytest.mark.parametrize("rule", ["robot_1=alice", "fleet/robot_1=alice"])
def test_a_robot_in_a_namespace_is_renamed_there_with_its_frames(rule):
    names = Names([rule], TEAM)
    record = odometry_of("fleet/robot_1")
    assert names.topic(topics.Topic(record.topic, record.type)).name == "/fleet/alice/odom"
    assert wire.decode_pose(names.data(record), "alice").pose.tolist() == [1.0, 2.0, 0.5]
    other = odometry_of("fleet/robot_2")
    assert names.topic(topics.Topic(other.topic, other.type)).name == other.topic
    assert names.data(other) == other.data


def test_a_name_in_two_namespaces_needs_its_namespace():
    robots = ("a/robot_1", "b/robot_1")
    with pytest.raises(InputError, match="each of a/robot_1, b/robot_1"):
        Names(["robot_1=alice"], robots)
    names = Names(["b/robot_1=alice"], robots)
    one, other = (odometry_of(robot) for robot in robots)
    assert names.data(one) == one.data
    assert wire.decode_pose(names.data(other), "alice").robot == "alice"


def test_namesakes_in_two_namespaces_become_two():
    names = Names(["a/robot_1=alice", "b/robot_1=bob"], ("a/robot_1", "b/robot_1"))
    for path, new in (("a/robot_1", "alice"), ("b/robot_1", "bob")):
        assert wire.decode_pose(names.data(odometry_of(path)), new).robot == new


@pytest.mark.parametrize("rule", ["robot_9=alice", "robot_1", "robot_1=", "robot_1=a/b"])
def test_what_is_no_rule_is_refused(rule):
    with pytest.raises(InputError, match="is not robot=name"):
        Names([rule], TEAM)


def test_two_robots_cannot_have_one_name():
    with pytest.raises(InputError, match="one name"):
        Names(["robot_1=robot_2"], TEAM)
