"""What a fusion would have published of a run that was made up, as topics and in bags."""

import numpy as np

from msg_defs import scenario_file, topics, wire
from msg_defs.types import LandmarkMap
from multi_robot_slam.bags import BagWriter
from multi_robot_slam.config import SECTION
from test.helpers import fake_run

LATE_NS = 20_000_000
"""How long after its stamp a message was recorded."""


def part(landmarks, count):
    """The first landmarks of a map."""
    return LandmarkMap(*(value[:count] for value in vars(landmarks).values()))


def statuses(run, step):
    """How the fusion is after a step."""
    values = {"steps": str(step.step), "lag [s]": f"{0.01 * step.step:.3f}", "dropped: late": "2"}
    robots = [
        wire.Status(f"fusion: {name}", {"frames": "7"}, message="heard") for name in run.robots
    ]
    return [wire.Status("fusion", values, wire.WARN, "messages were dropped"), *robots]


def messages(run):
    """(stamp [ns], topic, bytes) of everything, by time; the map has grown by one at each step."""
    first_ns = run.steps[0].stamp_ns
    config = scenario_file.to_yaml(**{SECTION: run.config})
    yield first_ns, topics.FUSION_CONFIG, wire.encode_text(config)
    yield first_ns, topics.GROUND_TRUTH_WALLS, wire.encode_walls(run.walls, first_ns)
    for count, step in enumerate(run.steps, start=1):
        stamp_ns = step.stamp_ns
        yield stamp_ns, topics.STEPS, wire.encode_step(step)
        for estimate in step.estimates:
            yield stamp_ns, topics.pose(estimate.robot), wire.encode_estimate(estimate)
            cloud = estimate.pose + np.random.default_rng(count).normal(0, 0.1, (50, 3))
            particles = topics.particles(estimate.robot)
            yield stamp_ns, particles, wire.encode_particles(cloud, stamp_ns)
        landmarks = wire.encode_map(part(run.landmarks, count), stamp_ns)
        yield stamp_ns, topics.MAP_LANDMARKS, landmarks
        diagnostics = wire.encode_diagnostics(stamp_ns, statuses(run, step))
        yield stamp_ns, topics.DIAGNOSTICS, diagnostics
    for name, robot in run.robots.items():
        yield stamp_ns, topics.path(name), wire.encode_path(robot.path, stamp_ns)


def record(folder, run=None):
    """Write a live run's bag; the run."""
    run = run or fake_run()
    with BagWriter(folder) as bag:
        for stamp_ns, topic, data in messages(run):
            bag.write(topic, stamp_ns + LATE_NS, data)
    return run
