"""Paths and map from a recorded bag, without ROS.

python examples/replay_bag.py BAG
"""

import sys
from pathlib import Path

from multi_robot_slam.config import Config
from multi_robot_slam.pipeline import offline
from multi_robot_slam.pipeline.pipeline import Pipeline

bag = Path(sys.argv[1])
config = offline.recorded_config(bag) or Config()
pipeline = Pipeline(config, warn=print)
for event in offline.events(bag, config):
    pipeline.handle(event)
pipeline.finish()
for robot, path in pipeline.trajectories().items():
    x, y, yaw = path.poses[-1]
    print(f"{robot}: {len(path.poses)} poses, the last at {x:.2f} m, {y:.2f} m, {yaw:.2f} rad")
print(len(pipeline.landmark_map().ids), "landmarks")
