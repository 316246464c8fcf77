"""What the fusion keeps in files: maps when it is asked to, and its state from time to time.

A state is taken while the filter waits, some ten milliseconds, and written beside it.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, NamedTuple

from annotated_types import Ge, Gt

from msg_defs.errors import InputError
from msg_defs.limits import AT_ANY_TIME
from msg_defs.types import settings
from multi_robot_slam.config import Config
from multi_robot_slam.filter.kept import KeptMap
from multi_robot_slam.pipeline import going_on, map_files
from multi_robot_slam.pipeline.pipeline import Pipeline


@settings
class Keeping:
    """Files of the node."""

    map: Annotated[
        str,
        AT_ANY_TIME,
        "map to begin with, and that ~/load_map loads; the robots start in it at start_poses, "
        "or anywhere, where these are unknown; empty: none",
    ] = ""
    map_out: Annotated[str, AT_ANY_TIME, "map that ~/save_map writes"] = "map.npz"
    autosave: Annotated[
        str,
        "file with the state while the fusion runs, and with its map when that has ended; after a "
        "crash the fusion goes on from it by itself; empty: none, for only you know a disk that "
        "may be written to so often, 10 to 60 MB each time",
    ] = ""
    autosave_s: Annotated[
        float,
        Ge(0),
        AT_ANY_TIME,
        "time between two states; what came after the last is lost in a crash [s]; 0: none, only "
        "the map when the fusion has ended",
    ] = 5.0
    resume_s: Annotated[
        float,
        Gt(0),
        "message time from a state to the first message after which it is no longer gone on from: "
        "who knows where the robots are by then [s]",
    ] = 60.0


class Resumed(NamedTuple):
    """What a fusion that was killed goes on from."""

    pipeline: Pipeline
    stamp_ns: int
    """Of the newest step."""


def loaded(file: str, config: Config) -> KeptMap | None:
    """The map in a file for the team of `config`; None where no file is named."""
    return map_files.for_team(map_files.read(Path(file)), config.robots) if file else None


def save(file: str, config: Config, pipeline: Pipeline, stamp_ns: int) -> str:
    """Write the map of a pipeline whose newest step is of `stamp_ns`; what was done, in words."""
    path, kept = Path(file).absolute(), map_files.closed(pipeline)
    map_files.write(path, map_files.about(config, stamp_ns), kept)
    return f"{int(kept.published.sum())} landmarks in {path}"


class Autosave:
    """Writes a pipeline's state again and again to one file.

    Parameters
    ----------
    file : its name.
    config : as the node was given it; a state of another is not gone on from.
    warn : called with a line for what cannot be written or read.

    """

    def __init__(self, file: str, config: Config, warn: Callable[[str], None]) -> None:
        self.path = Path(file).absolute()
        self.config, self._warn = config, warn
        self._writer = ThreadPoolExecutor(1, "autosave")
        self._writing: Future[None] | None = None

    def resumed(self) -> Resumed | None:
        """What to go on from; None where there is nothing, or the last fusion ended in order."""
        if not self.path.exists():
            return None
        try:
            held = map_files.read(self.path)
            if held.state is None:
                return None
            if held.about["config"] != map_files.about(self.config, 0)["config"]:
                raise InputError("it is of another configuration")
            return Resumed(map_files.pipeline_of(held, self._warn), held.about["stamp_ns"])
        except InputError as error:
            self._warn(f"not going on from {self.path}, beginning anew: {error}")
            return None

    def save(self, pipeline: Pipeline, stamp_ns: int) -> bool:
        """Have the state written beside; False while the last one still is."""
        if self._writing is not None and not self._writing.done():
            return False
        self._tell_of_failure()
        try:
            taken = going_on.taken_apart(pipeline)
        except InputError as error:
            self._warn(f"autosave: {error}")
            return False
        told = map_files.about(self.config, stamp_ns)
        self._writing = self._writer.submit(map_files.write_state, self.path, told, taken)
        return True

    def end(self, pipeline: Pipeline, stamp_ns: int) -> None:
        """Leave the map in place of the state: there is nothing more to go on from."""
        self._writer.shutdown()
        self._tell_of_failure()
        try:
            save(str(self.path), self.config, pipeline, stamp_ns)
        except InputError as error:
            self._warn(f"autosave: {error}")
            self.path.unlink(missing_ok=True)

    def _tell_of_failure(self) -> None:
        if self._writing is not None and (error := self._writing.exception()):
            self._warn(f"autosave: {error}")
        self._writing = None
