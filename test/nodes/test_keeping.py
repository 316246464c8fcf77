"""The fusion's files: maps saved and loaded, and a fusion that goes on after a crash."""

import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import recordings

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from multi_robot_slam.config import SECTION
from multi_robot_slam.filter.settings import RejuvenationSettings
from multi_robot_slam.pipeline import map_files
from multi_robot_slam.pipeline.pipeline import Pipeline
from sim_world.scenario import Scenario
from sim_world.simulator import Simulation

nodes = pytest.importorskip("nodes")
fusion = pytest.importorskip("multi_robot_slam.nodes.fusion")
keeping = pytest.importorskip("multi_robot_slam.nodes.keeping")
rclpy_parameter = pytest.importorskip("rclpy.parameter")
srv = pytest.importorskip("std_srvs.srv")

pytestmark = pytest.mark.usefixtures("ros_domain_id")

SIMULATION = Simulation(Scenario(robots=2, movements=120, observations=8), seed=3)
REST = RejuvenationSettings(ancestors_below=0.5, unknowns=200)
CONFIG = replace(
    recordings.configuration(SIMULATION, particles=40, rejuvenation=REST), reorder_window_s=60.0
)
"""Robots wait for each other, however they are sent, so that the order is always the same."""
STEPS = list(SIMULATION.steps())
TRUTHS = {
    kind(name) for kind in (topics.ground_truth, topics.observation_truth) for name in CONFIG.robots
}


def sent(steps):
    return [one for step in steps for one in recordings.messages_of(step) if one[0] not in TRUTHS]


@pytest.fixture
def given(tmp_path):
    """The node's ROS parameters but for files; it runs until it is told to end."""
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(scenario_file.to_yaml(**{SECTION: CONFIG}))
    return {"scenario": scenario, "picture_period_s": 0.2, "idle_s": 1000.0}


def words(given):
    return [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]


def handled(pipeline, steps):
    """What the filter makes of simulated `steps`."""
    records = []
    for topic, data in sent(steps):
        robot, _, kind = topic.name.partition("/")
        decode = wire.decode_pose if kind == "odom" else wire.decode_observations
        records += pipeline.handle(decode(data, robot))
    return records


def pipeline_after(steps, config=CONFIG):
    pipeline = Pipeline(config, keeps_frames=False)
    handled(pipeline, steps)
    return pipeline


def timeless(record):
    return wire.encode_step(replace(record, duration_ms=0.0))


def content(kept):
    return {name: getattr(kept, name).tobytes() for name in map_files.LAYOUT}


class Team:
    """A fusion in this process, whoever listens, and calls of its services."""

    def __init__(self, *outputs):
        self.node = fusion.Fusion()
        self.listener = nodes.Listener(topics.STEPS, topics.DIAGNOSTICS, *outputs)
        self._clients = {}

    def hear(self, steps):
        """Send `steps`, and wait until they are filtered; the steps of the filter so far."""
        self.listener.send(sent(steps))
        last_ns = steps[-1][0].odometry.stamp_ns
        self.until(lambda: self.newest_ns() == last_ns)
        return [wire.decode_step(data) for data in self.listener.heard[topics.STEPS]]

    def newest_ns(self):
        heard = self.listener.heard[topics.STEPS]
        return wire.decode_step(heard[-1]).stamp_ns if heard else 0

    def until(self, condition):
        nodes.spin_until(condition, self.node, self.listener)

    def call(self, kind, name, **request):
        client = self._clients.setdefault(name, self.listener.create_client(kind, name))
        self.until(client.service_is_ready)
        answer = client.call_async(kind.Request(**request))
        self.until(answer.done)
        return answer.result()

    def set(self, name, value):
        assert self.node.set_parameters([rclpy_parameter.Parameter(name, value=str(value))])[
            0
        ].successful


def test_a_map_is_saved_and_the_next_fusion_begins_in_it(given, tmp_path):
    with nodes.ros(*words(given | {"map_out": tmp_path / "a.npz"})):
        team = Team()
        team.hear(STEPS[:30])
        answer = team.call(srv.Trigger, "/fusion/save_map")
        assert answer.success
        assert str(tmp_path / "a.npz") in answer.message
        team.set("map_out", tmp_path / "no" / "b.npz")
        assert not team.call(srv.Trigger, "/fusion/save_map").success
        team.node.close()
    file = map_files.read(tmp_path / "a.npz")
    assert file.about["stamp_ns"] == STEPS[29][0].odometry.stamp_ns
    assert content(file.kept) == content(map_files.closed(pipeline_after(STEPS[:30])))
    with nodes.ros(*words(given | {"map": tmp_path / "a.npz"})):
        team = Team()
        records = team.hear(STEPS[:5])
        known = np.isin(records[0].frames[0].landmarks, file.kept.ids)
        assert known.mean() > 0.5
        team.node.close()


def test_a_map_is_loaded_and_what_was_begun_is_forgotten(given, tmp_path):
    kept = map_files.closed(pipeline_after(STEPS[:30]))
    map_files.write(tmp_path / "a.npz", map_files.about(CONFIG, 1), kept)
    with nodes.ros(*words(given)):
        team = Team()
        team.hear(STEPS[:10])
        assert "map is empty" in team.call(srv.Trigger, "/fusion/load_map").message
        team.set("map", tmp_path / "no.npz")
        assert "no file" in team.call(srv.Trigger, "/fusion/load_map").message
        assert team.hear(STEPS[10:12])[-1].step == 12
        team.set("map", tmp_path / "a.npz")
        assert team.call(srv.Trigger, "/fusion/load_map").success
        record = team.hear(STEPS[12:13])[-1]
        assert record.step == 1
        assert np.isin(record.frames[0].landmarks, kept.ids).any()
        assert team.call(srv.Trigger, "/fusion/reset").success
        assert team.hear(STEPS[13:14])[-1].step == 1
        team.node.close()


@pytest.mark.parametrize("mapping", [True, False])
def test_robots_start_anywhere_in_a_loaded_map(given, tmp_path, mapping):
    """They have a pose once they are found, and do what they do offline."""
    kept = map_files.closed(pipeline_after(STEPS[:60]))
    map_files.write(tmp_path / "a.npz", map_files.about(CONFIG, 1), kept)
    nowhere = f"[{', '.join(['.nan'] * 6)}]"
    anywhere = {"start_poses": nowhere, "filter.mapping": str(mapping).lower()}
    own = replace(CONFIG.filter, mapping=mapping)
    config = replace(CONFIG, start_poses=("unknown", "unknown"), filter=own)
    records = handled(Pipeline(config, keeps_frames=False, kept=kept), STEPS[:60])
    with nodes.ros(*words(given | anywhere | {"map": tmp_path / "a.npz"})):
        team = Team(*map(topics.pose, CONFIG.robots))
        steps = team.hear(STEPS[:60])
        team.node.close()
    assert [timeless(step) for step in steps] == [timeless(record) for record in records]
    for robot in CONFIG.robots:
        first = next(e for record in records for e in record.estimates if e.robot == robot)
        assert first.stamp_ns > records[0].stamp_ns
        heard = wire.decode_estimate(team.listener.heard[topics.pose(robot)][0], robot)
        assert heard.stamp_ns == first.stamp_ns
    with nodes.ros(*words(given | anywhere)), pytest.raises(InputError, match="load "):
        fusion.Fusion()


def test_a_bad_map_is_refused_at_the_start(given, tmp_path):
    (tmp_path / "a.npz").write_text("hello")
    parameters = words(given | {"map": tmp_path / "a.npz"})
    with nodes.ros(*parameters), pytest.raises(InputError, match="damaged"):
        fusion.Fusion()


def test_while_it_is_paused_nothing_is_used_and_nothing_counts_as_lost(given):
    with nodes.ros(*words(given)):
        team = Team()
        team.hear(STEPS[:20])
        assert team.call(srv.SetBool, "/fusion/pause", data=True).message == "paused"
        team.listener.send(sent(STEPS[20:26]))
        received = team.node.received
        team.until(lambda: team.node.received >= received + len(sent(STEPS[20:26])))

        def is_told():
            heard = team.listener.heard[topics.DIAGNOSTICS]
            return heard and "paused" in wire.decode_diagnostics(heard[-1])[1][0].message

        team.until(is_told)
        assert team.newest_ns() == STEPS[19][0].odometry.stamp_ns
        assert team.call(srv.SetBool, "/fusion/pause", data=False).success
        records = team.hear(STEPS[26:45])
        assert records[20].stamp_ns == STEPS[26][0].odometry.stamp_ns
        assert team.node.fusing.pipeline.lost() == pipeline_after(STEPS[:20]).lost()
        team.node.close()


def test_killed_it_goes_on_from_its_state(given, tmp_path, spawn):
    """The process is killed with -9; what it had not saved by then is a gap, and no more.

    So the next one does what the first would have done if it had heard nothing for a while.
    """
    saved = tmp_path / "state.npz"
    given = given | {"autosave": saved, "autosave_s": 0.2}
    command = (sys.executable, "-m", fusion.__name__, "--ros-args", *words(given))

    def begin():
        process = spawn(*command, stderr=subprocess.PIPE, text=True)
        nodes.wait_for_line(process, "other machines are not heard")
        return process

    with nodes.ros():
        listener = nodes.Listener(topics.STEPS)
        first = begin()
        listener.send(sent(STEPS[:30]))

        def is_saved():
            last_ns = STEPS[29][0].odometry.stamp_ns
            return saved.exists() and map_files.read_about(saved)["stamp_ns"] == last_ns

        nodes.spin_until(is_saved, listener)
        first.send_signal(signal.SIGKILL)
        first.wait()
    expected = map_files.pipeline_of(map_files.read(saved), pytest.fail)
    with nodes.ros():
        listener = nodes.Listener(topics.STEPS)
        second = begin()
        nodes.spin_until(listener.is_connected, listener)
        listener.send(sent(STEPS[34:]))
        last_ns = STEPS[-1][0].odometry.stamp_ns
        steps = listener.heard[topics.STEPS]
        nodes.spin_until(
            lambda: steps and wire.decode_step(steps[-1]).stamp_ns == last_ns, listener
        )
        second.send_signal(signal.SIGINT)
        assert second.wait(nodes.PATIENCE_S) == 0
    expected.pause()
    records = handled(expected, STEPS[34:])
    assert records[0].step == 31
    assert [timeless(wire.decode_step(data)) for data in steps] == [*map(timeless, records)]
    file = map_files.read(saved)
    assert file.state is None  # it ended in order: there is nothing to go on from
    assert file.about["stamp_ns"] == last_ns


def test_who_goes_on_says_so_only_where_that_can_be(given, tmp_path):
    saved = tmp_path / "state.npz"
    told = []
    autosave = keeping.Autosave(str(saved), CONFIG, told.append)
    assert autosave.resumed() is None
    pipeline = pipeline_after(STEPS[:12])
    assert autosave.save(pipeline, 5)
    autosave._writer.shutdown()
    assert autosave.resumed().stamp_ns == 5
    assert told == []
    other = keeping.Autosave(str(saved), replace(CONFIG, seed=9), told.append)
    assert other.resumed() is None
    assert "another configuration" in told.pop()
    keeping.Autosave(str(saved), CONFIG, told.append).end(pipeline, 6)
    assert autosave.resumed() is None
    assert told == []
    saved.write_bytes(b"junk")
    assert autosave.resumed() is None
    assert "beginning anew" in told.pop()


@pytest.mark.parametrize(("late_s", "goes_on"), [(30, True), (90, False)])
def test_after_too_long_it_begins_anew(given, tmp_path, late_s, goes_on):
    saved = tmp_path / "state.npz"
    autosave = keeping.Autosave(str(saved), CONFIG, pytest.fail)
    stamp_ns = STEPS[12][0].odometry.stamp_ns - late_s * 10**9
    assert autosave.save(pipeline_after(STEPS[:12]), stamp_ns)
    autosave._writer.shutdown()
    with nodes.ros(*words(given | {"autosave": saved, "autosave_s": 100.0})):
        team = Team()
        record = team.hear(STEPS[12:14])[0]
        assert record.step == (13 if goes_on else 1)
        team.node.close()


def test_what_cannot_be_written_is_told_and_the_fusion_goes_on(tmp_path):
    told = []
    autosave = keeping.Autosave(str(tmp_path / "no" / "state.npz"), CONFIG, told.append)
    pipeline = pipeline_after(STEPS[:5])
    assert autosave.save(pipeline, 5)
    autosave._writing.exception()
    assert autosave.save(pipeline, 6)
    assert "cannot write" in told.pop()
