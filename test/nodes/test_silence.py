"""Who publishes under another name is found."""

import pytest

from msg_defs import topics
from multi_robot_slam.nodes.silence import Silence

ODOMETRY = "nav_msgs/msg/Odometry"
CLOUD = "sensor_msgs/msg/PointCloud2"
EXPECTED = [
    topics.Topic("/robot_1/odom", ODOMETRY),
    topics.Topic("/robot_1/stereo/landmarks", CLOUD),
]


def silence():
    now = [0.0]
    return Silence(EXPECTED, 10.0, lambda: now[0]), now


@pytest.mark.parametrize(
    ("published", "said"),
    [
        ({"/robot1/odom": ODOMETRY, "/scan": CLOUD}, "/robot1/odom would fit"),
        ({"/robot_1/odometry": CLOUD}, "nobody publishes it or one like it"),
        ({"/robot_1/odom": "geometry_msgs/msg/Pose"}, "published as geometry_msgs/msg/Pose"),
        ({"/robot_1/odom": ODOMETRY}, "its publisher sends nothing"),
    ],
)
def test_one_line_says_what_there_is_instead(published, said):
    one, now = silence()
    one.hear("/robot_1/stereo/landmarks")
    assert one.news(lambda: published) == []
    now[0] = 10.0
    (line,) = one.news(lambda: published)
    assert line.startswith("nothing heard on /robot_1/odom for 10 s: ")
    assert said in line
    assert one.news(lambda: published) == []
    assert one.told == {"/robot_1/odom": line}
    one.hear("/robot_1/odom")
    assert one.told == {}


def test_who_was_heard_once_is_not_told_of():
    one, now = silence()
    for topic in EXPECTED:
        one.hear(topic.name)
    now[0] = 100.0
    assert one.news(dict) == []
