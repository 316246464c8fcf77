"""What a simulation says, as (topic, CDR): the world once, and each robot's share of an instant."""

from msg_defs import scenario_file, topics, wire
from msg_defs.topics import Topic
from sim_world.robot import START_NS, RobotStep
from sim_world.scenario import SECTION
from sim_world.simulator import Simulation

Message = tuple[Topic, bytes]


def of_world(simulation: Simulation) -> list[Message]:
    """True landmarks, walls and configuration."""
    config = scenario_file.to_yaml(**{SECTION: simulation.scenario})
    return [
        (topics.GROUND_TRUTH_LANDMARKS, wire.encode_map(simulation.landmarks, START_NS)),
        (topics.GROUND_TRUTH_WALLS, wire.encode_walls(simulation.walls, START_NS)),
        (topics.WORLD_CONFIG, wire.encode_text(f"# seed: {simulation.seed}\n{config}")),
    ]


def of_step(step: RobotStep) -> list[Message]:
    """What the robot reports, then the truth about it."""
    name = step.odometry.robot
    odom, base = topics.odom_frame(name), topics.base_frame(name)
    return [
        (topics.odometry(name), wire.encode_pose(step.odometry, odom, base)),
        (topics.observations(name), wire.encode_observations(step.observations)),
        (topics.ground_truth(name), wire.encode_pose(step.truth, topics.MAP_FRAME, base)),
        (
            topics.observation_truth(name),
            wire.encode_observation_truth(step.observation_truth),
        ),
    ]
