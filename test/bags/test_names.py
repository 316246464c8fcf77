"""Topics under the namespace they were recorded in: found, chosen, refused."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from msg_defs import topics, wire
from msg_defs.errors import InputError
from multi_robot_slam.bags import BagReader, BagWriter, absolute, namespaces

WANTED = [topics.odometry("robot_1"), topics.observations("robot_1")]
WORDS = st.text("abc_", min_size=1, max_size=5)


@given(parts=st.lists(WORDS, max_size=3))
def test_what_is_named_in_a_namespace_is_found_in_it(parts):
    namespace = "".join(f"/{part}" for part in parts)
    recorded = [topic._replace(name=absolute(topic.name, namespace)) for topic in WANTED]
    assert namespaces(recorded, WANTED) == (namespace,)


@pytest.mark.parametrize("namespace", ["fleet", "/fleet", "/fleet/", "fleet/"])
def test_slashes_around_a_namespace_do_not_matter(namespace):
    assert absolute("robot_1/odom", namespace) == "/fleet/robot_1/odom"


def test_absolute_topics_are_in_no_namespace():
    assert absolute("/diagnostics", "/fleet") == "/diagnostics"
    recorded = [topics.DIAGNOSTICS._replace(name="/fleet/diagnostics")]
    assert namespaces(recorded, [topics.DIAGNOSTICS]) == ()


def test_another_robots_topics_are_no_namespace():
    recorded = [topics.odometry("robot_2")._replace(name="/fleet/robot_2/odom")]
    assert namespaces(recorded, WANTED) == ()
    longer = [topics.odometry("robot_1")._replace(name="/fleet/other_robot_1/odom")]
    assert namespaces(longer, WANTED) == ()


def bag_of(folder, *names):
    with BagWriter(folder) as bag:
        for stamp, name in enumerate(names):
            topic = topics.Topic(name, "std_msgs/msg/String")
            bag.write(topic, stamp, wire.encode_text(name))
    return BagReader(folder)


def strings(*topics_wanted):
    return [topic._replace(type="std_msgs/msg/String") for topic in topics_wanted]


def test_several_namespaces_are_named_and_one_can_be_chosen(tmp_path):
    reader = bag_of(tmp_path / "bag", "/robot_1/odom", "/b/robot_1/odom", "/b/c/robot_1/odom")
    wanted = strings(topics.odometry("robot_1"))
    with pytest.raises(InputError, match=r"in the namespaces /, /b, /b/c; choose .*--namespace"):
        reader.find_namespace(wanted)
    for chosen, name in {"/": "/", "b": "/b/", "/b/c": "/b/c/"}.items():
        namespace = reader.find_namespace(wanted, chosen)
        ((topic, data),) = reader.only(wanted, namespace)
        assert (topic, wire.decode_text(data)) == (wanted[0], f"{name}robot_1/odom")


def test_where_nothing_is_found_the_root_is_meant(tmp_path):
    reader = bag_of(tmp_path / "bag", "/chatter")
    assert reader.find_namespace(WANTED) == ""


def test_a_wrong_type_is_found_in_the_namespace(tmp_path):
    reader = bag_of(tmp_path / "bag", "/b/robot_1/odom")
    reader.require(WANTED)
    with pytest.raises(InputError, match="/b/robot_1/odom was recorded as std_msgs"):
        reader.require(WANTED, "/b")
