"""What a bag holds apart from estimates: odometry, and the truth where there is any."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from msg_defs import topics, wire
from msg_defs.topics import Topic
from msg_defs.types import Trajectory
from multi_robot_slam.bags import BagReader
from multi_robot_slam.runs.run import Recorded, by_stamp


def recorded(path: Path, robots: Iterable[str], namespace: str | None = None) -> Recorded:
    """Odometry and truth of `robots` in the bag at `path`, which need not hold estimates.

    `namespace` is that in which the team was recorded; by default the only one in which a robot's
    odometry is. `InputError` when there are several.
    """
    robots, reader = tuple(robots), BagReader(path)
    found = reader.find_namespace([topics.odometry(robot) for robot in robots], namespace)
    return join(reader, reader.by_topic(topics_of(robots), found), robots, found)


def topics_of(robots: Iterable[str]) -> list[Topic]:
    """Everything that is read of the recording of the team `robots`."""
    kinds = (topics.odometry, topics.ground_truth, topics.observation_truth)
    own = [kind(robot) for robot in robots for kind in kinds]
    return [topics.GROUND_TRUTH_LANDMARKS, topics.GROUND_TRUTH_WALLS, *own]


def join(
    reader: BagReader, messages: Mapping[Topic, list[bytes]], robots: Iterable[str], namespace: str
) -> Recorded:
    """The recording whose `messages` were read from the bag of `reader`."""
    robots = tuple(robots)

    def poses(kind: Callable[[str], Topic]) -> dict[str, Trajectory]:
        found = {robot: messages[kind(robot)] for robot in robots}
        return {
            robot: by_stamp(*wire.decode_poses(stream, robot))
            for robot, stream in found.items()
            if stream
        }

    true_maps = messages[topics.GROUND_TRUTH_LANDMARKS]
    walls = messages[topics.GROUND_TRUTH_WALLS]
    seen = [
        wire.decode_observation_truth(data, robot)
        for robot in robots
        for data in messages[topics.observation_truth(robot)]
    ]
    return Recorded(
        odometry=poses(topics.odometry),
        truth=poses(topics.ground_truth),
        true_landmarks=wire.decode_map(true_maps[-1]) if true_maps else None,
        walls=wire.decode_walls(walls[-1]) if walls else None,
        observation_truth={(truth.robot, truth.stamp_ns): truth.landmarks for truth in seen},
        warnings=tuple(reader.warnings),
        bag=reader.path.resolve(),
        namespace=namespace,
    )
