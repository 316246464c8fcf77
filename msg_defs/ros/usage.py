"""What a node's command answers without starting ROS: its parameters, and a configuration file."""

import textwrap
from collections.abc import Iterator, Sequence
from operator import attrgetter
from typing import NamedTuple

from msg_defs import limits, scenario_file
from msg_defs.errors import InputError

HELP = ("--help", "-h")
PRINT_CONFIG = "--print-config"
_WIDTH = 100


class Usage(NamedTuple):
    """A node's command and the settings that are its parameters."""

    command: str
    text: str
    """What the node does."""
    classes: tuple[type, ...]
    section: str | None = None
    """The section of a scenario that holds the first class; None: it is in no scenario."""

    def answer(self, words: Sequence[str]) -> str | None:
        """What the command's `words` ask to print; None: they ask for the node."""
        if any(word in HELP for word in words):
            return "\n".join(self._help()) + "\n"
        if PRINT_CONFIG not in words or self.section is None:
            return None
        if len(words) > 1:
            raise InputError(f"{PRINT_CONFIG} prints every default; give nothing else with it")
        return scenario_file.to_commented_yaml(self.section, self.classes[0]())

    def _help(self) -> Iterator[str]:
        config = "" if self.section is None else f"[{PRINT_CONFIG}] "
        scenario = "" if self.section is None else "-p scenario:=FILE "
        yield (f"Usage: {self.command} [--help] {config}[--ros-args {scenario}-p NAME:=VALUE ...]")
        yield ""
        yield from _wrapped(self.text, "")
        yield ""
        if self.section is not None:
            yield from _wrapped(
                f"{PRINT_CONFIG} prints a scenario with every default, to be edited and given as "
                "the parameter `scenario`. Parameters override a scenario.",
                "",
            )
            yield ""
        yield "Parameters:"
        if self.section is not None:
            yield "  scenario = ''"
            yield "      a YAML file, or the name of a scenario that ships; a text"
        for cls in self.classes:
            yield from _parameters(cls)


def _parameters(cls: type) -> Iterator[str]:
    default = cls()
    for leaf in limits.leaves(cls):
        value = scenario_file.inline(attrgetter(leaf.name)(default))
        yield f"  {leaf.name} = {value}"
        yield from _wrapped(f"{leaf.description}; {leaf.allowed()}", "      ")


def _wrapped(text: str, indent: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent=indent, subsequent_indent=indent)
