"""Two robots of your own: odometry and observations as arrays in, paths and map out.

python examples/own_data.py
"""

import numpy as np

from multi_robot_slam import Config, FilterSettings, ObservationSet, Pipeline, PoseSample

# Alice follows Bob along x, and both see three posters: where they hang, and what they look like.
# No two look alike, so the gate need not tell them apart and may be wide.
config = Config(
    robots=("alice", "bob"),
    start_poses=((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)),
    filter=FilterSettings(gate=25.0),
)
posters = np.array([[4.0, 1.0, 1.2], [5.0, -1.0, 1.5], [6.0, 0.5, 0.8]])
looks = np.eye(3, 128, dtype=np.float32)
sigma_m = 0.02
covariances = np.tile(np.float32([1, 0, 0, 1, 0, 1]) * sigma_m**2, (3, 1))  # xx xy xz yy yz zz

rng, pipeline = np.random.default_rng(0), Pipeline(config, warn=print)
for step in range(9):
    for robot, (start, *_) in zip(config.robots, config.start_poses, strict=True):
        driven_m, stamp_ns = 0.25 * step, 1 + step * 500_000_000
        measured = np.array([driven_m * 1.02, 0.0, 0.0])  # the wheels slip a little
        pipeline.handle(PoseSample(robot, stamp_ns, measured))
        forward, left, up = (posters - [start + driven_m, 0.0, 0.0]).T
        camera = config.mount
        seen = np.column_stack([camera.left_m - left, up - camera.up_m, forward - camera.forward_m])
        seen = (seen + sigma_m * rng.standard_normal(seen.shape)).astype(np.float32)
        pipeline.handle(ObservationSet(robot, stamp_ns, seen, covariances, looks))
pipeline.finish()

for robot, path in pipeline.trajectories().items():
    x, y, yaw = path.poses[-1]
    print(f"{robot} ends at x = {x:.2f} m, y = {y:.2f} m, yaw = {yaw:.3f} rad")
for x, y, z in pipeline.landmark_map().positions:
    print(f"a poster at x = {x:.2f} m, y = {y:.2f} m, z = {z:.2f} m")
