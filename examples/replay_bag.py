"""Paths and map from a recorded bag, without ROS.

python examples/replay_bag.py BAG
"""

import sys
from pathlib import Path

from multi_robot_slam import Config, InputError, Pipeline, events, recorded_config


def main(bag: Path) -> None:
    config = recorded_config(bag) or Config()
    pipeline = Pipeline(config, warn=print)
    for event in events(bag, config, pipeline.refuse):
        pipeline.handle(event)
    pipeline.finish()
    for robot, path in pipeline.trajectories().items():
        x, y, yaw = path.poses[-1]
        print(f"{robot}: {len(path.poses)} poses, the last at {x:.2f} m, {y:.2f} m, {yaw:.2f} rad")
    print(len(pipeline.landmark_map().ids), "landmarks")


if __name__ == "__main__":
    try:
        if len(sys.argv) != 2:
            raise InputError("name the bag: python examples/replay_bag.py BAG")
        main(Path(sys.argv[1]))
    except InputError as error:
        print("error:", error, file=sys.stderr)
        sys.exit(2)
