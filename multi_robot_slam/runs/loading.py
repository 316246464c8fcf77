"""Runs read back from what they left.

A live run is a bag with everything in it. An offline run is a folder: its bag `estimates` holds
what the fusion would have published, `result.json` names the bag of the recording.
"""

from dataclasses import replace
from pathlib import Path

from msg_defs import topics
from msg_defs.errors import InputError
from multi_robot_slam.bags import BagReader
from multi_robot_slam.runs import estimates, recording, result, views
from multi_robot_slam.runs.provenance import Provenance
from multi_robot_slam.runs.run import Run

BAG = "bag"
"""Name of the bag in the folder of a live run."""
BAG_FILES = ("*.mcap", "*.db3", "*.zstd")


def load(folder: Path, namespace: str | None = None) -> Run:
    """The run in `folder`: a live one with its bag in `folder/bag`, or an offline one.

    A bag itself is a live run, too. `namespace` is that of a live run's fusion; by default the only
    one there is. `InputError` where `folder` is none of these.
    """
    folder = Path(folder)
    if is_offline(folder):
        return from_folder(folder)
    if (folder / BAG).exists():
        run = from_bag(folder / BAG, namespace)
        return replace(run, provenance=_provenance(folder))
    if not folder.exists():
        raise InputError(f"no run {folder}: there is no such folder")
    if folder.is_dir() and not any(next(folder.glob(kind), None) for kind in BAG_FILES):
        raise InputError(
            f"{folder} is no run's folder: it holds neither {estimates.FOLDER}/, as `run` leaves, "
            f"nor {BAG}/, as `demo` does, nor files of a bag ({', '.join(BAG_FILES)}); name the "
            "folder that `run` or `demo` left, or a bag recorded with the fusion's topics"
        )
    return from_bag(folder, namespace)


def is_offline(folder: Path) -> bool:
    """`folder` holds what `multi_robot_slam run` left."""
    return (Path(folder) / estimates.FOLDER).is_dir()


def from_bag(path: Path, namespace: str | None = None) -> Run:
    """The live run in the bag at `path`, with its estimates as they were published."""
    reader = BagReader(path)
    found = reader.find_namespace([topics.FUSION_CONFIG], namespace)
    config = estimates.config_in(reader, found)
    wanted = [*estimates.topics_of(config.robots), *recording.topics_of(config.robots)]
    messages = reader.by_topic(wanted, found)
    recorded = recording.join(reader, messages, config.robots, found)
    run = estimates.join(reader, messages, config, recorded)
    return replace(run, views=views.load(reader, config.robots, run.steps, found))


def from_folder(folder: Path) -> Run:
    """The offline run in `folder`, as `estimates.write` and `saving.write` left it."""
    reader = BagReader(Path(folder) / estimates.FOLDER)
    config = estimates.config_in(reader)
    messages = reader.by_topic(estimates.topics_of(config.robots))
    recorded = recording.recorded(
        _bag_of(folder), config.robots, result.figures_in(folder).get("namespace")
    )
    run = estimates.join(reader, messages, config, recorded)
    seen = views.load(reader, config.robots, run.steps)
    if not seen and run.bag is not None:
        seen = views.load(BagReader(run.bag), config.robots, run.steps, run.namespace)
    return replace(run, views=seen, provenance=_provenance(folder))


def _bag_of(folder: Path) -> Path:
    bag = result.figures_in(folder).get("bag")
    if bag is None or not Path(bag).exists():
        raise InputError(
            f"{folder / result.FILE}: the bag of this run is not at {bag}; correct `bag` in this "
            "file, or estimate again with `multi_robot_slam run`"
        )
    return Path(bag)


def _provenance(folder: Path) -> Provenance | None:
    """As `result.json` has it; None where there is none, or it does not tell."""
    try:
        figures = result.figures_in(folder)
    except InputError:
        return None
    if figures.get("version") is None:
        return None
    return Provenance(figures["version"], figures.get("scenario"), figures.get("machine") or {})
