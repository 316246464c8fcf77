"""Formulas as MathML, which browsers draw by themselves: no script, no picture, no network."""

import re
from html import escape
from typing import NoReturn

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

TAG = re.compile(r"\s*\\tag\{([^}]*)\}")
OTHER_NAMES = {r"\arg": r"\operatorname{arg}", r"\sim": r"\thicksim"}
"""What the converter does not know, or takes for a variable, and what it knows."""

log = logging.getLogger(__name__)


def mathml(latex: str, display: str, place: nodes.Node | None = None) -> str:
    """The formula as MathML, `display` being inline or block; a warning where a name is unknown."""
    for name, known in OTHER_NAMES.items():
        latex = re.sub(re.escape(name) + "(?![a-zA-Z])", lambda _, known=known: known, latex)
    made = convert(latex, display=display)
    if "\\" in made:
        log.warning("no MathML for %s", latex, location=place)
    return made


def _inline(page: HTML5Translator, node: nodes.math) -> NoReturn:
    page.body.append(mathml(node.astext(), "inline", node))
    raise nodes.SkipNode


def _block(page: HTML5Translator, node: nodes.math_block) -> NoReturn:
    latex = node.astext()
    number = "".join(f"<span>({escape(tag)})</span>" for tag in TAG.findall(latex))
    formula = mathml(TAG.sub("", latex), "block", node)
    page.body.append(f'<div class="equation">{formula}{number}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """What Sphinx calls."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
