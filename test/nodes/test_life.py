"""The fusion as a managed node, and what may change while it runs."""

import pytest
import recordings

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.pipeline import map_files
from multi_robot_slam.pipeline.pipeline import Pipeline
from sim_world.scenario import Scenario
from sim_world.simulator import Simulation

nodes = pytest.importorskip("nodes")
fusion = pytest.importorskip("multi_robot_slam.nodes.fusion")
parameter = pytest.importorskip("rclpy.parameter")
lifecycle = pytest.importorskip("lifecycle_msgs.srv")
transitions = pytest.importorskip("lifecycle_msgs.msg").Transition
srv = pytest.importorskip("std_srvs.srv")

pytestmark = pytest.mark.usefixtures("ros_domain_id")

SIMULATION = Simulation(Scenario(robots=2, movements=40, observations=5), seed=3)
CONFIG = recordings.configuration(SIMULATION, particles=10)
STEPS = list(SIMULATION.steps())
ACTIVATE = transitions.TRANSITION_ACTIVATE
DEACTIVATE = transitions.TRANSITION_DEACTIVATE
CONFIGURE = transitions.TRANSITION_CONFIGURE
CLEANUP = transitions.TRANSITION_CLEANUP


@pytest.fixture
def given(tmp_path):
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(scenario_file.to_yaml(**{SECTION: CONFIG}))
    told = f"scenario:={scenario}", "idle_s:=0.2", "picture_period_s:=0.05"
    return [word for one in told for word in ("-p", one)]


def sent(steps):
    truths = {
        kind(name)
        for kind in (topics.ground_truth, topics.observation_truth)
        for name in CONFIG.robots
    }
    return [m for step in steps for m in recordings.messages_of(step) if m[0] not in truths]


class Managed:
    """A fusion in this process, and who manages it."""

    def __init__(self):
        self.node = fusion.Fusion()
        self.listener = nodes.Listener(topics.STEPS, topics.FUSION_CONFIG, topics.DIAGNOSTICS)

    def call(self, kind, name, **request):
        client = self.listener.create_client(kind, f"/fusion/{name}")
        self.until(client.service_is_ready)
        answer = client.call_async(kind.Request(**request))
        self.until(answer.done)
        return answer.result()

    def change(self, number):
        asked = transitions(id=number)
        return self.call(lifecycle.ChangeState, "change_state", transition=asked).success

    def state(self):
        return self.call(lifecycle.GetState, "get_state").current_state.label

    def until(self, condition):
        nodes.spin_until(condition, self.node, self.listener)

    def hear(self, steps):
        """The number of the newest step when all of `steps` are filtered."""
        self.listener.send(sent(steps))
        last_ns = steps[-1][0].odometry.stamp_ns
        self.until(lambda: self.newest() and self.newest().stamp_ns == last_ns)
        return self.newest().step

    def newest(self):
        heard = self.listener.heard[topics.STEPS]
        return wire.decode_step(heard[-1]) if heard else None

    def set(self, name, value):
        (result,) = self.node.set_parameters([parameter.Parameter(name, value=value)])
        return result.successful or result.reason

    def configs(self):
        texts = map(wire.decode_text, self.listener.heard[topics.FUSION_CONFIG])
        return [scenario_file.from_yaml(Config, text, SECTION) for text in texts]


def test_it_does_what_it_is_told_to(given):
    with nodes.ros(*given, "-p", "autostart:=false"):
        team = Managed()
        assert team.state() == "unconfigured"
        refused = team.call(srv.Trigger, "reset").message
        assert "not configured: ros2 lifecycle set /fusion configure" in refused
        assert "/robot_1/pose" not in dict(team.node.get_topic_names_and_types())
        assert not team.change(DEACTIVATE)
        assert team.change(CONFIGURE)
        assert team.state() == "inactive"
        assert "not active" in team.call(srv.SetBool, "pause", data=True).message
        assert team.change(ACTIVATE)
        assert team.hear(STEPS[:6]) == 6
        assert team.change(DEACTIVATE)
        count = team.node.received
        team.listener.send(sent(STEPS[6:8]))
        team.until(lambda: team.node.received >= count + len(sent(STEPS[6:8])))
        assert team.newest().step == 6
        assert team.change(ACTIVATE)
        assert team.hear(STEPS[8:10]) == 8  # what came meanwhile was not used
        assert team.change(DEACTIVATE)
        assert team.change(CLEANUP)
        assert team.state() == "unconfigured"
        own = dict(team.node.get_publisher_names_and_types_by_node("fusion", "/"))
        assert "/robot_1/pose" not in own
        assert team.change(CONFIGURE)
        assert team.change(ACTIVATE)
        assert team.hear(STEPS[10:12]) == 2
        team.node.close()


def test_what_cannot_be_configured_says_why_and_can_be_put_right(given, tmp_path):
    with nodes.ros(*given, "-p", "autostart:=false", "-p", f"map:={tmp_path / 'no.npz'}"):
        team = Managed()
        assert not team.change(CONFIGURE)
        assert team.state() == "unconfigured"
        assert team.set("map", "") is True
        assert team.change(CONFIGURE)
        team.node.close()


def test_what_may_change_when(given):
    with nodes.ros(*given):
        team = Managed()
        team.hear(STEPS[:3])
        told = team.set("filter.particles", 20)
        assert "filter.particles cannot change while the node is configured" in told
        assert "ros2 lifecycle set /fusion deactivate, then cleanup" in told
        assert "picture_period_s = 0" in team.set("picture_period_s", 0.0)
        assert team.set("picture_period_s", 0.5) is True
        assert team.node._periodic[0].timer_period_ns == 5 * 10**8
        assert team.set("publish_tf", False) is True
        assert not team.node.fusing._outputs.publishes_tf
        assert team.set("silent_s", 9.0) is True
        assert team.node.fusing.health.silent_s == 9
        assert team.change(DEACTIVATE)
        assert team.change(CLEANUP)
        assert "1 poses for 2 robots" in team.set("start_poses", [0.0, 0.0, 0.0])
        assert team.set("filter.particles", 20) is True
        assert team.change(CONFIGURE)
        assert team.change(ACTIVATE)
        assert team.hear(STEPS[3:6]) == 3
        assert team.configs()[-1].filter.particles == 20
        team.node.close()


def test_mapping_and_learning_count_from_the_next_beginning_which_is_published(given, tmp_path):
    pipeline = Pipeline(CONFIG, keeps_frames=False)
    for step in STEPS[:20]:
        for topic, data in sent([step]):
            robot, _, kind = topic.name.partition("/")
            decode = wire.decode_pose if kind == "odom" else wire.decode_observations
            pipeline.handle(decode(data, robot))
    file = tmp_path / "a.npz"
    map_files.write(file, map_files.about(CONFIG, 1), map_files.closed(pipeline))
    with nodes.ros(*given):
        team = Managed()
        team.hear(STEPS[:3])
        assert team.set("filter.mapping", False) is True
        assert team.set("filter.learn_noise", False) is True
        assert team.node.fusing.pipeline.config.filter.mapping
        refused = team.call(srv.Trigger, "reset")
        assert not refused.success
        assert "no map to localise in" in refused.message
        assert team.hear(STEPS[3:4]) == 4  # nothing has happened
        assert team.set("map", str(file)) is True
        assert team.call(srv.Trigger, "load_map").success
        assert team.hear(STEPS[4:6]) == 2
        team.until(lambda: len(team.configs()) == 2)
        first, second = (config.filter for config in team.configs())
        assert (first.mapping, first.learn_noise) == (True, True)
        assert (second.mapping, second.learn_noise) == (False, False)
        in_map = team.node.fusing.pipeline.landmark_map()
        kept = map_files.read(file).kept
        assert in_map.ids.tolist() == kept.ids[kept.published].tolist()
        team.node.close()


def test_by_itself_it_ends_with_what_is_wrong(given):
    impossible = "-p", "filter.mapping:=false"
    with nodes.ros(*given, *impossible), pytest.raises(InputError, match="no map to localise in"):
        fusion.Fusion()
