"""All figures of the front end as one table: of a recording, or of rendered images."""

import time
from pathlib import Path

import numpy as np

from multi_robot_slam.config import FOR_PICTURES, shipped
from multi_robot_slam.datasets import stereo_bag
from multi_robot_slam.front_end.front_end import FrontEnd
from multi_robot_slam.studies import cameras_rendered, front_end
from multi_robot_slam.studies.cameras_recorded import RANGES_M, READERS, TRUTHS

PAIRS = 100
"""Rendered, of one robot's way."""
TIMED = 10
"""Pairs of a recording whose time is taken."""

Figures = dict[str, float]


def of_recording(source: str, folder: Path, scale: float) -> Figures:
    """Figures of the recording in `folder`, `euroc` or `kitti`, with images at `scale`."""
    recording, truth = READERS[source](folder), TRUTHS[source]
    camera = stereo_bag.camera_settings(recording, scale, RANGES_M[source])
    seen = list(front_end.views(recording, camera))
    found = front_end.figures(seen, front_end.rig_of(recording), truth)
    some = np.linspace(0, len(recording) - 1, min(TIMED, len(recording))).astype(int)
    taken = front_end.timing(recording.of(some.tolist()), camera)
    return found | {"front end [ms]": taken.pair_ms, "SIFT alone [ms]": taken.sift_ms}


def of_rendered(setup: str) -> Figures:
    """Times of rendered pairs (640 x 480), one thread's; `setup` as in the study of cameras."""
    simulation = cameras_rendered.simulation_of(setup)
    renderer = simulation.renderer
    if renderer is None:
        raise ValueError(f"{setup} has no images")
    camera = simulation.scenario.camera
    eyes = FrontEnd(cameras_rendered.rig_of(camera), shipped(FOR_PICTURES).camera)
    taken = []
    for step, _ in zip(simulation.steps(), range(PAIRS + 1), strict=False):
        stamps = [time.thread_time()]
        pair = renderer.pair(step[0].truth)
        stamps.append(time.thread_time())
        eyes.observe(*pair)
        stamps.append(time.thread_time())
        taken.append(np.diff(stamps))
    rendering, looking = 1e3 * np.mean(taken[1:], axis=0)
    return {"rendering [ms]": float(rendering), "front end [ms]": float(looking)}


def markdown(figures: Figures) -> str:
    """A row for each figure."""
    rows = [f"| {name} | {value:.4g} |" for name, value in figures.items()]
    return "\n".join(["| figure | |", "|---|---:|", *rows])
