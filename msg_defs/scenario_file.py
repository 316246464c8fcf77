"""YAML <-> frozen dataclasses, strictly: an unknown key or a value out of range is an error.

A scenario file has one section per package, and each package reads its own:

    sim_world: {...}
    multi_robot_slam: {...}

Fields are declared once, as `Annotated[type, limits, "description [unit]"]` in a class decorated
with `msg_defs.types.settings`; limits come from `annotated_types`.
"""

import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import TypeAdapter, ValidationError

from msg_defs import limits
from msg_defs.errors import InputError

SECTIONS = ("sim_world", "multi_robot_slam")

Settings = TypeVar("Settings")


def from_mapping(cls: type[Settings], values: dict, source: str = "settings") -> Settings:
    """Build `cls` from nested plain values; `InputError` names each key that does not fit."""
    try:
        return TypeAdapter(cls).validate_python(values)
    except ValidationError as error:
        lines = dict.fromkeys(_explain(cls, e, source, values) for e in error.errors())
        raise InputError("\n".join(lines)) from None


def sections(text: str, source: str = "YAML") -> dict[str, dict]:
    """The sections of a scenario given as YAML text; one that is left out is empty."""
    try:
        scenario = yaml.safe_load(text) or {}
    except yaml.YAMLError as error:
        raise InputError(f"{source}: not valid YAML: {error}") from None
    if not isinstance(scenario, dict):
        raise InputError(f"{source}: expected sections {', '.join(SECTIONS)}, found {scenario!r}")
    for name, values in scenario.items():
        if name not in SECTIONS:
            raise InputError(f"{source}: unknown section '{name}'; use {' or '.join(SECTIONS)}")
        if not isinstance(values, dict | None):
            raise InputError(
                f"{source}: section '{name}' is {values!r}; write one 'key: value' a line"
            )
    return {name: scenario.get(name) or {} for name in SECTIONS}


def from_yaml(cls: type[Settings], text: str, section: str, source: str = "YAML") -> Settings:
    """Read `section` of a scenario given as YAML text; a section left out means all defaults."""
    return from_mapping(cls, sections(text, source)[section], f"{source}: {section}")


def shipped() -> dict[str, Path]:
    """The scenario files that ship, by name."""
    return {path.stem: path for path in sorted((Path(__file__).parent / "config").glob("*.yaml"))}


def find_scenario(name: str) -> Path:
    """The scenario file at the path `name`, or the one of that name that ships: `paper`, ..."""
    known = shipped()
    path = known.get(name, Path(name))
    if not path.is_file():
        raise InputError(f"no scenario '{name}': name a YAML file, or {' or '.join(known)}")
    return path


def read(path: Path) -> str:
    """The text of the scenario file at `path`."""
    try:
        return Path(path).read_text()
    except OSError as error:
        raise InputError(f"cannot read the scenario {path}: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text file ({error}); name a YAML file") from None


def from_file(cls: type[Settings], path: Path, section: str) -> Settings:
    """Read `section` of the scenario file at `path`."""
    return from_yaml(cls, read(path), section, str(path))


def to_plain(record: object) -> dict:
    """The inverse of `from_mapping`: nested plain values of every field."""
    return TypeAdapter(type(record)).dump_python(record, mode="json")


def to_yaml(**sections: object) -> str:
    """The inverse of `from_yaml`: every field of every given section, defaults included."""
    plain = {name: to_plain(record) for name, record in sections.items()}
    return yaml.safe_dump(plain, sort_keys=False)


def to_commented_yaml(section: str, record: object) -> str:
    """As `to_yaml`, with what each field means and may be above it."""
    return f"{section}:\n" + "\n".join(_commented(record, "  ")) + "\n"


def inline(value: object) -> str:
    """A field's value as YAML in one line."""
    plain = TypeAdapter(type(value)).dump_python(value, mode="json")
    text = yaml.safe_dump(plain, default_flow_style=True, width=10_000)
    return text.removesuffix("...\n").strip()


def _commented(record: Any, indent: str) -> Iterator[str]:
    cls: type = type(record)
    for field in limits.fields_of(cls):
        value = getattr(record, field.name)
        if is_dataclass(value):
            yield f"{indent}{field.name}:"
            yield from _commented(value, f"{indent}  ")
        else:
            said = "; ".join(filter(None, (field.description, field.allowed())))
            comment = f"{indent}# "
            yield from textwrap.wrap(said, 100, initial_indent=comment, subsequent_indent=comment)
            yield f"{indent}{field.name}: {inline(value)}"


def _explain(cls: type, error: Mapping[str, Any], source: str, values: Any) -> str:
    # Of an element that is missing pydantic tells the place; whoever made the row knows the row.
    place = error["loc"][:-1] if error["type"] == "missing" else error["loc"]
    # Of a row or a word it tells what either lacks, under a name of its own.
    either = [i for i, part in enumerate(place) if str(part).startswith(("tuple[", "literal["))]
    place, given = place[: either[0]] if either else place, error["input"]
    if either:
        given = reduce(getitem, place, values)
    key = ".".join(str(part) for part in place)
    if error["type"] == "unexpected_keyword_argument":
        return f"{source}: unknown key '{key}'; remove it or correct its spelling"
    if error["type"] == "value_error":
        return f"{source}: {error['ctx']['error']}"
    field = limits.find(cls, place)
    wanted = error["msg"] if field is None else f"give {field.wanted()}"
    return f"{source}: {key} = {given!r}; {wanted}"
