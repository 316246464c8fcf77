"""`--set filter.particles=1000`: single settings of the fusion, by their dotted names."""

from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches

import yaml

from msg_defs import scenario_file
from msg_defs.errors import InputError


def parse(words: Sequence[str]) -> dict:
    """Nested plain values from `name=value` words, the values in YAML.

    Raises
    ------
    InputError : for a word of another form, an unknown name, or a name given twice.

    """
    values: dict = {}
    known = _names()
    for word in words:
        name, separator, text = word.partition("=")
        if not separator:
            raise InputError(f"--set {word}: give name=value, such as filter.particles=1000")
        if name not in known:
            raise InputError(f"--set {word}: no setting '{name}'; {_similar(name, known)}")
        _put(values, name, _value(word, text))
    return values


def completions(incomplete: str) -> list[str]:
    """The settings whose names begin so, for the shell."""
    return [f"{name}=" for name in _names() if name.startswith(incomplete)]


def _names() -> list[str]:
    """Every setting and group of settings, as dotted names."""
    from multi_robot_slam.config import Config

    return list(_dotted(scenario_file.to_plain(Config())))


def _dotted(values: Mapping[str, object], prefix: str = "") -> Iterator[str]:
    for name, value in values.items():
        yield prefix + name
        if isinstance(value, dict):
            yield from _dotted(value, f"{prefix}{name}.")


def _similar(name: str, known: Sequence[str]) -> str:
    last = name.rpartition(".")[2]
    by_last = {dotted.rpartition(".")[2]: dotted for dotted in known}
    near = [
        *get_close_matches(name, known, n=3),
        *(by_last[match] for match in get_close_matches(last, by_last, n=3)),
    ]
    return (
        "similar are " + ", ".join(dict.fromkeys(near)) if near else "config.yaml of a run has all"
    )


def _value(word: str, text: str) -> object:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        raise InputError(f"--set {word}: '{text}' is not valid YAML; quote it") from None


def _put(values: dict, name: str, value: object) -> None:
    *groups, last = name.split(".")
    for group in groups:
        values = values.setdefault(group, {})
        if not isinstance(values, dict):
            raise InputError(f"--set {name}: {group} is set as a whole already; set it once")
    if last in values:
        raise InputError(f"--set {name}: given twice; set it once")
    values[last] = value
