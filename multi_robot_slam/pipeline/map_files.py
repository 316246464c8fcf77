"""Map files: the map of a run, and all that it goes on from, in one file that NumPy reads.

`docs/maps.md` says what every array is. What holds the map is for everybody, and every value is
checked; the state is for this program alone, and of one version of it.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from msg_defs import scenario_file
from msg_defs.errors import InputError
from msg_defs.types import DESCRIPTOR_SIZE
from multi_robot_slam.config import MOST_ROBOTS, SECTION, Config
from multi_robot_slam.filter.kept import EVIDENCE, KeptMap
from multi_robot_slam.filter.landmarks import MOST_IDS
from multi_robot_slam.filter.proposals import WIDEST_M
from multi_robot_slam.filter.rejuvenation import FAILURES
from multi_robot_slam.maps import container
from multi_robot_slam.maps.graph import Parts, Taken
from multi_robot_slam.models.symmetric import unpack
from multi_robot_slam.pipeline import going_on
from multi_robot_slam.pipeline.pipeline import Pipeline
from multi_robot_slam.runs import provenance

FORMAT = "multi_robot_slam map"
VERSION = 1
"""Of the format. A file of a newer one is refused; all older ones are read."""

ABOUT, MAP, STATE = "about", "map/", "state/"
"""How names of arrays begin: JSON that says what the file is, the map, and the state."""


class Layout(NamedTuple):
    """What an array of a map is."""

    dtype: str
    shape: tuple[str | int, ...]
    """`n` is the number of landmarks, `2n` twice that."""
    unit: str
    meaning: str


LAYOUT = {
    "ids": Layout("int64", ("n",), "", "identity of each landmark, ascending; stays for good"),
    "positions": Layout("float64", ("n", 3), "m, in `map`", "mean x, y, z"),
    "covariances": Layout(
        "float64", ("n", 6), "m^2, in `map`", "covariance of each alone, xx xy xz yy yz zz"
    ),
    "descriptors": Layout(
        "float32", ("n", DESCRIPTOR_SIZE), "", "SIFT, of unit norm but for noise"
    ),
    "observations": Layout("int64", ("n",), "", "how often each was observed"),
    "robots": Layout(
        "int64", ("n",), "", "bit i: the i-th of the `robots` in `about` has observed it"
    ),
    "published": Layout("bool", ("n",), "", "whether it is likely to be there, and so published"),
    "places": Layout("int64", ("n",), "", "from how many places each was seen"),
    "horizon": Layout("int64", ("n",), "", "the largest id there was when it was seen last"),
    "found": Layout("int64", ("n",), "", "looks at its place that found it"),
    "failed": Layout("int64", ("n",), "", "looks that did not"),
    "in_a_row": Layout("int64", ("n",), "", "those of them since it was seen last"),
    "together": Layout("bool", ("n", "n"), "", "whether some frame has seen both; symmetric"),
    "information": Layout(
        "float64",
        ("n", 6),
        "1/m^2, in `map`",
        "inverse covariance of each given its centre, xx xy xz yy yz zz",
    ),
    "joint": Layout(
        "float64",
        ("2n", "2n"),
        "m^2, in `map`",
        "joint covariance of the centres x, y, whose means are the positions",
    ),
    "next_id": Layout("int64", (), "", "id of the landmark that is created next"),
}
"""Of the arrays `map/<name>`."""


class MapFile(NamedTuple):
    """What a file says of itself, and its map, or all that a run goes on from."""

    about: dict[str, Any]
    """`format`, `version`, `program`, `robots`, `stamp_ns`, `config`."""
    kept: KeptMap | None
    state: Parts | None


def about(config: Config, stamp_ns: int) -> dict[str, Any]:
    """What is said of the map of a team whose newest frame is of `stamp_ns`; 0: there is none."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "program": provenance.version(),
        "robots": list(config.robots),
        "stamp_ns": stamp_ns,
        "config": scenario_file.to_yaml(**{SECTION: config}),
    }


def write(path: Path, told: Mapping[str, Any], kept: KeptMap) -> None:
    """Write a map, of which `about` is `told`, to `path`; `InputError` if that cannot be done."""
    arrays = {name: getattr(kept, name) for name in LAYOUT}
    container.write(path, _named(told, MAP, arrays))


def write_state(path: Path, told: Mapping[str, Any], taken: Taken) -> None:
    """Write all that a run goes on from, likewise."""
    table, buffers = taken.parts()
    arrays = {dtype[1:]: own for dtype, own in buffers.items()}
    arrays["table"] = np.frombuffer(table.encode(), np.uint8)
    container.write(path, _named(told, STATE, arrays))


def _named(
    told: Mapping[str, Any], prefix: str, arrays: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    named = {f"{prefix}{name}": array for name, array in arrays.items()}
    return {ABOUT: np.array(json.dumps(told)), **named}


def read(path: Path) -> MapFile:
    """What a file holds, checked; `InputError` where it is damaged, or none of this program's."""
    told = read_about(path)
    arrays = container.read(path, lambda name: name.startswith((MAP, STATE)))
    of_map = {k.removeprefix(MAP): own for k, own in arrays.items() if k.startswith(MAP)}
    of_state = {k.removeprefix(STATE): own for k, own in arrays.items() if k.startswith(STATE)}
    if not of_map and not of_state:
        raise InputError(f"{path} holds neither a map nor a state; take another")
    kept = _kept(path, of_map, len(told["robots"])) if of_map else None
    return MapFile(told, kept, _parts(path, of_state) if of_state else None)


def read_about(path: Path) -> dict[str, Any]:
    """What a file says of itself; `InputError` where it is none of this program's, or newer."""
    text = container.read(path, lambda name: name == ABOUT).get(ABOUT, np.array(""))
    told: Any = None
    try:
        told = json.loads(str(text[()])) if text.shape == () else None
        is_one = told["format"] == FORMAT and type(told["version"]) is int
    except (ValueError, TypeError, KeyError, RecursionError):
        is_one = False
    if not is_one:
        raise InputError(f"{path} is no map of this program; name one that it has saved")
    if told["version"] > VERSION:
        raise InputError(
            f"{path} is of version {told['version']} of the format, and this program reads up to "
            f"{VERSION}; update it"
        )
    names = told.get("robots")
    fits = isinstance(names, list) and len(names) <= MOST_ROBOTS
    fits = fits and all(isinstance(name, str) for name in names)
    fits = fits and type(told.get("stamp_ns")) is int and isinstance(told.get("config"), str)
    if not fits:
        raise InputError(f"{path}: `{ABOUT}` lacks robots, stamp_ns or config; take a copy")
    return told


def _parts(path: Path, arrays: dict[str, np.ndarray]) -> Parts:
    table = arrays.pop("table", np.empty(0, np.uint8))
    try:
        text = table.tobytes().decode()
    except UnicodeDecodeError:
        raise InputError(f"{path}: the table of the state is no text; take a copy") from None
    return Parts(text, {own.dtype.str: own for own in arrays.values()})


def _kept(path: Path, arrays: Mapping[str, np.ndarray], robots: int) -> KeptMap:
    """The map, every value of which is checked."""
    for name, layout in LAYOUT.items():
        array = arrays.get(name)
        if array is None:
            raise InputError(f"{path}: there is no {MAP}{name}; take a copy")
        count = len(np.atleast_1d(arrays["ids"]))
        sizes: dict[str | int, int] = {"n": count, "2n": 2 * count}
        shape = tuple(sizes.get(size, size) for size in layout.shape)
        if array.dtype != layout.dtype or array.shape != shape:
            raise InputError(
                f"{path}: {MAP}{name} is {array.dtype} {array.shape}; it must be {layout.dtype} "
                f"{shape}"
            )
    kept = KeptMap(**{name: arrays[name] for name in LAYOUT})
    if wrong := _wrong(kept, robots):
        raise InputError(f"{path}: {wrong}; take a copy, or correct what wrote it")
    return kept


def _wrong(kept: KeptMap, robots: int) -> str:
    """What cannot be, with shapes and dtypes as they must be; empty where all can."""
    for name in ("positions", "covariances", "descriptors", "information", "joint"):
        if not np.isfinite(getattr(kept, name)).all():
            return f"{MAP}{name} has values that are no finite numbers"
    if len(kept.ids) and not (kept.ids[0] >= 0 and (np.diff(kept.ids) > 0).all()):
        return f"{MAP}ids do not ascend from 0 or more"
    if not (kept.ids.max(initial=-1) < kept.next_id <= MOST_IDS):
        return f"{MAP}next_id is {kept.next_id}, and must be larger than all ids"
    if np.abs(kept.positions).max(initial=0) > WIDEST_M:
        return f"{MAP}positions reach beyond {WIDEST_M:g} m"
    for name in (*EVIDENCE, "observations"):
        if getattr(kept, name).min(initial=0) < 0:
            return f"{MAP}{name} is below 0"
    if not ((kept.robots >= 0) & (kept.robots < 1 << robots)).all():
        return f"{MAP}robots has bits of robots that `{ABOUT}` does not name"
    if not (kept.together == kept.together.T).all():
        return f"{MAP}together is not symmetric"
    for name in ("covariances", "information"):
        if np.linalg.eigvalsh(unpack(getattr(kept, name))).min(initial=1) <= 0:
            return f"{MAP}{name} has matrices that are not positive definite"
    if not is_covariance(kept.joint):
        return f"{MAP}joint is no positive definite covariance"
    return ""


def is_covariance(matrix: np.ndarray) -> bool:
    """Whether `matrix` (n, n) is symmetric and positive definite, but for rounding."""
    if not np.allclose(matrix, matrix.T, rtol=1e-6, atol=1e-12):
        return False
    try:
        np.linalg.cholesky(matrix + 1e-9 * np.diag(np.diag(matrix)))
    except np.linalg.LinAlgError:
        return False
    return True


def for_team(file: MapFile, robots: Sequence[str]) -> KeptMap:
    """The map of a file for a team of `robots`, whoever made it.

    Landmarks keep the robots that have seen them as far as they are in the team, by name. Of a file
    that holds a state the map is made of that; `InputError` where it cannot be.
    """
    kept = file.kept
    if kept is None:
        kept = closed(pipeline_of(file, lambda text: None))
    bits = np.zeros(len(kept.ids), np.int64)
    for own, name in enumerate(file.about["robots"]):
        if name in robots:
            bits |= ((kept.robots >> own) & 1) << list(robots).index(name)
    return replace(kept, robots=bits)


def pipeline_of(file: MapFile, warn: Callable[[str], None]) -> Pipeline:
    """The pipeline that goes on from the state of a file."""
    if file.state is None:
        raise InputError("this file holds a map alone, and nothing to go on from; load it as one")
    if file.about["program"] != provenance.version():
        raise InputError(
            f"the state is of version {file.about['program']} of this program, this is "
            f"{provenance.version()}; use that one to go on"
        )
    return going_on.put_back(file.state, warn)


def closed(pipeline: Pipeline) -> KeptMap:
    """The map to keep of all that a pipeline has done; `InputError` where there is none."""
    return made(pipeline.closing())


def made(closing: Callable[[], KeptMap]) -> KeptMap:
    """What `Pipeline.closing` gave makes; `InputError` where it makes none."""
    try:
        return closing()
    except FAILURES as error:
        raise InputError(f"no map can be made now: {error}; try again later") from None
