"""Pages made of the code: `{parameters}`, `{commands}`, `{topics}` and `{api}` in Markdown."""

import inspect
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import is_dataclass
from importlib import import_module
from operator import attrgetter
from types import FunctionType
from typing import ClassVar

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective

import multi_robot_slam
from msg_defs import limits, scenario_file, topics

NODES = (
    *(f"multi_robot_slam.nodes.{name}" for name in ("camera", "fusion", "recorder", "replay")),
    *("multi_robot_slam.nodes.watch", "sim_world.robots"),
)
"""The modules of all nodes; each has a `USAGE`."""
COMMANDS = {"multi_robot_slam": "multi_robot_slam.cli.main", "sim_world": "sim_world.cli"}


class Generated(SphinxDirective):
    """A part of a page: Markdown that `lines` makes of the code."""

    lines: ClassVar[FunctionType]

    def run(self) -> list[nodes.Node]:
        """What Sphinx calls."""
        text = "\n".join(type(self).lines())
        return self.parse_text_to_nodes(text, allow_section_headings=True)


def parameters() -> Iterator[str]:
    """The settings of scenarios, then each node's own parameters."""
    usages = [import_module(name).USAGE for name in NODES]
    sections = {usage.section: usage.classes[0] for usage in usages if usage.section}
    for section, cls in sections.items():
        yield f"## Section `{section}` of a scenario\n"
        yield from _settings(cls)
    for usage in usages:
        yield f"## Node `{usage.command}`\n\n{_plain(usage.text)}\n"
        if usage.section:
            yield f"The settings of `{usage.section}` above, `scenario`, and:\n"
        for cls in usage.classes[1 if usage.section else 0 :]:
            yield from _settings(cls)


def _settings(cls: type) -> Iterator[str]:
    """An entry for each field of a settings class, and of those nested in it."""
    default = cls()
    for leaf in limits.leaves(cls):
        value = scenario_file.inline(attrgetter(leaf.name)(default))
        meaning = _plain(f"{leaf.description}; {leaf.allowed()}")
        yield f"`{leaf.name}` = `{value}`\n: {meaning}\n"


def commands() -> Iterator[str]:
    """What typer says of every command, its headings one level down."""
    for name, module in COMMANDS.items():
        told = subprocess.run(
            [sys.executable, "-m", "typer", module, "utils", "docs", "--name", name],
            check=True,
            capture_output=True,
            text=True,
        )
        yield re.sub("^#", "##", told.stdout, flags=re.MULTILINE)


def topic_rows() -> Iterator[str]:
    """One row for each topic, then what its quality of service is."""
    yield from ("| topic | type | quality |", "|---|---|---|")
    for value in vars(topics).values():
        if inspect.isfunction(value) and value.__annotations__.get("return") is topics.Topic:
            parameters = inspect.signature(value).parameters.values()
            value = value(*(f"<{p.name}>" for p in parameters if p.default is p.empty))
        if isinstance(value, topics.Topic):
            yield f"| `{value.name}` | `{value.type}` | {value.qos} |"
    remarks = ModuleAnalyzer.for_module(topics.__name__).find_attr_docs()
    for name in ("STREAM", "BULKY", "LATCHED", "SENSOR"):
        yield f"\n{getattr(topics, name)}\n: {' '.join(remarks['', name])}"


def api() -> Iterator[str]:
    """Every name that `multi_robot_slam` exports; settings are under parameters."""
    yield "```{eval-rst}"
    for name in multi_robot_slam.__all__:
        thing = getattr(multi_robot_slam, name)
        if not inspect.isclass(thing):
            yield f".. autofunction:: multi_robot_slam.{name}\n"
        elif is_dataclass(thing) and any(field.description for field in limits.fields_of(thing)):
            yield f".. autoclass:: multi_robot_slam.{name}(**settings)\n"
        else:
            yield f".. autoclass:: multi_robot_slam.{name}\n   :members:\n"
    yield "```"


def _plain(text: str) -> str:
    """Words as Markdown: what is not in backticks stands as it is."""
    parts = text.split("`")
    parts[::2] = [re.sub(r"([\\*_<\[\]$])", r"\\\1", part) for part in parts[::2]]
    return "`".join(parts)


def setup(app: Sphinx) -> dict[str, bool]:
    """What Sphinx calls."""
    makers = {"parameters": parameters, "commands": commands, "topics": topic_rows, "api": api}
    for name, maker in makers.items():
        app.add_directive(name, type(name, (Generated,), {"lines": staticmethod(maker)}))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
