"""What the fusion publishes of the estimate."""

from collections.abc import Iterable

import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher

from msg_defs import scenario_file, topics, wire
from msg_defs.ros.endpoints import is_available, publisher
from msg_defs.types import Estimate, StepRecord
from multi_robot_slam.config import SECTION, Config
from multi_robot_slam.models.motion import odom_in_map
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.pipeline.thinning import thinned


class Outputs:
    """The publishers of a fusion; its configuration is published when it begins."""

    def __init__(self, node: Node, config: Config, publish_tf: bool) -> None:
        has_tf = is_available(topics.TF)
        if publish_tf and not has_tf:
            node.get_logger().info("no /tf: tf2_msgs is not installed; it comes with ROS")
        wanted = topics.fusion_outputs(config.robots)
        self.publishes_tf = publish_tf
        self._node, self._config = node, config
        self._has_pieces = False
        self._publishers = {
            topic: publisher(node, topic) for topic in wanted if has_tf or topic != topics.TF
        }
        self.begin(config)

    def begin(self, config: Config) -> None:
        """Publish the configuration of the run that begins."""
        text = scenario_file.to_yaml(**{SECTION: config})
        self._publish(topics.FUSION_CONFIG, wire.encode_text(text))

    def close(self) -> None:
        """Let go of all topics."""
        for one in self._publishers.values():
            self._node.destroy_publisher(one)

    @property
    def _sends_tf(self) -> bool:
        return self.publishes_tf and topics.TF in self._publishers

    @property
    def names(self) -> set[str]:
        """The whole names of all topics."""
        return {one.topic_name for one in self._publishers.values()}

    @property
    def steps_name(self) -> str:
        """The whole name of the topic with the steps."""
        return str(self._publishers[topics.STEPS].topic_name)

    def lossless(self) -> list[Publisher]:
        """Publishers of which no message may be missing in a recording."""
        kinds = (topics.pose, topics.mean_pose)
        poses = [kind(robot) for robot in self._config.robots for kind in kinds]
        return [self._publishers[topic] for topic in (topics.STEPS, *poses)]

    def steps(self, steps: Iterable[StepRecord], pipeline: Pipeline) -> None:
        """Publish what was done; the newest poses also as transforms."""
        newest: dict[str, Estimate] = {}
        for step in steps:
            self._publish(topics.STEPS, wire.encode_step(step))
            for estimate in step.estimates:
                self._publish(topics.pose(estimate.robot), wire.encode_estimate(estimate))
                self._publish(topics.mean_pose(estimate.robot), wire.encode_mean(estimate))
                newest[estimate.robot] = estimate
        if self._sends_tf:
            for estimate in newest.values():
                odometry = pipeline.odometry_pose(estimate.robot)
                self._publish(topics.TF, _transform(estimate, odometry))

    def prediction(self, estimate: Estimate, odometry: np.ndarray) -> None:
        """Publish where a robot has gone since its last step, when its `odometry` (3,) came."""
        self._publish(topics.pose(estimate.robot), wire.encode_estimate(estimate))
        if self._sends_tf:
            self._publish(topics.TF, _transform(estimate, odometry))

    def pictures(self, stamp_ns: int, pipeline: Pipeline, are_whole: bool = False) -> int:
        """Publish map, paths and particles; the number of landmarks.

        Long paths are thinned unless they are to be whole, as at the end.
        """
        landmarks, paths = pipeline.landmark_map(), pipeline.trajectories()
        if not are_whole:
            paths = {robot: thinned(path) for robot, path in paths.items()}
        self._publish(topics.MAP_LANDMARKS, wire.encode_map(landmarks, stamp_ns))
        self._pieces(stamp_ns, pipeline)
        self._publish(topics.MAP_MARKERS, wire.encode_markers(landmarks, paths, stamp_ns))
        for robot, path in paths.items():
            particles = pipeline.particles(robot)
            self._publish(topics.path(robot), wire.encode_path(path, stamp_ns))
            self._publish(topics.particles(robot), wire.encode_particles(particles, stamp_ns))
        return len(landmarks.ids)

    def _pieces(self, stamp_ns: int, pipeline: Pipeline) -> None:
        """Publish what is not in the map, as long as there is something, and then that it is."""
        landmarks, pieces = pipeline.unplaced()
        if len(pieces) or self._has_pieces:
            self._publish(topics.PIECES, wire.encode_pieces(landmarks, pieces, stamp_ns))
        self._has_pieces = bool(len(pieces))

    def diagnostics(self, stamp_ns: int, statuses: list[wire.Status]) -> None:
        """Publish how the fusion is."""
        self._publish(topics.DIAGNOSTICS, wire.encode_diagnostics(stamp_ns, statuses))

    def _publish(self, topic: topics.Topic, data: bytes) -> None:
        self._publishers[topic].publish(data)


def _transform(estimate: Estimate, odometry: np.ndarray) -> bytes:
    """Pose of the robot's `odom` frame in `map` that puts its `odometry` at the estimate."""
    pose = odom_in_map(estimate.pose, odometry)
    frame_id = topics.odom_frame(estimate.robot)
    return wire.encode_transform(estimate.stamp_ns, topics.MAP_FRAME, frame_id, pose)
