"""Bags as a recorder would leave them, written without ROS and in a moment."""

from itertools import islice

from msg_defs import scenario_file, topics, wire
from multi_robot_slam.bags import BagWriter
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.filter.settings import FilterSettings
from multi_robot_slam.pipeline.pipeline import Pipeline
from sim_world.robot import START_NS
from sim_world.scenario import Scenario
from sim_world.simulator import Simulation


def configuration(simulation, **of_filter):
    """What the fusion is told of the simulated team."""
    starts = simulation.start_poses
    return Config(
        robots=tuple(starts),
        start_poses=tuple(tuple(pose.tolist()) for pose in starts.values()),
        start_sigma=(0.0, 0.0),
        mount=simulation.scenario.camera.mount,
        filter=FilterSettings(**of_filter),
    )


def messages_of(step):
    """All that the robots publish of one simulated step: (topic, bytes)."""
    for robot in step:
        name = robot.odometry.robot
        odom, base = topics.odom_frame(name), topics.base_frame(name)
        yield topics.odometry(name), wire.encode_pose(robot.odometry, odom, base)
        yield topics.observations(name), wire.encode_observations(robot.observations)
        yield topics.ground_truth(name), wire.encode_pose(robot.truth, topics.MAP_FRAME, base)
        yield topics.observation_truth(name), wire.encode_observation_truth(robot.observation_truth)


def padded(data):
    """As it comes out of DDS, which fills up messages with zeros to a multiple of four bytes.

    A message that is sent in fragments, from 64 kB on, comes as it was.
    """
    return data + bytes(-len(data) % 4)


def record(folder, scenario=None, seed=0, steps=None, is_live=False, **of_filter):
    """Write a bag of a simulated team and of its fusion's configuration; the two.

    Only the first `steps` are written, if given; with `is_live` the fusion's estimates, too.
    """
    simulation = Simulation(scenario or Scenario(robots=2, movements=40, observations=5), seed)
    config = configuration(simulation, **{"particles": 20} | of_filter)
    world = (
        (topics.GROUND_TRUTH_LANDMARKS, wire.encode_map(simulation.landmarks, START_NS)),
        (topics.GROUND_TRUTH_WALLS, wire.encode_walls(simulation.walls, START_NS)),
        (topics.FUSION_CONFIG, wire.encode_text(scenario_file.to_yaml(**{SECTION: config}))),
    )
    with BagWriter(folder) as bag:
        for topic, data in world:
            bag.write(topic, START_NS, data)
        for step in islice(simulation.steps(), steps):
            for topic, data in messages_of(step):
                bag.write(topic, step[0].odometry.stamp_ns, data)
        if is_live:
            for topic, data in estimates(simulation, config):
                bag.write(topic, START_NS, data)
    return simulation, config


def estimates(simulation, config):
    """What the fusion publishes of it: (topic, bytes)."""
    pipeline = Pipeline(config)
    events = (e for step in simulation.steps() for r in step for e in (r.odometry, r.observations))
    records = [record for event in events for record in pipeline.handle(event)] + pipeline.finish()
    for record in records:
        yield topics.STEPS, wire.encode_step(record)
        for estimate in record.estimates:
            yield topics.pose(estimate.robot), wire.encode_estimate(estimate)
            yield topics.mean_pose(estimate.robot), wire.encode_mean(estimate)
    yield topics.MAP_LANDMARKS, wire.encode_map(pipeline.landmark_map(), START_NS)
    for robot, path in pipeline.trajectories().items():
        yield topics.path(robot), wire.encode_path(path, START_NS)
