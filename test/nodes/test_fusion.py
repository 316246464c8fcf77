import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import recordings
from hypothesis import given
from hypothesis import strategies as st

from msg_defs import scenario_file, topics, wire
from msg_defs.errors import InputError
from msg_defs.types import Sightings, StepRecord
from msg_defs.wire.messages import PointCloud2, decode, encode
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.filter import rbpf
from multi_robot_slam.models.motion import move, odom_in_map, wrap
from multi_robot_slam.pipeline.pipeline import Pipeline
from sim_world.scenario import Scenario
from sim_world.simulator import Simulation

nodes = pytest.importorskip("nodes")
fusion = pytest.importorskip("multi_robot_slam.nodes.fusion")
pytest.importorskip("multi_robot_slam.nodes.outputs")

pytestmark = pytest.mark.usefixtures("ros_domain_id")

SIMULATION = Simulation(Scenario(robots=2, movements=20, observations=5), seed=3)
CONFIG = recordings.configuration(SIMULATION, particles=10)
STEPS = list(SIMULATION.steps())
OUTPUTS = [
    topics.STEPS,
    topics.MAP_LANDMARKS,
    topics.DIAGNOSTICS,
    topics.FUSION_CONFIG,
    *(
        topic(name)
        for name in CONFIG.robots
        for topic in (topics.pose, topics.mean_pose, topics.path)
    ),
]


@pytest.fixture
def parameters(tmp_path):
    """ROS arguments that give `CONFIG`, and little patience."""
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(scenario_file.to_yaml(**{SECTION: CONFIG}))
    given = f"scenario:={scenario}", "picture_period_s:=0.05", "idle_s:=0.2", "stop_after_s:=0.3"
    return [word for parameter in given for word in ("-p", parameter)]


def messages(step):
    """What the fusion hears of one simulated step: (topic, bytes)."""
    truths = (topics.ground_truth, topics.observation_truth)
    unheard = {truth(name) for truth in truths for name in CONFIG.robots}
    return [sent for sent in recordings.messages_of(step) if sent[0] not in unheard]


def run(arguments, sent):
    """What a fusion says, by topic, when it is `sent` (topic, bytes)."""
    with nodes.ros(*arguments):
        node, listener = fusion.Fusion(), nodes.Listener(*OUTPUTS)
        listener.send(sent)
        nodes.spin_until(lambda: node.done, node, listener)
        node.close()
        nodes.spin_until(lambda: listener.heard[topics.MAP_LANDMARKS], listener)
        return listener.heard


def dropped(heard):
    """Reason -> count, of the last diagnostics."""
    _, (status, *_) = wire.decode_diagnostics(heard[topics.DIAGNOSTICS][-1])
    prefix = "dropped: "
    return {k.removeprefix(prefix): v for k, v in status.values.items() if k.startswith(prefix)}


def timeless(record: StepRecord):
    return wire.encode_step(replace(record, duration_ms=0.0))


def filtered():
    """The steps and the pipeline that result from decoding and handling every message."""
    pipeline, records = Pipeline(CONFIG), []
    for step in STEPS:
        for topic, data in messages(step):
            robot, _, kind = topic.name.partition("/")
            decode = wire.decode_pose if kind == "odom" else wire.decode_observations
            records += pipeline.handle(decode(data, robot))
    return records, pipeline


def everything():
    return [message for step in STEPS for message in messages(step)]


def in_frame(data, template):
    """The cloud in another frame; {robot} stands for the robot's name."""
    cloud = decode(PointCloud2, data, "cloud")
    cloud.header.frame_id = topics.camera_frame(cloud.header.frame_id.split("/")[0], template)
    return encode(cloud)


def test_live_estimates_equal_those_of_the_pipeline(parameters):
    heard = run(parameters, everything())
    records, pipeline = filtered()
    assert [timeless(wire.decode_step(data)) for data in heard[topics.STEPS]] == [
        timeless(record) for record in records
    ]
    for index, robot in enumerate(CONFIG.robots):
        at_steps = [wire.encode_estimate(record.estimates[index]) for record in records]
        assert [data for data in heard[topics.pose(robot)] if data in at_steps] == at_steps
        assert heard[topics.mean_pose(robot)] == [
            wire.encode_mean(record.estimates[index]) for record in records
        ]
        path = wire.decode_path(heard[topics.path(robot)][-1], robot)
        np.testing.assert_allclose(path.poses, pipeline.trajectories()[robot].poses, atol=1e-12)
    stamp_ns = STEPS[-1][0].odometry.stamp_ns
    assert heard[topics.MAP_LANDMARKS][-1] == wire.encode_map(pipeline.landmark_map(), stamp_ns)
    assert dropped(heard) == {}
    (config,) = heard[topics.FUSION_CONFIG]
    assert scenario_file.from_yaml(Config, wire.decode_text(config), SECTION) == CONFIG


def test_damaged_messages_are_counted_and_the_fusion_goes_on(parameters):
    between_ns = (STEPS[0][0].odometry.stamp_ns + STEPS[1][0].odometry.stamp_ns) // 2
    infinite = STEPS[0][0].observations.positions * np.inf

    def cloud(number, **changes):
        seen = replace(STEPS[0][0].observations, stamp_ns=between_ns + number)
        return wire.encode_observations(replace(seen, **changes))

    of_first = topics.observations("robot_1")
    damaged = [
        (of_first, cloud(1).replace(b"descriptor", b"descripted")),
        (of_first, cloud(2, positions=infinite)),
        (of_first, cloud(3, robot="robot_9")),
        (of_first, cloud(4)[:-40]),
        (of_first, b""),
        (topics.odometry("robot_2"), cloud(5)),
    ]
    first, *others = STEPS
    sent = [*messages(first), *damaged, *(m for step in others for m in messages(step))]
    heard = run(parameters, sent)
    assert dropped(heard) == {"bad observations of robot_1": "5", "bad odometry of robot_2": "1"}
    assert [wire.decode_step(data).step for data in heard[topics.STEPS]] == list(
        range(1, len(STEPS) + 1)
    )


def test_decodable_nonsense_is_lost_alone(parameters):
    """Each of these ended the fusion and its map."""
    first = STEPS[0][0]
    seen, step_ns = (
        first.observations,
        STEPS[1][0].odometry.stamp_ns - STEPS[0][0].odometry.stamp_ns,
    )
    between = first.odometry.stamp_ns + step_ns // 2
    isotropic = np.array([1, 0, 0, 1, 0, 1], np.float32)
    odd_clouds = [
        replace(seen, covariances=seen.covariances * 0 + isotropic * np.float32(3e38)),
        replace(seen, covariances=seen.covariances * 0 + isotropic * np.float32(1e-14)),
        replace(seen, positions=seen.positions * 0 + np.float32(1e19)),
        replace(seen, descriptors=seen.descriptors * 0),
    ]
    odd_odometry = [
        replace(first.odometry, pose=np.array([1e150, 0, 0]), stamp_ns=between),
        replace(first.odometry, pose=np.array([1e7, 0, 0]), stamp_ns=between + 1),
    ]
    odd = [
        (topics.observations("robot_1"), wire.encode_observations(replace(e, stamp_ns=between + i)))
        for i, e in enumerate(odd_clouds)
    ] + [
        (topics.odometry("robot_1"), wire.encode_pose(e, "robot_1/odom", "robot_1/base_link"))
        for e in odd_odometry
    ]
    sent = [*messages(STEPS[0]), *odd, *(m for step in STEPS[1:] for m in messages(step))]
    heard = run(parameters, sent)
    assert dropped(heard) == {
        "implausible observations": "3",
        "implausible descriptors": "1",
        "implausible odometry": "1",
        "odometry jump": "1",
    }
    records, _ = filtered()
    assert [timeless(wire.decode_step(data)) for data in heard[topics.STEPS]] == [
        timeless(record) for record in records
    ]


@pytest.mark.parametrize("kind", [topics.odometry, topics.observations])
def test_one_stamp_far_ahead_does_not_make_the_team_start_over(parameters, kind):
    place = 6
    event = STEPS[place][1].odometry if kind is topics.odometry else STEPS[place][1].observations
    odd = replace(event, stamp_ns=event.stamp_ns + 6 * 10**9)
    data = (
        wire.encode_pose(odd, "robot_2/odom", "robot_2/base_link")
        if kind is topics.odometry
        else wire.encode_observations(odd)
    )
    before = [m for step in STEPS[:place] for m in messages(step)]
    after = [m for step in STEPS[place:] for m in messages(step)]
    heard = run(parameters, [*before, (kind("robot_2"), data), *after])
    assert dropped(heard) == {"stamp far ahead": "1"}
    records, _ = filtered()
    assert [timeless(wire.decode_step(data)) for data in heard[topics.STEPS]] == [
        timeless(record) for record in records
    ]


def test_a_failed_step_is_an_error_in_the_diagnostics(parameters, monkeypatch):
    right, done = rbpf.step, []

    def fails(*arguments):
        done.append(arguments)
        if len(done) > 5:
            raise np.linalg.LinAlgError("singular")
        return right(*arguments)

    with nodes.ros(*parameters):
        node, listener = fusion.Fusion(), nodes.Listener(*OUTPUTS)
        monkeypatch.setattr(rbpf, "step", fails)
        listener.send(everything())
        nodes.spin_until(lambda: node.done, node, listener)
        node.close()
        nodes.spin_until(lambda: listener.heard[topics.MAP_LANDMARKS], listener)
        heard = listener.heard
    levels = [wire.decode_diagnostics(d)[1][0].level for d in heard[topics.DIAGNOSTICS]]
    assert wire.ERROR in levels
    assert int(dropped(heard)["failed step"]) == len(STEPS) - 5
    assert len(heard[topics.STEPS]) == 5


def test_the_clouds_frame_is_a_setting(parameters):
    def sent(frame):
        return [
            (topic, in_frame(data, frame)) if "stereo" in topic.name else (topic, data)
            for topic, data in everything()
        ]

    heard = run([*parameters, "-p", "camera_frame:='cam/{robot}'"], sent("cam/{robot}"))
    assert dropped(heard) == {}
    assert len(heard[topics.STEPS]) == len(STEPS)
    heard = run([*parameters, "-p", "camera_frame:=''"], sent("whatever"))
    assert dropped(heard) == {}


def test_what_the_pipeline_drops_is_counted(parameters):
    heard = run(parameters, [*everything(), *messages(STEPS[-1])])
    assert dropped(heard) == {"duplicate frame": "2", "odometry out of order": "2"}


def test_frames_held_back_are_filtered_after_a_silence(parameters):
    only_first = [m for m in everything() if m[0].name.startswith("robot_1/")]
    heard = run([*parameters, "-p", "reorder_window_s:=1000.0"], only_first)
    assert len(heard[topics.pose("robot_1")]) == len(STEPS)
    assert heard[topics.pose("robot_2")] == []


def test_a_silent_robot_is_reported(parameters):
    only_first = [m for m in everything() if m[0].name.startswith("robot_1/")]
    heard = run(parameters, only_first)
    _, statuses = wire.decode_diagnostics(heard[topics.DIAGNOSTICS][-1])
    levels = {status.name: status.level for status in statuses}
    assert levels["fusion: robot_1"] == wire.OK
    assert levels["fusion: robot_2"] == wire.WARN


def test_two_fusions_say_so_until_one_is_gone(parameters, capfd):
    lasting = [*parameters[:-1], "stop_after_s:=0.0"]

    def levels(listener):
        found = [wire.decode_diagnostics(d)[1][0] for d in listener.heard[topics.DIAGNOSTICS]]
        listener.heard[topics.DIAGNOSTICS].clear()
        return {status.message[:14] for status in found if status.level == wire.ERROR}, len(found)

    with nodes.ros(*lasting):
        listener = nodes.Listener(topics.DIAGNOSTICS)
        first, second = fusion.Fusion(), fusion.Fusion()
        both = first.fusing.health, second.fusing.health
        nodes.spin_until(lambda: all(one.rival for one in both), first, second, listener)
        nodes.spin_until(lambda: levels(listener)[0] == {"another fusion"}, first, second, listener)
        assert capfd.readouterr().err.count("another fusion publishes /fusion/steps") == 2
        second.close()
        second.destroy_node()
        nodes.spin_until(lambda: not first.fusing.health.rival, first, listener)
        levels(listener)
        nodes.spin_until(lambda: levels(listener) == (set(), 1), first, listener)
        first.close()


def test_what_comes_in_waits_for_the_subscribers_that_are_expected(parameters):
    with nodes.ros(*parameters, "-p", "subscribers:=1"):
        node, sender = fusion.Fusion(), nodes.Listener(name="sender")
        sender.send(everything())
        nodes.spin_until(lambda: len(node.fusing.inbox) == len(everything()), node, sender)
        nodes.spin_until(nodes.rounds(50), node, sender)
        assert len(node.fusing.inbox) == len(everything())
        late = nodes.Listener(*OUTPUTS)
        nodes.spin_until(lambda: len(late.heard[topics.STEPS]) == len(STEPS), node, late)
        stamps = [step[0].odometry.stamp_ns for step in STEPS]
        for robot in CONFIG.robots:
            poses = [wire.decode_estimate(d, robot) for d in late.heard[topics.pose(robot)]]
            assert sorted({pose.stamp_ns for pose in poses}) == stamps


def test_sightings_reach_the_pipeline_where_robots_send_them(parameters):
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 6), np.float32)
    seen = [
        (
            topics.sightings(name),
            Sightings(name, step[0].odometry.stamp_ns, np.zeros(0, "u4"), *nothing),
        )
        for step in STEPS
        for name in CONFIG.robots
    ]
    sent = [(topic, wire.encode_sightings(sightings)) for topic, sightings in seen]
    heard = run([*parameters, "-p", "sightings:=true"], [*sent, *everything()])
    assert dropped(heard) == {}
    assert len(heard[topics.STEPS]) == len(STEPS)


def test_landmarks_without_a_place_in_the_map_are_told_apart(parameters):
    known = ", ".join(map(str, CONFIG.start_poses[0]))
    unknown = "-p", f"start_poses:=[{known}, .nan, .nan, .nan]"
    with nodes.ros(*parameters, *unknown):
        node = fusion.Fusion()
        listener = nodes.Listener(topics.PIECES, topics.MAP_LANDMARKS, topics.STEPS)
        listener.send(everything()[:24])
        nodes.spin_until(lambda: node.done, node, listener)
        node.close()
        nodes.spin_until(lambda: listener.heard[topics.PIECES], listener)
    apart, pieces = wire.decode_pieces(listener.heard[topics.PIECES][-1])
    in_map = wire.decode_map(listener.heard[topics.MAP_LANDMARKS][-1])
    assert set(pieces.tolist()) == set(apart.robots.tolist()) == {2}
    assert set(in_map.robots.tolist()) <= {1}
    assert not np.isin(apart.ids, in_map.ids).any()


def test_a_topic_that_nobody_publishes_is_told_with_what_is_there_instead(parameters):
    renamed = [
        (topic._replace(name=topic.name.replace("robot_1/odom", "robot1/odom")), data)
        for topic, data in everything()
        if topic != topics.odometry("robot_2")
    ]
    with nodes.ros(*parameters, "-p", "unheard_s:=0.5", "-p", "stop_after_s:=0.0"):
        node, listener = fusion.Fusion(), nodes.Listener(topics.DIAGNOSTICS)
        for topic, _ in renamed:
            nodes.endpoints.publisher(listener, topic)

        def unheard():
            heard = listener.heard[topics.DIAGNOSTICS]
            return heard and [
                text
                for key, text in wire.decode_diagnostics(heard[-1])[1][0].values.items()
                if key == "unheard: /robot_1/odom"
            ]

        nodes.spin_until(unheard, node, listener)
        assert "/robot1/odom would fit" in unheard()[0]


def test_works_under_a_namespace(parameters):
    with nodes.ros(*parameters, "-r", "__ns:=/team"):
        names = {name for name, _ in fusion.Fusion().get_topic_names_and_types()}
    assert {"/team/robot_1/odom", "/team/robot_2/pose", "/team/map/landmarks"} <= names


@pytest.mark.parametrize(
    ("argument", "reason"),
    [
        ("start_poses:=[0.0, 0.0, 0.0]", "1 poses for 2 robots"),
        ("robots:=[a, a]", "name each robot of the team once"),
        ("filter.particles:=0", "filter.particles = 0"),
    ],
)
def test_bad_parameter_is_refused_with_the_reason(parameters, argument, reason):
    with nodes.ros(*parameters, "-p", argument), pytest.raises(InputError, match=reason):
        fusion.Fusion()


poses = st.tuples(*[st.floats(-100, 100)] * 2, st.floats(-3, 3)).map(np.array)


@given(estimate=poses, odometry=poses)
def test_odometry_seen_from_the_map_is_the_estimate(estimate, odometry):
    pose = odom_in_map(estimate, odometry)[:, None]
    move(pose, odometry[:, None])
    difference = pose[:, 0] - estimate
    np.testing.assert_allclose([*difference[:2], wrap(difference[2])], 0, atol=1e-9)


def test_interrupt_ends_the_process(spawn):
    process = spawn(sys.executable, "-m", fusion.__name__, stderr=subprocess.PIPE, text=True)
    nodes.wait_for_line(process, "other machines are not heard")
    process.send_signal(signal.SIGINT)
    assert process.wait(nodes.PATIENCE_S) == 0
