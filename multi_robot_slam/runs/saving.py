"""A run and its figures written for people and other programs."""

from pathlib import Path

from msg_defs import scenario_file
from multi_robot_slam.config import SECTION
from multi_robot_slam.runs import result
from multi_robot_slam.runs.run import Run
from multi_robot_slam.runs.text_files import to_tum, write_map
from multi_robot_slam.runs.trajectory_errors import sampled


def write(run: Run, figures: dict, folder: Path) -> None:
    """Write a run and its figures of merit (`evaluation.evaluate`) into `folder`.

    `result.json`, and the same as `figures.csv`, a row a figure; `config.yaml`, the full
    configuration; `trajectory_<robot>.tum`, the best particle's path in `map`; `map.csv`;
    `refined_<robot>.tum` and `refined_map.csv` where the run was refined; `truth_<robot>.tum`,
    interpolated at the stamps of the path, where the truth is known.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    result.write(figures, folder)
    (folder / "config.yaml").write_text(scenario_file.to_yaml(**{SECTION: run.config}))
    write_map(run.landmarks, folder / "map.csv")
    for name, robot in run.robots.items():
        (folder / f"trajectory_{name}.tum").write_text(to_tum(robot.path))
        if len(robot.refined.stamps_ns):
            (folder / f"refined_{name}.tum").write_text(to_tum(robot.refined))
        if robot.truth is not None:
            truth = sampled(robot.truth, robot.path.stamps_ns)
            (folder / f"truth_{name}.tum").write_text(to_tum(truth))
    if run.refined_landmarks is not None:
        write_map(run.refined_landmarks, folder / "refined_map.csv")
